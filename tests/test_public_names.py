"""Ten lines of Python are the README's promise: the names they use are there, and importing the package is cheap."""

import subprocess
import sys

import pytest

import mapvote


def test_every_public_name_is_there_and_dir_lists_nothing_else() -> None:
    assert all(getattr(mapvote, name) is not None for name in mapvote.__all__)
    assert dir(mapvote) == sorted(mapvote.__all__)
    assert {"build_map", "vote_drive", "update_map", "map_from_points"} <= set(dir(mapvote))
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        mapvote.no_such_name  # noqa: B018


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, mapvote; print('numba' in sys.modules, 'numpy' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).split() == ["False", "False"]


@pytest.mark.slow
def test_a_client_a_vehicle_and_a_server_start_without_the_parts_of_scipy_that_few_requests_need() -> None:
    """They would be a fifth of their start. ``import scipy`` loads a part when it is first asked for."""
    for room in ("mapvote.client", "mapvote.vehicle", "mapvote_server.api.serve"):
        code = (
            f"import sys, {room}; print([n for n in ('spatial', 'sparse', 'special') if f'scipy.{{n}}' in sys.modules])"
        )
        assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]", room
