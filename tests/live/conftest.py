"""Every test of this folder has DDS on loopback, and a domain of its own."""

from __future__ import annotations

import pytest

from live.loopback_dds import LOOPBACK, own_domain


@pytest.fixture(autouse=True)
def loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)


@pytest.fixture
def domain() -> int:
    return own_domain()
