"""What cached drives, maps, ballots and scores are named by."""

from __future__ import annotations

import pytest

from mapvote_lab.evaluation.experiments.scene import _DRIVES_FROM, _MAP_FROM, BALLOTS_FROM, sources_digest


@pytest.mark.parametrize("parts", [_DRIVES_FROM, _MAP_FROM, BALLOTS_FROM])
def test_the_sources_that_a_cached_result_depends_on_exist(parts: tuple[str, ...]) -> None:
    assert len(sources_digest(parts)) == 64


def test_a_source_that_is_not_there_is_an_error() -> None:
    with pytest.raises(FileNotFoundError, match="no_such_room"):
        sources_digest(("core", "no_such_room"))
