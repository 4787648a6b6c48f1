"""A package that is missing: which extra brings it, by the program's own metadata."""

from __future__ import annotations

from importlib import metadata

import pytest

from mapvote.formats.extras import missing_extra

WRITTEN = [
    "numpy>=2",
    "sqlalchemy<2.2,>=2.1; extra == 'all'",
    "sqlalchemy<2.2,>=2.1; extra == 'server'",
    "prometheus-client>=0.21; extra == 'server'",
    'uvloop>=0.21; (sys_platform != "win32") and extra == "server"',
    "embreex>=2.17.7; extra == 'lab'",
]


@pytest.mark.parametrize(
    ("module", "extra"),
    [("sqlalchemy.orm", "server"), ("prometheus_client", "server"), ("uvloop", "server"), ("embreex", "lab")],
)
def test_the_smallest_extra_that_brings_a_module_is_named(
    module: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metadata, "requires", lambda name: WRITTEN)
    said = missing_extra(ModuleNotFoundError(name=module))
    assert said is not None
    assert said.endswith(f"pip install 'mapvote[{extra}]'")


def test_a_module_that_no_extra_brings_is_a_bug_and_stays_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "requires", lambda name: WRITTEN)
    assert missing_extra(ModuleNotFoundError(name="mapvote.no_such_room")) is None
    assert missing_extra(ModuleNotFoundError(name="numpy")) is None
