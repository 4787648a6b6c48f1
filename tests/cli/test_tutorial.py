"""The tutorial, word for word and from its first block to its last, on the scans that it speaks of."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from command_line import type_in

ROOT = Path(__file__).parents[2]
DRIVE = ROOT / "../shared/data/kitti/2011_09_26_0001"

NOT_HERE = "python3 -m venv", "mapvote import tiles/", "mapvote vote my_bag"
"""Installs from the network; reads a map or a bag that the reader may have."""


@pytest.mark.slow
@pytest.mark.skipif(not DRIVE.exists(), reason="the KITTI scans are not beside the repository")
def test_the_tutorial_works_word_for_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    os.symlink(DRIVE.resolve(), "2011_09_26_drive_0001_sync")
    text = (ROOT / "docs/vehicles.md").read_text()
    said: list[str] = []
    not_said: list[str] = []
    for language, block in re.findall(r"^```(\w*)\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        if language == "text":
            not_said += [line for line in block.splitlines() if steady(line) not in said]
        for line in block.splitlines() if language == "" else ():
            if not line.startswith(NOT_HERE):
                said += [steady(one) for one in type_in(line).splitlines()]
    assert (tmp_path / "street.pcd").exists()
    assert not_said == [], "\n".join(said)


def steady(line: str) -> str:
    """A printed line without what differs from machine to machine: times, the last two digits of a map's points, which
    follow from sums in vectors of the processor's width, and how wide a table is."""
    if line.startswith("milliseconds"):
        line = re.sub(r"[\d.]+", "#", line)
    line = re.sub(r"(?<=\d)\d\d points$", "## points", line)
    return re.sub(r"[\s\u2500-\u257f|]+", " ", line).strip()
