"""The votes of a long drive do not depend on how its tiles were packed and judged."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from long_street import blocks_say_the_same, long_street
from mapvote.config import VotingSettings
from mapvote.core.grid import Grid, Lattice
from mapvote.core.point_map import PointMap
from mapvote.core.types import U64, MapvoteError
from mapvote.rules.packed_tiles import (
    COUNT_PLANES,
    TILE_PACKING,
    OpenTile,
    PackedTiles,
    Shelf,
    TilePacking,
    add_one,
    count_of,
)
from mapvote.rules.surfaces import SurfaceVoter
from mapvote.rules.voxel_counts import CROSSED, HIT, PASSED, PASSES

LATTICE = Lattice()


@pytest.mark.parametrize("full", [CROSSED, HIT, PASSES])
def test_all_counts_of_a_cell_are_halved_when_any_one_counter_is_full(full: int) -> None:
    """Voxel 5: one counter at its largest number, the others at 2; then one more scan for each of the three."""
    cell = np.zeros(PASSED + 1, dtype=np.uint64)
    bit = np.uint64(5)
    for first in (CROSSED, HIT, PASSES):
        for k in range(COUNT_PLANES):
            if first == full or k == 1:
                cell[first + k] = np.uint64(1) << bit
    add_one(cell, (np.uint64(1) << bit,) * 3)
    counts = {first: count_of(cell, first, int(bit)) for first in (CROSSED, HIT, PASSES)}
    assert counts == {first: 2 ** (COUNT_PLANES - 1) if first == full else 1 for first in counts}


def some_planes(seed: int, share: float) -> U64:
    rng = np.random.default_rng(seed)
    cells = rng.random((256, 256, 1)) < share
    return np.asarray(np.where(cells, rng.integers(0, 2**64, (256, 256, 16), dtype=np.uint64), np.uint64(0)))


def fill(opened: OpenTile, planes: U64) -> None:
    opened.planes[:] = planes
    opened.spans[:] = 0, 256


def test_a_tile_that_is_left_comes_back_as_it_was() -> None:
    tiles = PackedTiles(LATTICE, 16)
    shares = {(0, 0): 0.0, (0, 1): 0.01, (-1, 0): 1.0}
    for seed, (tile, share) in enumerate(shares.items()):
        fill(tiles.near(tile), some_planes(seed, share))
    far = Grid(LATTICE, 5000, 5000, 100, 100)
    for _ in range(TILE_PACKING.bands):
        tiles.leave(far)
    assert not tiles._open
    assert set(tiles) == set(shares)
    for seed, (tile, share) in enumerate(shares.items()):
        np.testing.assert_array_equal(tiles[tile], some_planes(seed, share))
        np.testing.assert_array_equal(tiles.near(tile).planes, some_planes(seed, share))
    for _ in range(TILE_PACKING.bands):
        tiles.leave(far)
    for seed, (tile, share) in enumerate(shares.items()):
        np.testing.assert_array_equal(tiles[tile], some_planes(seed, share))
    assert not tiles.near((5, 5)).planes.any(), "whatever another tile left behind"


@pytest.mark.parametrize("packed", [False, True])
@given(row=st.integers(-90, 300), col=st.integers(-90, 300), side=st.integers(1, 300))
@settings(max_examples=20)
def test_a_part_of_a_tile_is_the_same_whether_the_tile_is_packed_or_not(
    packed: bool, row: int, col: int, side: int
) -> None:
    tiles = PackedTiles(LATTICE, 16)
    planes = some_planes(3, 0.05)
    fill(tiles.near((0, 0)), planes)
    if packed:
        for _ in range(TILE_PACKING.bands):
            tiles.leave(Grid(LATTICE, 5000, 5000, 100, 100))
    within = tiles.within((0, 0), tiles.overlap((0, 0), Grid(LATTICE, row, col, side, side)))
    cut = slice(max(row, 0), max(row + side, 0)), slice(max(col, 0), max(col + side, 0))
    np.testing.assert_array_equal(within[cut], planes[cut])


def test_a_tile_is_left_only_when_the_view_is_far_from_it() -> None:
    tiles = PackedTiles(LATTICE, 16)
    tiles.near((0, 0))
    for col in (100, 256, 256 + 63):
        tiles.leave(Grid(LATTICE, 0, col, 100, 100))
        assert list(tiles._open) == [(0, 0)]
    for _ in range(TILE_PACKING.bands):
        tiles.leave(Grid(LATTICE, 0, 256 + 64, 100, 100))
    assert not tiles._open


def test_what_is_counted_while_a_tile_is_being_packed_is_kept() -> None:
    tiles = PackedTiles(LATTICE, 16)
    far = Grid(LATTICE, 5000, 5000, 100, 100)
    fill(tiles.near((0, 0)), some_planes(1, 0.01))
    for _ in range(TILE_PACKING.bands - 1):
        tiles.leave(far)
    fill(tiles.near((0, 0)), some_planes(2, 0.01))
    for _ in range(TILE_PACKING.bands):
        tiles.leave(far)
    assert not tiles._open
    np.testing.assert_array_equal(tiles[0, 0], some_planes(2, 0.01))


def surfaces_after_a_drive(point_map: PointMap) -> SurfaceVoter:
    """Walls were crossed seven times or met, or half of both or neither, and things rose, at random."""
    voter, rng = SurfaceVoter(VotingSettings(), point_map), np.random.default_rng(6)
    for tile in point_map.tiles:
        planes, mapped = voter.counts.settled().near(tile).planes, point_map.tiles[tile].obstacle_words
        fate = rng.random(mapped.shape)
        planes[..., CROSSED : CROSSED + 3] = np.where(fate < 0.4, mapped, np.uint64(0))[..., None]
        planes[..., CROSSED] |= np.where(fate > 0.8, mapped, np.uint64(0))
        planes[..., HIT] = np.where((fate > 0.4) & (fate < 0.6), mapped, np.uint64(0))
        rose = np.where(rng.random(mapped.shape) < 0.02, np.uint64(0b111110), np.uint64(0)) & ~mapped
        planes[..., HIT + 1] |= rose
        planes[..., PASSES] = rose & np.uint64(0b110)
        planes[..., PASSED] = ~rose
    return voter


@pytest.mark.slow
def test_votes_of_single_tiles_equal_those_of_blocks_of_tiles() -> None:
    blocks_say_the_same(surfaces_after_a_drive(long_street()))


@given(st.lists(st.binary(max_size=40), max_size=20))
def test_a_shelf_returns_all_that_was_put_on_it(things: list[bytes]) -> None:
    shelf = Shelf(TilePacking(memory_bytes=64))
    places = [shelf.put(thing) for thing in things]
    assert [shelf.read(place) for place in places] == things


def test_a_short_drive_opens_no_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "TemporaryFile", None)
    full = Shelf()
    assert full.read(full.put(bytes(1 << 20))) == bytes(1 << 20)


def test_the_error_of_a_full_disk_names_the_folder_and_the_mend(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "nowhere"))
    with pytest.raises(MapvoteError, match=r"nowhere: .*make room, or name another folder in TMPDIR"):
        Shelf(TilePacking(memory_bytes=4)).put(b"longer than four")
