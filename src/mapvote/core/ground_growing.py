"""Ground grows from where it is known: cell by cell over what was measured, across gaps by what lies around them.

Known first is the road under the driven path, or the places of a map that all measurements around agree on. From
there the surface goes on to the nearest point of each neighbouring cell, as long as it climbs and falls as ground does.
What lies below a surface so found is a reflection, what lies above it stands on it: neither is ever asked. Measured
cells are entered before gaps and narrow gaps before wide ones, so a way round is taken before a leap. Where driven
paths lie above each other, every cell belongs to the level whose path is nearer, and a cell under both to the lower.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS, TileIndex
from mapvote.core.kernel import inlined, kernel
from mapvote.core.types import F32, I32, I64, U8

STEP_M = 0.5 * CELL_SIZE
"""Unit of a gap's width: a cell is 2 units straight on, 3 across a corner (chamfer 2-3; Borgefors 1986)."""
WIDEST = 100
"""Units: 15 m. Ground does not go on across a wider gap."""
UNREACHED = 255
"""Gap of a cell that the ground never came to."""
SEED = 254
"""Gap of a cell from which it shall grow."""
_NEAR_CELLS = 5
"""Ground this near (1.5 m) bounds how high and how low a point may be."""
_ACROSS = np.arange(-_NEAR_CELLS, _NEAR_CELLS + 1)
_AWAY_M = CELL_SIZE * np.sqrt((_ACROSS**2)[:, None] + _ACROSS**2)
"""(11, 11) how far the cells near by are."""
_NOISE_M = 0.06
"""Of a voxel's mean height: range and pose noise, a cobble."""
_CLIMB, _FALL = 0.15, 0.5
"""Steepest ground, metres per metre. A steeper rise is a thing that stands there; a steep fall must be a broad one."""
_BROAD = 14
"""Cells of the 24 around at a like height, before what lies off the expected ground is ground: a steep fall, a kerb's
step up, a surface between measurements that contradict each other. Reflections make patches of 12."""
_KERB_M = 0.2
"""How much more than a slope a step up may rise and be ground: a kerb."""
_PASSES = 16
"""A gap's ground is the mean of what lies around, worked out so often: enough for gaps of some cells."""
_MOST_AROUND = 4
"""Of the 8 cells around: behind a kerb at least 4 lie higher, before it 3."""
_OPEN_M = 1.0
"""Room above what lies on a kerb: a car's underside has none."""
_BEYOND_GAP = 2
"""Cells of them that hold points at a like height, before the ground goes on beyond a gap."""


@inlined
def _cell_at(tile: int, row: int, col: int, neighbours: I32) -> int:
    """Flat cell of (row, col) counted from a tile's corner; -1 if it lies in a tile that the map does not have."""
    down, right = row // TILE_CELLS, col // TILE_CELLS
    other = neighbours[tile, down + 1, right + 1]
    return -1 if other < 0 else other * CELLS + (row - down * TILE_CELLS) * TILE_CELLS + col - right * TILE_CELLS


@inlined
def _is_within(row: int, col: int, margin: int) -> bool:
    """Whether all cells ``margin`` around one lie in its tile: then they are found by adding to its flat number, most
    of them, and quicker by far than by :func:`_cell_at`."""
    last = TILE_CELLS - margin
    return margin <= row < last and margin <= col < last


@inlined
def _placed(cell: int) -> tuple[int, int, int]:
    """(tile, row, col) of a flat cell."""
    return cell // CELLS, cell % CELLS // TILE_CELLS, cell % TILE_CELLS


@inlined
def _bounds(cell: int, ground: F32, gap: U8, neighbours: I32) -> tuple[float, float, float]:
    """(lowest, steeply lowest, highest) height of a point of this cell that continues the measured ground near by."""
    tile, row, col = _placed(cell)
    low, steep, high = -np.inf, -np.inf, np.inf
    within = _is_within(row, col, _NEAR_CELLS)
    for i in range(-_NEAR_CELLS, _NEAR_CELLS + 1):
        for j in range(-_NEAR_CELLS, _NEAR_CELLS + 1):
            other = cell + i * TILE_CELLS + j if within else _cell_at(tile, row + i, col + j, neighbours)
            if other >= 0 and gap[other] == 0:
                away = _AWAY_M[i + _NEAR_CELLS, j + _NEAR_CELLS]
                low = max(low, ground[other] - _CLIMB * away)
                steep = max(steep, ground[other] - _FALL * away)
                high = min(high, ground[other] + _CLIMB * away)
    return low - _NOISE_M, steep - _NOISE_M, high + _NOISE_M


@inlined
def _like(
    cell: int, z: float, grade: float, below: float, clear: float, start: I32 | I64, heights: F32, neighbours: I32
) -> int:
    """How many of the 24 cells around hold a point ``below`` and at the height ``z``, give or take noise and grade.

    Only points count that have no other within ``clear`` metres above them.
    """
    tile, row, col = _placed(cell)
    found, within = 0, _is_within(row, col, 2)
    for i in range(-2, 3):
        for j in range(-2, 3):
            other = cell + i * TILE_CELLS + j if within else _cell_at(tile, row + i, col + j, neighbours)
            if other < 0 or (i == 0 and j == 0):
                continue
            most = _NOISE_M + grade * CELL_SIZE * max(abs(i), abs(j))
            for k in range(start[other], start[other + 1]):
                alone = k + 1 == start[other + 1] or heights[k + 1] - heights[k] >= clear
                if abs(heights[k] - z) <= most and heights[k] < below and alone:
                    found += 1
                    break
    return found


@inlined
def _continued(
    cell: int, expected: float, width: int, start: I32 | I64, heights: F32, ground: F32, gap: U8, neighbours: I32
) -> float:
    """Height of the cell's point that continues the ground, the nearest to ``expected``; NaN if none does."""
    if start[cell] == start[cell + 1]:
        return np.nan
    low, steep, high = _bounds(cell, ground, gap, neighbours)
    near = np.isfinite(low)
    agreed = near and low <= high  # else what was measured lies on both sides of a kerb
    if not agreed:
        low, high = expected - _NOISE_M - _CLIMB * STEP_M * width, expected + _NOISE_M + _CLIMB * STEP_M * width
        steep = low
    best, falls, rises = np.nan, np.nan, np.nan
    for k in range(start[cell], start[cell + 1]):
        z = heights[k]
        if low <= z <= high and not abs(best - expected) <= abs(z - expected):
            best = z
        if steep <= z < low and not falls >= z:
            falls = z
        if near and high < z <= high + _KERB_M and not rises <= z:
            rises = z
    if agreed and abs(best - expected) <= _NOISE_M:
        return best
    grade, below, clear, least = _CLIMB, np.inf, 0.0, _BROAD if near else _BEYOND_GAP
    if not np.isfinite(best):
        best, clear, least = rises, _OPEN_M, _BROAD
        if np.isfinite(falls):
            best, grade, below, clear = falls, _FALL, low, 0.0
    if not np.isfinite(best):
        return np.nan
    alike = _like(cell, best, grade, below, clear, start, heights, neighbours)
    return best if alike >= least else np.nan


@inlined
def _append(queue: I32, first: I32, last: I32, following: I32, width: int, entry: int) -> None:
    """First in, first out among gaps of one width."""
    following[entry] = -1
    if first[width] < 0:
        first[width] = entry
    else:
        following[last[width]] = entry
    last[width] = entry


@kernel
def _enter(
    cell: int, z: float, width: int, start: I32 | I64, heights: F32, neighbours: I32, ground: F32, gap: U8
) -> None:
    """The ground comes to a cell: as it was measured there, else at the height ``z``, ``width`` from what was."""
    measured = _continued(cell, z, width, start, heights, ground, gap, neighbours)
    if np.isfinite(measured):
        ground[cell], gap[cell] = measured, 0
    else:
        ground[cell], gap[cell] = z, width


def grow(start: I32 | I64, heights: F32, neighbours: I32, ground: F32, gap: U8) -> None:
    """Let the ground grow from where it is known to lie: cells whose ``gap`` is SEED, at the height ``ground``.

    ``heights[start[c]:start[c + 1]]`` are the points of flat cell c = tile * CELLS + row * TILE_CELLS + col, metres;
    ``neighbours`` (tiles, 3, 3) the tiles around each, -1 where the map has none. In place: ``ground`` (cells,) metres,
    ``gap`` (cells,) the distance to measured ground in units of STEP_M, UNREACHED where ground did not come.

    Seeds are all entered before any of them is left: only the rim of what they cover waits in the queue.
    """
    seeds = np.flatnonzero(gap == SEED)
    waits = np.full(len(gap), UNREACHED, np.uint8)
    waits[seeds] = 0
    queue = np.empty(1024, np.int64), np.empty(1024, np.float32), np.empty(1024, np.int32)
    ends, state = np.full((2, WIDEST + 4), -1, np.int32), np.array([0, -1, 0, 0], dtype=np.int64)
    _enter_seeds(seeds, start, heights, neighbours, ground, gap)
    while not _grow(start, heights, neighbours, ground, gap, waits, *queue, ends, state):
        queue = (  # full
            np.concatenate([queue[0], np.empty_like(queue[0])]),
            np.concatenate([queue[1], np.empty_like(queue[1])]),
            np.concatenate([queue[2], np.empty_like(queue[2])]),
        )


@kernel
def _enter_seeds(seeds: I64, start: I32 | I64, heights: F32, neighbours: I32, ground: F32, gap: U8) -> None:
    for cell in seeds:
        _enter(cell, ground[cell], np.int64(1), start, heights, neighbours, ground, gap)


@kernel
def _grow(
    start: I32 | I64, heights: F32, neighbours: I32, ground: F32, gap: U8, waits: U8, cells: I64, expected: F32,
    following: I32, ends: I32, state: I64,
) -> bool:  # fmt: skip
    """:func:`grow` from the seeds, which are entered, until all is reached, or False once the queue is full.

    The queue: ``cells``, ``expected`` heights and the entry ``following`` each (n,), ``ends`` (2, widths) the first and
    last entry of each gap's width. ``waits`` (cells,): the narrowest gap over which each cell waits: who comes over as
    wide a one finds it entered. ``state`` (4,): entries, first spare one, cells looked at, width; for the next call.
    """
    first, last = ends[0], ends[1]
    n, spare, looked_at, width = state[0], state[1], state[2], state[3]
    while width <= WIDEST:
        if n + 8 > len(cells):
            state[0], state[1], state[2], state[3] = n, spare, looked_at, width
            return False
        if looked_at < len(gap):
            cell = looked_at
            looked_at += 1
            if waits[cell] != 0:  # no seed: what ground has grown from before it has grown from on all sides
                continue
        else:
            entry = first[width]
            if entry < 0:
                width += 1
                continue
            first[width] = following[entry]
            cell = cells[entry]
            following[entry], spare = spare, entry
            if gap[cell] <= width:
                continue
            _enter(cell, expected[entry], width, start, heights, neighbours, ground, gap)
        here = np.int64(gap[cell])
        tile, row, col = _placed(cell)
        within = _is_within(row, col, 1)
        for i in range(-1, 2):
            for j in range(-1, 2):
                other = cell + i * TILE_CELLS + j if within else _cell_at(tile, row + i, col + j, neighbours)
                farther = here + (2 if i == 0 or j == 0 else 3)
                if other < 0 or gap[other] <= farther or farther > WIDEST or waits[other] <= farther:
                    continue
                waits[other] = farther
                if spare >= 0:
                    free, spare = spare, following[spare]
                else:
                    free = n
                    n += 1
                cells[free], expected[free] = other, ground[cell]
                _append(first, first, last, following, farther, free)
                width = min(width, farther)
    return True


def settle(start: I32 | I64, heights: F32, neighbours: I32, ground: F32, gap: U8) -> F32:
    """(cells,) the ``ground`` without the preference of the side it grew from, metres: it grows from the road, and what
    is doubtful at a kerb came out as low as the gutter. Arguments as :func:`grow`."""
    settled = ground.copy()
    gaps = np.flatnonzero((gap > 0) & np.isfinite(ground))
    level = np.empty(len(gaps), np.float32)
    for _ in range(2):  # a cell between a gap and the gutter sees how high the gap lies the second time
        _raise_at_kerbs(start, heights, neighbours, ground, gap, settled.copy(), settled)
        for _ in range(_PASSES):
            _level(gaps, neighbours, settled, level)
            settled[gaps] = level
    return settled


@kernel
def _raise_at_kerbs(
    start: I32 | I64, heights: F32, neighbours: I32, ground: F32, gap: U8, around: F32, out: F32
) -> None:
    """Into ``out`` (cells,): where a cell ``around`` is up to a kerb higher, a measured cell lies at its own points
    that are as much higher if they outnumber those at its ``ground``, and halfway if they are as many; and at the
    mean of the cells around if a single point is all that it holds and most of them are higher. A pose error brings
    points of the gutter into the first cell behind a kerb."""
    for cell in range(len(ground)):
        if gap[cell] > 0:
            continue
        z = ground[cell]
        here, there, raised = 0, 0, 0.0
        for k in range(start[cell], start[cell + 1]):
            if abs(heights[k] - z) <= _NOISE_M:
                here += 1
            elif z < heights[k] <= z + _KERB_M:
                there += 1
                raised += heights[k]
        if here > max(there, 1):
            continue
        tile, row, col = _placed(cell)
        within = _is_within(row, col, 1)
        above, level = 0, 0.0
        for i in range(-1, 2):
            for j in range(-1, 2):
                other = cell + i * TILE_CELLS + j if within else _cell_at(tile, row + i, col + j, neighbours)
                if other >= 0 and _NOISE_M < around[other] - z <= _KERB_M + _NOISE_M:
                    above += 1
                    level += around[other]
        if there > 0 and above > 0:
            out[cell] = raised / there if there > here else 0.5 * (z + raised / there)
        elif above >= _MOST_AROUND:
            out[cell] = z + (level / above - z) * above / 8.0


@kernel
def _level(cells: I64, neighbours: I32, ground: F32, out: F32) -> None:
    """Into ``out`` (n,) the mean height of each of the ``cells`` and of those around it that are at most a kerb higher
    or lower: over a gap between kerb and gutter the ground slopes, and is off by half the kerb at most."""
    for k in range(len(cells)):
        cell = cells[k]
        tile, row, col = _placed(cell)
        within = _is_within(row, col, 1)
        known, total = 0, 0.0
        for i in range(-1, 2):
            for j in range(-1, 2):
                other = cell + i * TILE_CELLS + j if within else _cell_at(tile, row + i, col + j, neighbours)
                if other >= 0 and abs(ground[other] - ground[cell]) <= _KERB_M + _NOISE_M:
                    known += 1
                    total += ground[other]
        out[k] = total / known


def tiles_around(tiles: Sequence[TileIndex]) -> I32:
    """(tiles, 3, 3) where in ``tiles`` each tile's neighbours stand, itself in the middle; -1 for none."""
    place: Mapping[TileIndex, int] = {tile: k for k, tile in enumerate(tiles)}
    around = [[[place.get((r + i, c + j), -1) for j in (-1, 0, 1)] for i in (-1, 0, 1)] for r, c in tiles]
    return np.array(around, dtype=np.int32).reshape(-1, 3, 3)
