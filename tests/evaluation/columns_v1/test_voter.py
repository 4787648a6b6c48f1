"""A drive's evidence by columns_v1, over whole tiles: what falls with a demolished wall, and what stays beside it."""

from __future__ import annotations

import numpy as np
import pytest

from hand_made import make_map, make_tile, one_scan, wall
from long_street import blocks_say_the_same, long_street
from mapvote.config import VotingSettings
from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.core.point_map import PointMap
from mapvote.core.reference import LocalMap, reference_window
from mapvote.core.types import CellState
from mapvote.detection.evidence import HIT_REACH_M
from mapvote.detection.voter import TileVotes
from mapvote.perception.raycast import ScanView, Sight
from mapvote_lab.evaluation.columns_v1.counters import ColumnEvidence
from mapvote_lab.evaluation.columns_v1.regions import beside_new
from mapvote_lab.evaluation.columns_v1.rules import ALL_RULES, Rules
from mapvote_lab.evaluation.columns_v1.voter import ColumnVoter

ROW = 100
WALL, POST = range(100, 112), 112
WALL_Z, POST_Z, CORNICE_Z = [0.75, 1.05, 1.35, 1.65], [0.75, 1.05], 1.65
WITHOUT_I = Rules(remnants_go=False)
ALL_BITS = ~np.uint64(0) >> np.uint64(1)


def street() -> PointMap:
    """A wall that ends at a post; the wall's cornice hangs over the post, in the same cell."""
    cells = [(ROW, column) for column in WALL]
    points = [wall(cells, WALL_Z), wall([(ROW, POST)], [*POST_Z, CORNICE_Z])]
    ground = wall([(r, c) for r in range(90, 120) for c in range(90, 130)], [0.0])
    return make_map({(0, 0): make_tile(np.concatenate([*points, ground]))})


def bits(heights: list[float]) -> np.uint64:
    return np.uint64(sum(1 << int(z / 0.3) for z in heights))


def after(more_hits: dict[tuple[int, int], list[float]] | None = None, rules: Rules = ALL_RULES) -> TileVotes:
    """What a drive says after the wall is gone: rays go through everything, and only the post is struck."""
    point_map = street()
    grid = point_map.lattice.tile((0, 0))
    reference = reference_window(point_map, grid)
    hit = np.zeros(grid.shape, np.uint64)
    hit[ROW, POST] = bits(POST_Z)
    for cell, heights in (more_hits or {}).items():
        hit[cell] = bits(heights)
    passed = np.where(hit != 0, ~hit & ALL_BITS, ALL_BITS)
    view = ScanView(grid, (hit != 0).astype(np.int32), hit, passed, np.full(grid.shape, int(Sight.CLEAR), np.uint8))
    evidence = ColumnEvidence(point_map.lattice)
    for _ in range(20):
        evidence.count(view, reference)
    return ColumnVoter(VotingSettings(), point_map, rules, evidence).votes()[0, 0]


def test_the_last_cell_of_a_demolished_wall_falls_though_a_post_stands_next_to_it() -> None:
    end = (ROW, POST - 1)
    assert after(rules=WITHOUT_I).states[ROW, WALL[0]] == CellState.CHANGED_EMPTY
    assert after(rules=WITHOUT_I).states[end] == CellState.UNCHANGED_OCCUPIED, "hits on the post veto it (rule B)"
    votes = after()
    assert votes.states[end] == CellState.CHANGED_EMPTY
    assert votes.gone is not None
    assert votes.gone[end] == bits(WALL_Z)


def test_the_cornice_goes_from_the_cell_of_the_post_and_the_post_stays() -> None:
    votes = after()
    assert votes.states[ROW, POST] == CellState.UNCHANGED_OCCUPIED
    assert votes.remnants is not None
    assert votes.remnants[ROW, POST] == bits([CORNICE_Z])
    without = after(rules=WITHOUT_I).remnants
    assert without is not None
    assert not without.any()


def test_no_cell_falls_as_a_remnant_next_to_hits_on_something_new() -> None:
    """An error of pose puts what stands beside its place in the map: voxels may go, the cell does not change."""
    votes = after({(ROW + 1, POST - 1): [0.75, 1.05]})
    assert votes.states[ROW, POST - 1] == CellState.UNCHANGED_OCCUPIED


def test_what_is_hit_some_centimetres_beside_its_voxel_is_no_remnant() -> None:
    """A twig beside the wall that went: its leaf is mapped in one voxel, and met in the next."""

    def left_of_the_cornice(apart_m: float) -> bool:
        voter = ColumnVoter(VotingSettings(), street())
        y, x, beside_x = (ROW + 0.5) * CELL_SIZE, (POST + 0.5) * CELL_SIZE, (POST + 1) * CELL_SIZE + apart_m
        for _ in range(8):
            voter.observe(one_scan(voter.point_map, np.array([*((x, y, z) for z in POST_Z), (beside_x, y, CORNICE_Z)])))
        votes = voter.votes()[0, 0]
        assert votes.states[ROW, WALL[0]] == CellState.CHANGED_EMPTY
        assert votes.remnants is not None
        return bool(votes.remnants[ROW, POST] & bits([CORNICE_Z]))

    assert not left_of_the_cornice(0.5 * HIT_REACH_M)
    assert left_of_the_cornice(1.5 * HIT_REACH_M)


@pytest.mark.parametrize("bit", [3, 40])
def test_beside_new_is_everything_within_a_voxel_of_a_hit_that_the_map_does_not_explain(bit: int) -> None:
    planes, occupied = np.zeros((5, 5, 16), np.uint64), np.zeros((5, 5), np.uint64)
    planes[2, 2, 7] = planes[0, 0, 7] = np.uint64(1) << np.uint64(bit)
    occupied[0, 0] = np.uint64(1) << np.uint64(bit)
    near = beside_new(planes, occupied, np.zeros((5, 5), np.int32))
    assert (near[1:4, 1:4] == np.uint64(0b111) << np.uint64(bit - 1)).all()
    assert np.count_nonzero(near) == 9


def drive(evidence: ColumnEvidence, local: LocalMap) -> None:
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


@pytest.mark.slow
def test_blocks_of_tiles_say_what_all_of_them_say_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    point_map = long_street()
    evidence = ColumnEvidence(Lattice())
    drive(evidence, LocalMap(point_map, 40.0))
    assert evidence.tiles._packed
    blocks_say_the_same(ColumnVoter(VotingSettings(), point_map, evidence=evidence), monkeypatch)
