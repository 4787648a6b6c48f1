"""Kernels are run: where they are kept, nobody else may have put one."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numba
import pytest

from mapvote import kernel_cache


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Nothing may be written to but the temporary folder."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setattr(numba.config, "CACHE_DIR", numba.config.CACHE_DIR)  # is put back
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    return tmp_path


def chosen() -> Path:
    kernel_cache.choose_kernel_cache()
    assert os.environ["NUMBA_CACHE_DIR"] == numba.config.CACHE_DIR
    return Path(numba.config.CACHE_DIR)


def test_the_folder_is_the_users_own_and_the_same_at_each_start(nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = chosen()
    assert first.parent == nowhere
    assert first.stat().st_mode & 0o777 == 0o700
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    assert chosen() == first


def test_a_folder_that_others_may_write_to_is_not_used(nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = chosen()
    first.chmod(0o777)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    second = chosen()
    assert second != first
    assert second.stat().st_mode & 0o777 == 0o700


def test_what_the_user_says_stays(nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/kernels")
    kernel_cache.choose_kernel_cache()
    assert os.environ["NUMBA_CACHE_DIR"] == "/kernels"


def test_numba_finds_its_own_place_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(os, "access", lambda path, mode: True)
    kernel_cache.choose_kernel_cache()
    assert "NUMBA_CACHE_DIR" not in os.environ
