"""``mapvote update`` with a budget of false deletions: what it keeps, it names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from command_line import typed
from hand_made import make_ballot, two_walls
from mapvote.codec.ballot import MOST_STEPS, encode
from mapvote.core.types import MapvoteError
from mapvote.formats import read_map, write_map
from stores import WALL, wall_gone


@pytest.fixture
def round_of_two(tmp_path: Path) -> list[str]:
    """A map and two ballots: its first wall is gone, but of the cell in the middle nobody is sure."""
    write_map(two_walls(), tmp_path / "map")
    say = wall_gone(odds=np.array([40, -MOST_STEPS, 40], np.int8))
    for name in "ab":
        (tmp_path / f"{name}.ballot").write_bytes(encode(make_ballot(two_walls(), {(0, 0): say}, name)))
    return [str(tmp_path / name) for name in ("map", "a.ballot", "b.ballot")]


def test_a_deletion_beyond_the_budget_waits_and_says_where_to_drive_by(round_of_two: list[str], tmp_path: Path) -> None:
    said = typed("update", *round_of_two, "--out", tmp_path / "new", "--false-deletions", "0.01")
    assert "6 deleted" in said
    assert "1 cell keeps its points: that something there still stands is likelier than 0.01. Drive by:" in said
    assert "3.4, 3.1" in said
    kept = read_map(tmp_path / "new").tiles[0, 0].obstacle_words
    assert [bool(kept[cell]) for cell in WALL] == [False, True, False]
    said = typed("update", *round_of_two, "--dry-run")
    assert ("9 deleted" in said, "Drive by" in said) == (True, False), "without a budget nothing is kept"
    for value in ("0", "-1", "2"):
        with pytest.raises(MapvoteError, match="give a probability above 0"):
            typed("update", *round_of_two, "--dry-run", f"--false-deletions={value}")
