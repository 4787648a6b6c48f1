"""A package that is missing: which extra brings it, by the program's own metadata."""

from __future__ import annotations

from importlib import metadata

import pytest

from mapvote.core.extras import missing_extra

WRITTEN = [
    "numpy>=2",
    "sqlalchemy<2.2,>=2.1; extra == 'all'",
    "sqlalchemy<2.2,>=2.1; extra == 'server'",
    "prometheus-client>=0.21; extra == 'server'",
    'uvloop>=0.21; (sys_platform != "win32") and extra == "server"',
]


def test_the_smallest_extra_that_brings_a_module_is_named_and_none_for_a_bug(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "requires", lambda name: WRITTEN)
    for module in ("sqlalchemy.orm", "prometheus_client", "uvloop"):
        said = missing_extra(ModuleNotFoundError(name=module))
        assert said is not None
        assert said.endswith("pip install 'mapvote[server]'")
    for module in ("mapvote.no_such_room", "numpy"):
        assert missing_extra(ModuleNotFoundError(name=module)) is None
