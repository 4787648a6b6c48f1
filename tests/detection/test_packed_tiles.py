"""A long drive says the same, however its tiles were kept and judged."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hand_made import make_map, make_tile, wall
from mapvote.config import VotingSettings
from mapvote.core.grid import Grid, Lattice
from mapvote.core.point_map import PointMap
from mapvote.core.reference import LocalMap
from mapvote.core.types import U64
from mapvote.detection import blocks
from mapvote.detection.column_voter import ColumnVoter
from mapvote.detection.counters import Evidence
from mapvote.detection.packed_tiles import PackedTiles
from mapvote.detection.surface_counts import CROSSED, MET, PASSED, PASSES
from mapvote.detection.surfaces import SurfaceVoter
from mapvote.detection.voters import Voter
from mapvote.detection.votes import TileVotes
from mapvote.perception.raycast import ScanView

LATTICE = Lattice()


def some_planes(seed: int, share: float) -> U64:
    rng = np.random.default_rng(seed)
    cells = rng.random((256, 256, 1)) < share
    return np.asarray(np.where(cells, rng.integers(0, 2**64, (256, 256, 16), dtype=np.uint64), np.uint64(0)))


def test_a_tile_that_is_left_comes_back_as_it_was() -> None:
    tiles = PackedTiles(LATTICE, 16)
    shares = {(0, 0): 0.0, (0, 1): 0.01, (-1, 0): 1.0}
    for seed, (tile, share) in enumerate(shares.items()):
        tiles.near(tile)[:] = some_planes(seed, share)
    far = Grid(LATTICE, 5000, 5000, 100, 100)
    for _ in shares:
        tiles.leave(far)
    assert not tiles._open
    assert set(tiles) == set(shares)
    for seed, (tile, share) in enumerate(shares.items()):
        np.testing.assert_array_equal(tiles[tile], some_planes(seed, share))
        np.testing.assert_array_equal(tiles.near(tile), some_planes(seed, share))
    tiles.leave(far)
    assert tiles._spare
    assert not tiles.near((5, 5)).any(), "whatever another tile left behind"


def test_a_tile_is_left_only_when_the_view_is_far_from_it() -> None:
    tiles = PackedTiles(LATTICE, 16)
    tiles.near((0, 0))
    for col in (100, 256, 256 + 63):
        tiles.leave(Grid(LATTICE, 0, col, 100, 100))
        assert list(tiles._open) == [(0, 0)]
    tiles.leave(Grid(LATTICE, 0, 256 + 64, 100, 100))
    assert not tiles._open


def drive(evidence: Evidence, local: LocalMap) -> None:
    """Along a row of tiles and back; walls stand and fall, and things rise, at random."""
    rng = np.random.default_rng(6)
    gone = rng.random((3000, 3000)) < 0.5
    for x in [*np.arange(20.0, 300.0, 60.0), 240.0, 20.0, 280.0]:
        reference, _ = local.at(np.array([x, 35.0, 1.8]))
        grid = reference.grid
        gone_here = gone[: grid.rows, grid.col0 % 1000 : grid.col0 % 1000 + grid.cols]
        hit = np.where(gone_here, np.uint64(0), reference.occupied)
        hit |= np.where(rng.random(grid.shape) < 0.001, np.uint64(0b110), np.uint64(0))
        passed = ~hit >> np.uint64(1)
        evidence.count(ScanView(grid, (hit != 0).astype(np.int32), hit, passed, np.zeros((0, 0), np.uint8)), reference)


def columns_after_a_drive(point_map: PointMap) -> ColumnVoter:
    evidence = Evidence(LATTICE)
    drive(evidence, LocalMap(point_map, 40.0))
    assert evidence.tiles._packed
    return ColumnVoter(VotingSettings(), point_map, evidence=evidence)


def surfaces_after_a_drive(point_map: PointMap) -> SurfaceVoter:
    """Walls were crossed seven times or met, or half of both or neither, and things rose, at random."""
    voter, rng = SurfaceVoter(VotingSettings(), point_map), np.random.default_rng(6)
    for tile in point_map.tiles:
        planes, mapped = voter.evidence.tiles.near(tile), point_map.tiles[tile].obstacle_words
        fate = rng.random(mapped.shape)
        planes[..., CROSSED : CROSSED + 3] = np.where(fate < 0.4, mapped, np.uint64(0))[..., None]
        planes[..., CROSSED] |= np.where(fate > 0.8, mapped, np.uint64(0))
        planes[..., MET] = np.where((fate > 0.4) & (fate < 0.6), mapped, np.uint64(0))
        rose = np.where(rng.random(mapped.shape) < 0.02, np.uint64(0b111110), np.uint64(0)) & ~mapped
        planes[..., MET + 1] |= rose
        planes[..., PASSES] = rose & np.uint64(0b110)
        planes[..., PASSED] = ~rose
    return voter


@pytest.mark.slow
@pytest.mark.parametrize("after_a_drive", [columns_after_a_drive, surfaces_after_a_drive])
def test_blocks_of_tiles_say_what_all_of_them_say_at_once(
    after_a_drive: Callable[[PointMap], Voter], monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(1)
    walls = [(int(r), c) for r in range(60, 200, 20) for c in range(256) if rng.random() < 0.8]
    ground = [(r, c) for r in range(40, 200, 2) for c in range(0, 256, 2)]
    points = np.concatenate([wall(walls, [0.75, 1.05, 1.35]), wall(ground, [0.0])])
    point_map = make_map({(0, c): make_tile(points, index=(0, c)) for c in range(4)})
    voter = after_a_drive(point_map)
    whole = voter.votes()
    monkeypatch.setattr(blocks, "_AT_ONCE", 1)
    monkeypatch.setattr(blocks, "_BLOCK", 1)
    by_blocks = voter.votes()
    assert list(by_blocks) == list(whole)
    changed = []
    for tile, votes in whole.items():
        for name in TileVotes.__slots__:
            mine, theirs = getattr(by_blocks[tile], name), getattr(votes, name)
            np.testing.assert_array_equal(mine, theirs, err_msg=f"{tile} {name}")
        changed.append(int(((votes.states == 2) | (votes.states == 3)).sum()))
    assert sum(changed) > 50, "there is something to compare"
