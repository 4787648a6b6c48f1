"""What one scan says of each cell, before any open sentence of the paper is read: 16 bits.

How many points, who could see the cell under every rule of sight, whether the map is too tall there. Every reading of
the paper is a look-up in a table of these words (detection/paper.py): kept, they answer all readings without the scan.
"""

from __future__ import annotations

import numba
import numpy as np

from mapvote.config import PaperSettings
from mapvote.core.columns import below_top, span_of
from mapvote.core.grid import CELL_SIZE, Grid, window_around
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I32, U8, U16, U64, Bool, Reference
from mapvote.perception.frontend import Observation
from mapvote.perception.raycast import ScanView, Sight, cast_rays

MOST_POINTS = 15
"""Points are counted up to here: Eq. (1) has reached its bound."""
CLEAR, CLEAR_OF_CELLS, BEFORE_FARTHEST, THROUGH_COLUMN, FIRED = (1 << k for k in range(4, 9))
"""Nothing above the ground before the cell; nothing in an occupied cell; not behind the farthest return; a ray through
the heights in which the map has points; any ray that way at all. Movers hide what is behind them."""
WITHOUT_MOVERS = 5
"""The same five, this many bits higher, of the scan without the points of moving objects."""
BEGINS_ABOVE, REACHES_HIGHER = 1 << 14, 1 << 15
"""The map begins above the sensor's view at that range; it reaches higher than the scan's points."""
WORDS = 1 << 16
_BEHIND, _CLEAR, _NEVER = np.uint8(Sight.BEHIND), np.uint8(Sight.CLEAR), np.uint8(Sight.NEVER)


LEVEL = np.array([0.0, 0.0, 1.0])


@numba.njit(cache=True, nogil=True)
def _of_sight(sight: U8, clear_of_cells: U8, passed: U64, occupied: U64, shift: int, words: U16) -> None:
    """The five bits of one view into ``words``, in place; all planes (rows, cols)."""
    for r in range(sight.shape[0]):
        for c in range(sight.shape[1]):
            if sight[r, c] == _NEVER:
                continue
            word = FIRED
            if sight[r, c] >= _BEHIND:
                word |= BEFORE_FARTHEST
            if sight[r, c] == _CLEAR:
                word |= CLEAR
            if clear_of_cells[r, c] == _CLEAR:
                word |= CLEAR_OF_CELLS
            if (span_of(occupied[r, c]) & passed[r, c] != 0) if occupied[r, c] else sight[r, c] >= _BEHIND:
                word |= THROUGH_COLUMN
            words[r, c] |= np.uint16(word << shift)


@numba.njit(cache=True, nogil=True)
def _of_points(
    counts: I32, hit: U64, occupied: U64, bottom_z: F32, eye: tuple[F64, F64], x0: float, y0: float, tan_top: float,
    words: U16,
) -> None:  # fmt: skip
    """``eye``: the sensor's place and its upward axis, (3,) each."""
    origin, up = eye
    for r in range(counts.shape[0]):
        for c in range(counts.shape[1]):
            word = min(counts[r, c], MOST_POINTS)
            if occupied[r, c]:
                dx, dy = x0 + (c + 0.5) * CELL_SIZE - origin[0], y0 + (r + 0.5) * CELL_SIZE - origin[1]
                dz = bottom_z[r, c] - origin[2]
                above = dx * up[0] + dy * up[1] + dz * up[2]  # as the sensor leans, not as the world lies
                if above > tan_top * np.sqrt(max(dx * dx + dy * dy + dz * dz - above * above, 0.0)):
                    word |= BEGINS_ABOVE
            if occupied[r, c] > below_top(hit[r, c]):
                word |= REACHES_HIGHER
            words[r, c] |= np.uint16(word)


def encode(
    view: ScanView,
    reference: Reference,
    origin_map: F64,
    sensor: Sensor,
    clear_of_cells: U8 | None = None,
    without_movers: tuple[ScanView, U8] | None = None,
    up_map: F64 = LEVEL,
) -> U16:
    """(rows, cols) words of one scan seen from ``origin_map`` (3,), map metres, by a sensor with the upward axis
    ``up_map`` (3,).

    ``clear_of_cells``: the :class:`Sight` of each cell where only occupied cells hide; ``without_movers``: view and
    that sight of the scan without its movers. What is not given is taken to be like the rest.
    """
    words = np.zeros(view.counts.shape, dtype=np.uint16)
    tan_top, grid = float(np.tan(np.radians(sensor.fov_top_deg))), view.grid
    _of_points(
        view.counts,
        view.hit,
        reference.occupied,
        reference.bottom_z,
        (origin_map, up_map),
        grid.x0,
        grid.y0,
        tan_top,
        words,
    )
    cells = view.sight if clear_of_cells is None else clear_of_cells
    _of_sight(view.sight, cells, view.passed, reference.occupied, 0, words)
    still, still_cells = (view, cells) if without_movers is None else without_movers
    _of_sight(still.sight, still_cells, still.passed, reference.occupied, WITHOUT_MOVERS, words)
    return words


def sightings(seen: Observation, sensor: Sensor, n_min: int, asked: PaperSettings | None = None) -> U16:
    """(rows, cols) words over the view's grid; only those bits are worked out that the reading ``asked`` looks at, or
    all of them. ``n_min``: points that make a cell occupied, for what hides where only occupied cells do."""
    by_cells = asked is None or asked.line_of_sight == "cells"
    removed = asked is None or asked.movers == "removed"
    everything = np.ones(len(seen.moving), dtype=np.bool_)
    cells = _clear_of_cells(seen, everything, n_min) if by_cells else None
    without = None
    if removed:
        still = ~seen.moving
        view = _cast(seen, still, seen.scan.obstacle)
        without = view, _clear_of_cells(seen, still, n_min) if by_cells else view.sight
    words = encode(seen.view, seen.reference, seen.scan.origin_map, sensor, cells, without, seen.scan.up_map)
    if asked is not None:
        words[~votes_in(seen.view.grid, seen.scan.origin_map, asked.window_m)] = 0
    return words


def votes_in(grid: Grid, origin_map: F64, window_m: float) -> Bool:
    """(rows, cols) of ``grid``: the cells of the square of ``window_m`` around the vehicle."""
    inner = window_around(grid.lattice, float(origin_map[0]), float(origin_map[1]), window_m).intersection(grid)
    out = np.zeros(grid.shape, dtype=np.bool_)
    out[inner.slices_in(grid)] = True
    return out


def _clear_of_cells(seen: Observation, chosen: Bool, n_min: int) -> U8:
    """Sight where only those returns hide what is behind them that lie in cells with n_min obstacle points or more."""
    scan = seen.scan
    counted = chosen & scan.obstacle & (scan.cell >= 0)
    counts = np.bincount(scan.cell[counted], minlength=seen.reference.counts.size)
    return _cast(seen, chosen, counted & (counts[scan.cell] >= n_min)).sight


def _cast(seen: Observation, chosen: Bool, obstacle: Bool) -> ScanView:
    """The rays of the ``chosen`` points (n,) alone; ``obstacle`` (n,): those that hide what is behind them."""
    scan, still = seen.scan, np.zeros(int(chosen.sum()), dtype=np.bool_)
    points, cell = scan.points_map[chosen], scan.cell[chosen]
    return cast_rays(points, scan.origin_map, obstacle[chosen], still, seen.reference, cell)
