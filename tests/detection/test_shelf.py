"""What is put on a shelf is found again as it was, in memory or in a file."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.types import MapvoteError
from mapvote.detection import packed_tiles as shelf
from mapvote.detection.packed_tiles import Shelf


@given(st.lists(st.binary(max_size=40), max_size=20))
def test_everything_is_found_where_it_was_put(things: list[bytes]) -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(shelf, "IN_MEMORY", 64)
        full = Shelf()
        places = [full.put(thing) for thing in things]
        assert [full.read(place) for place in places] == things


def test_a_short_drive_asks_the_disk_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "TemporaryFile", None)
    full = Shelf()
    assert full.read(full.put(bytes(1 << 20))) == bytes(1 << 20)


def test_where_a_long_drive_cannot_be_kept_it_is_said_how_to_mend_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shelf, "IN_MEMORY", 4)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "nowhere"))
    with pytest.raises(MapvoteError, match=r"nowhere: .*make room, or name another folder in TMPDIR"):
        Shelf().put(b"longer than four")
