"""The tutorial, word for word and from its first block to its last, on the scans that it speaks of."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from command_line import type_in

ROOT = Path(__file__).parents[2]
DRIVE = ROOT / "../shared/data/kitti/2011_09_26_0001"

NOT_HERE = "python3 -m venv", "mapvote import tiles/"
"""Installs from the network; reads a map that the reader may have."""


@pytest.mark.slow
@pytest.mark.skipif(not DRIVE.exists(), reason="the KITTI scans are not beside the repository")
def test_the_tutorial_works_word_for_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    os.symlink(DRIVE.resolve(), "2011_09_26_drive_0001_sync")
    text = (ROOT / "docs/vehicles.md").read_text()
    for language, block in re.findall(r"^```(\w*)\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        for line in block.splitlines() if language == "" else ():  # what it prints is "text"
            if not line.startswith(NOT_HERE):
                type_in(line)
    assert (tmp_path / "street.pcd").exists()
