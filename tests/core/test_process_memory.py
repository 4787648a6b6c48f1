"""Memory that a long drive no longer needs returns to the system."""

from __future__ import annotations

import platform
import resource
from pathlib import Path

import pytest

from mapvote.core.process_memory import give_back_free_pages


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc holds on to free pages and can be asked")
def test_holes_between_what_is_in_use_go_back_to_the_system() -> None:
    blocks = [b"x" * (90_000 + i) for i in range(1000)]
    kept, before = blocks[::10], resident_mb()
    del blocks
    give_back_free_pages()
    assert resident_mb() < before - 60.0
    assert all(set(block) == {ord("x")} for block in kept)
