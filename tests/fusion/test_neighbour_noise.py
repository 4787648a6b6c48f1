"""A plane through what came or went tells which of two cells it stands in, however its points are strewn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.codec.ballot import Odds
from mapvote.config import FuseSettings
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS, Lattice
from mapvote.core.rule import SURFACES
from mapvote.core.tile import Tile
from mapvote.core.types import F32, U8, CellState
from mapvote.fusion.fuse import fuse_tile
from mapvote.fusion.neighbour_noise import REACH_M, _moments, spilled
from mapvote.fusion.tile_vote import Vote

CE, CO = CellState.CHANGED_EMPTY, CellState.CHANGED_OCCUPIED
WINDOW = Lattice().tile((0, 0))
BORDER_M = 32.1
"""x of a border of cells, between columns 106 and 107."""


def wall(x: float, spill: F32 | None = None, length_m: float = 3.0, height_m: float = 3.0) -> F32:
    """(n, 3) float32: voxels' points of a wall along y at ``x``, with ``spill``, its points at other x."""
    y, z = np.meshgrid(np.arange(40.05, 40.0 + length_m, 0.3), np.arange(0.45, 0.3 + height_m, 0.3))
    points = np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()]).astype(np.float32)
    return points if spill is None else np.concatenate([points, spill])


def spill_at(x: float, every: int = 3) -> F32:
    """Some voxels' worth of the wall's points that noise carried to ``x``."""
    points = wall(x)[::every].copy()
    points[:, 1] += np.float32(0.1)
    return points


def tile_of(points: F32) -> Tile:
    flat = np.zeros((TILE_CELLS, TILE_CELLS), np.float32)
    return Tile(WINDOW, points, flat)


def cells_of(points: F32) -> set[int]:
    at = np.floor(points[:, :2] / np.float32(CELL_SIZE)).astype(int)
    return set((at[:, 1] * TILE_CELLS + at[:, 0]).tolist())


def states_of(points: F32, state: CellState) -> U8:
    states = np.full(CELLS, CellState.UNCHANGED_EMPTY, np.uint8)
    states[sorted(cells_of(points))] = state
    return states.reshape(TILE_CELLS, TILE_CELLS)


def vote_for(points: F32, name: str = "a") -> Vote:
    return Vote(vehicle=name, end_ns=0, digest=name, states=states_of(points, CO), new_points=points)


def all_but_the_ends(found: set[int], cells: set[int]) -> bool:
    """At a wall's ends few points make no plane."""
    return sorted(cells)[1:-1] == sorted(found & set(sorted(cells)[1:-1])) and found <= cells


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("turned", [False, True])
def test_of_a_wall_that_went_at_a_cells_border_only_the_cell_that_it_stood_in_changed(side: int, turned: bool) -> None:
    """Turned it lies along the other axis, as near to the tile's last column as can be."""
    there, spill = wall(BORDER_M + side * 0.04), spill_at(BORDER_M - side * 0.01)
    if turned:
        shift = np.array([(TILE_CELLS - 144) * CELL_SIZE, 0, 0], np.float32)
        there, spill = (some[:, [1, 0, 2]] + shift for some in (there, spill))
        assert there[:, 0].max() > (TILE_CELLS - 2) * CELL_SIZE
    points, ground = np.concatenate([there, spill]), there * np.array([1, 1, 0], np.float32)  # says nothing
    states = states_of(points, CE)
    found = set(spilled(tile_of(np.concatenate([points, ground])), [], states).tolist())
    assert all_but_the_ends(found, cells_of(spill))
    assert not len(spilled(tile_of(points), [], states_of(spill, CE))), "the wall's own cell did not change"


def roof() -> F32:
    x, y = np.meshgrid(np.arange(BORDER_M - 0.09, BORDER_M + 0.6, 0.3), np.arange(40.05, 43.0, 0.3))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 3.0)]).astype(np.float32)


def pole() -> F32:
    x = np.tile(BORDER_M + np.array([-0.02, 0.02, 0.03]), 2)
    return np.column_stack([x, np.full(6, 40.1), np.arange(6) * 0.3 + 0.45]).astype(np.float32)


EDGE_M = TILE_CELLS * CELL_SIZE


@pytest.mark.parametrize(
    ("why", "points"),
    [
        ("it holds points that no noise carries so far", wall(BORDER_M + 0.05, spill_at(BORDER_M - 0.17))),
        ("it holds as many points as the other", wall(BORDER_M + 0.05, spill_at(BORDER_M - 0.05, every=1))),
        ("it lies flat", roof()),
        ("it stands alone", pole()),
        ("nothing is asked of the next tile", np.concatenate([wall(EDGE_M - 0.05), wall(0.05)])),
    ],
)
def test_the_cell_beside_another_changed_too_if(why: str, points: F32) -> None:
    assert not len(spilled(tile_of(points), [], states_of(points, CE))), why


def test_six_points_make_a_plane_and_five_do_not() -> None:
    there = wall(BORDER_M + 0.03, length_m=0.6, height_m=0.6)
    beyond = np.array([[BORDER_M - 0.01, 40.1, 0.5], [BORDER_M - 0.01, 40.3, 0.5]], np.float32)
    corner = np.array([BORDER_M - CELL_SIZE, 133 * CELL_SIZE, 0.0], np.float32)
    for at in (np.zeros(3, np.float32), corner):
        for some, found in ((beyond - at, cells_of(beyond - at)), (beyond[:1] - at, set[int]())):
            points = np.concatenate([there - at, some])
            assert set(spilled(tile_of(points), [], states_of(points, CE)).tolist()) == found
    assert 0 in cells_of(beyond - corner)


@given(st.lists(st.integers(0, 10**6), min_size=3, max_size=3), st.floats(-0.06, 0.06))
def test_neither_the_order_of_points_nor_of_votes_matters_and_only_changed_cells_are_found(
    seeds: list[int], at: float
) -> None:
    rng = np.random.default_rng(seeds)
    points = wall(BORDER_M + at)
    points[:, 0] += rng.normal(0.0, 0.03, len(points)).astype(np.float32)
    states = states_of(points, CO)
    votes = [vote_for(points[i::3], str(i)) for i in range(3)]
    found = spilled(Tile.empty(WINDOW), votes, states)
    assert np.isin(states.reshape(-1)[found], [CO]).all()
    assert (np.diff(found) > 0).all()
    mixed = [vote_for(rng.permutation(points[i::3]), str(i)) for i in (2, 0, 1)]
    assert (spilled(Tile.empty(WINDOW), mixed, states) == found).all()
    went = spilled(tile_of(points), [], states_of(points, CE))
    assert (went == found).all(), "what came and what went are judged alike"


def test_moments_are_those_of_all_points_within_reach() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform((0, 0, 0), (3, 3, 2), (400, 3)).astype(np.float32)
    cells = (points[:, 1] // np.float32(CELL_SIZE) * TILE_CELLS + points[:, 0] // np.float32(CELL_SIZE)).astype(int)
    order = np.argsort(cells, kind="stable")
    points, cells = points[order], cells[order]
    first = np.concatenate([[0], np.cumsum(np.bincount(cells, minlength=CELLS))])
    asked = np.arange(0, 400, 7)
    number, mean = np.zeros(len(asked), np.int64), np.zeros((len(asked), 3))
    spread = np.zeros((len(asked), 3, 3))
    _moments(points, asked, first, cells, number, mean, spread)
    for k, i in enumerate(asked):
        off = points.astype(np.float64) - points[i]
        near = off[np.linalg.norm(off, axis=1) <= REACH_M]
        assert number[k] == len(near)
        np.testing.assert_allclose(mean[k], near.mean(axis=0), atol=1e-9)
        np.testing.assert_allclose(spread[k], np.cov(near.T, bias=True), atol=1e-9)


@given(heading_deg=st.floats(8.0, 82.0), off_m=st.floats(0.0, 0.3), seed=st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_of_a_slanted_wall_no_cell_is_given_up_that_holds_a_tenth_of_a_metre_of_it(
    heading_deg: float, off_m: float, seed: int
) -> None:
    rng, heading = np.random.default_rng(seed), np.radians(heading_deg)
    along = np.linspace(0.0, 6.0, 601)
    line = np.array([[30.0 + off_m, 30.0]]) + along[:, None] * [np.cos(heading), np.sin(heading)]
    at = np.floor(line / CELL_SIZE).astype(np.int64)
    cells, held = np.unique(at[:, 1] * TILE_CELLS + at[:, 0], return_counts=True)
    u, z = np.meshgrid(np.arange(0.05, 6.0, 0.1), np.arange(0.45, 3.0, 0.15))
    across = rng.normal(0.0, 0.02, u.size)
    x = 30.0 + off_m + u.ravel() * np.cos(heading) - across * np.sin(heading)
    y = 30.0 + u.ravel() * np.sin(heading) + across * np.cos(heading)
    points = np.column_stack([x, y, z.ravel()]).astype(np.float32)
    given_up = spilled(tile_of(points), [], states_of(points, CE))
    assert not np.isin(given_up, cells[held >= 10]).any()


def test_what_spilled_is_told_as_empty_and_goes_with_its_wall_as_was_voted() -> None:
    beyond = spill_at(BORDER_M + 0.01)
    points = np.concatenate([wall(BORDER_M - 0.04), beyond])
    tile, states = tile_of(points), states_of(points, CE)
    changed = np.flatnonzero(states == CE)
    votes = [
        Vote(name, 0, name, states=states, odds=Odds(changed, np.full(len(changed), 12, np.int8))) for name in "ab"
    ]
    decision, edited = fuse_tile(tile, votes, SURFACES, FuseSettings())
    told = {int(cell) for cell in changed if decision.states.reshape(-1)[cell] == CellState.UNCHANGED_EMPTY}
    assert all_but_the_ends(told, cells_of(beyond))
    assert len(edited.points) == 0
    unsaid = [Vote(vote.vehicle, 0, vote.digest, states=states) for vote in votes]
    assert (fuse_tile(tile, unsaid, SURFACES, FuseSettings())[0].states == states).all(), "of surfaces' ballots alone"
