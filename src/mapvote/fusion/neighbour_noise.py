"""Cells that changed by noise alone: the surface that was built or demolished stands in the neighbouring cell.

Range noise carries some points of a wall two centimetres from the border of its cell into the next cell. When the wall
is demolished or built, vehicles see that cell change too, and they are right: its points must be deleted or added with
the wall. But nothing of the world changed in it. So its points are edited as voted, and the cell is reported as empty,
before and after. A plane through all points nearby, of both cells, gives the side of the wall nearly to the centimetre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapvote.core.columns import column_bits, flat_cells
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS, Grid
from mapvote.core.kernel import kernel
from mapvote.core.record import record
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I64, NO_VOTE, U8, Bool, CellState
from mapvote.fusion.tile_vote import Vote, offered

REACH_M = 0.45
"""How far about a point its plane is fitted, a voxel and a half: some eight points of a wall."""


@record()
@dataclass(frozen=True, slots=True)
class NoiseRule:
    """Numbers by which points of a wall's noise in a neighbouring cell are recognised."""

    near_m: float = 0.15
    """Reach of noise beyond the border of a cell, half a cell, metres: a point deeper in its cell belongs there."""
    beside_cells: int = 2
    """Cells around one whose points its planes are fitted to."""
    enough_points: int = 6
    """Points of a plane at least."""
    flat: float = 3.0
    """Variance of a plane's points along it as a multiple of that across it, at least."""
    upright: float = 0.5
    """Sine of the largest lean of a wall."""
    stay_share: float = 0.05
    """Share of a cell's points that may stay in it: beside them stands no plane."""


NOISE_RULE = NoiseRule()


def without_spilled(states: U8, tile: Tile, votes: Sequence[Vote]) -> U8:
    """The states (256, 256) as reported: cells that changed by noise alone are empty. ``tile``: before the edit; the
    rest as in :func:`spilled`. The same object where there is no such cell."""
    cells = spilled(tile, votes, states)
    if not len(cells):
        return states
    stated = states.copy()
    stated.reshape(-1)[cells] = int(CellState.UNCHANGED_EMPTY)
    return stated


def without_spilled_in(cells: I64, states: U8, tile: Tile) -> U8:
    """The result of :func:`without_spilled` for demolished surfaces alone, and for points in the flat ``cells`` (n,) or
    next to them: states elsewhere are NO_VOTE."""
    rows, cols = np.divmod(cells, TILE_CELLS)
    near = np.full(states.shape, NO_VOTE, dtype=np.uint8)
    for i in range(-NOISE_RULE.beside_cells, NOISE_RULE.beside_cells + 1):
        for j in range(-NOISE_RULE.beside_cells, NOISE_RULE.beside_cells + 1):
            at = (rows + i).clip(0, TILE_CELLS - 1), (cols + j).clip(0, TILE_CELLS - 1)
            near[at] = states[at]
    return without_spilled(np.where(near == int(CellState.CHANGED_EMPTY), near, np.uint8(NO_VOTE)), tile, ())


def spilled(tile: Tile, votes: Sequence[Vote], states: U8) -> I64:
    """(n,) flat cells, ascending, that ``states`` (256, 256) call changed and that hold what spilled over.

    Demolished surfaces are points of the ``tile``, built ones points that ``votes`` offer; points in the next tile are
    not used. Every such cell lies beside a changed one of its kind with more points.
    """
    flat = states.reshape(-1)
    cells_of = [
        _beside_their_surface(points, flat == kind, tile.window)
        for points, kind in (
            (_going(tile, flat), int(CellState.CHANGED_EMPTY)),
            (offered(votes, states, tile.window)[0], int(CellState.CHANGED_OCCUPIED)),
        )
        if len(points) >= NOISE_RULE.enough_points
    ]
    return np.sort(np.concatenate([np.zeros(0, np.int64), *cells_of]))


def _going(tile: Tile, states: U8) -> F32:
    points, cells = (part[states[tile.cells] == int(CellState.CHANGED_EMPTY)] for part in (tile.points, tile.cells))
    z = points[:, 2].astype(np.float64)
    ground = tile.ground_z.reshape(-1)[cells]
    base = tile.base.reshape(-1)[cells]
    return np.asarray(points[column_bits(z, ground, base)[1]])


def _beside_their_surface(points: F32, changed: Bool, window: Grid) -> I64:
    """(n,) flat cells whose ``points`` (m, 3) lie at their borders, and on planes that stand in the next ``changed``
    (65536,) cell."""
    points = points[np.lexsort(points.T)]  # no sum may depend on the order of votes
    cells = flat_cells(window, points)
    order = np.argsort(cells, kind="stable")
    points = points[order]
    cells = cells[order]
    count = np.bincount(cells, minlength=CELLS)
    tested = np.flatnonzero(_at_a_fuller_one(points, cells, count, changed)[cells])
    stands = _on_planes(points, tested, np.concatenate([[0], np.cumsum(count)]), cells)
    own = cells[tested]
    to = flat_cells(window, stands.astype(np.float32))
    away = np.bincount(own[(to != own) & changed[to] & (count[to] > count[own])], minlength=CELLS)
    return np.flatnonzero((away > 0) & (away >= (1.0 - NOISE_RULE.stay_share) * count))


def _at_a_fuller_one(points: F32, cells: I64, count: I64, changed: Bool) -> Bool:
    """(65536,) of which flat cells all points (m, 3) lie near one side, and across it lies a ``changed`` cell with more
    of them. ``cells`` (m,) of the points, ``count`` (65536,) how many each has."""
    is_beside = np.zeros(CELLS, dtype=np.bool_)
    filled = np.flatnonzero(count)
    wide = TILE_CELLS + 2
    held = np.pad(np.where(changed, count, 0).reshape(TILE_CELLS, TILE_CELLS), 1).reshape(-1)
    within = CELL_SIZE * (points[:, :2] / np.float32(CELL_SIZE) % 1.0)
    for axis, step in ((0, 1), (1, wide)):
        for depth, across in ((within[:, axis], -step), (CELL_SIZE - within[:, axis], step)):
            deep = np.bincount(cells[depth > NOISE_RULE.near_m], minlength=CELLS)
            near = filled[deep[filled] <= NOISE_RULE.stay_share * count[filled]]
            beside = held[(near // TILE_CELLS + 1) * wide + near % TILE_CELLS + 1 + across]
            is_beside[near[beside > count[near]]] = True
    return is_beside


def _on_planes(points: F32, tested: I64, first: I64, cells: I64) -> F64:
    """(k, 3) the points ``tested`` (k,), each moved onto the upright plane through those about it, where there
    is one and it is near."""
    about = points[tested].astype(np.float64)
    n = np.zeros(len(tested), np.int64)
    mean = np.zeros((len(tested), 3))
    spread = np.zeros((len(tested), 3, 3))
    _moments(points, tested, first, cells, n, mean, spread)
    variance, axes = np.linalg.eigh(spread)
    normal = axes[:, :, 0]
    plane = (
        (n >= NOISE_RULE.enough_points)
        & (variance[:, 1] > NOISE_RULE.flat * variance[:, 0])
        & (np.abs(normal[:, 2]) < NOISE_RULE.upright)
    )
    off = (mean * normal).sum(axis=1)
    plane &= np.abs(off) <= NOISE_RULE.near_m
    return np.asarray(about + np.where(plane, off, 0.0)[:, None] * normal)


@kernel
def _moments(points: F32, tested: I64, first: I64, cells: I64, number: I64, mean: F64, spread: F64) -> None:
    """Into zeros: ``number`` (k,), ``mean`` (k, 3) from the point itself and covariance ``spread`` (k, 3, 3) of the
    points within REACH_M of each of ``tested`` (k,). ``points`` (m, 3) in the order of their ``cells`` (m,);
    ``first`` (65537,) of each cell."""
    reach = int(np.ceil(REACH_M / CELL_SIZE))
    for k in range(len(tested)):
        point = tested[k]
        row, col = divmod(cells[tested[k]], TILE_CELLS)
        for r in range(max(row - reach, 0), min(row + reach + 1, TILE_CELLS)):
            left = max(col - reach, 0)
            right = min(col + reach, TILE_CELLS - 1)
            for i in range(first[r * TILE_CELLS + left], first[r * TILE_CELLS + right + 1]):
                x = np.float64(points[i, 0]) - np.float64(points[point, 0])
                y = np.float64(points[i, 1]) - np.float64(points[point, 1])
                z = np.float64(points[i, 2]) - np.float64(points[point, 2])
                if x * x + y * y + z * z <= REACH_M**2:
                    number[k] += 1
                    for a, u in enumerate((x, y, z)):
                        mean[k, a] += u
                        for b, v in enumerate((x, y, z)):
                            spread[k, a, b] += u * v
        for a in range(3):
            mean[k, a] /= number[k]
        for a in range(3):
            for b in range(3):
                spread[k, a, b] = spread[k, a, b] / number[k] - mean[k, a] * mean[k, b]
