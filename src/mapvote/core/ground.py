"""The ground: the surface that vehicles drive on. It grows from where it is known: cell by cell over what was measured,
across gaps by what lies around them.

Known first is the road under the driven path, or the places of a map that all measurements around agree on. From there
the surface goes on to the nearest point of each neighbouring cell, as long as it climbs and falls as ground does.
Points below such a surface are reflections, points above it stand on it: neither kind is examined again. Measured cells
are entered before gaps and narrow gaps before wide ones, so a way round is taken before a leap. Where driven paths lie
above each other, every cell belongs to the level whose path is nearer, and a cell under both to the lower.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from mapvote.core.columns import lower_envelope
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS, TileIndex
from mapvote.core.kernel import inlined, kernel
from mapvote.core.record import record
from mapvote.core.types import F32, I32, I64, U8, read_only


@record(votes=True)
@dataclass(frozen=True, slots=True)
class GroundLaying:
    """Numbers of the places from which the ground grows, and of its extent."""

    known_m: float = 3.0
    """Distance from measured ground beyond which the ground is unknown."""
    bridged_m: float = 1.2
    """Distance from measured ground beyond which lower ground may still be found: a yard, an underpass."""
    grade: float = 0.15
    """Steepest ground that counts as agreeing, metres per metre; a steeper surface stands on the ground."""
    around_cells: int = 7
    """Cells to each side of a cell, 2.1 m, that must agree before the ground may start from it."""
    agreeing: float = 0.5
    """Share of the measured ones of these cells that must agree."""
    min_agreeing: int = 2
    """Number of these cells that must agree."""
    min_agreeing_off_road: int = 30
    """The same number where a driven path has shown the ground: apart from it many points are reflections."""
    few_tiles: int = 64
    """Tiles that a map may have beside one for each ``points_a_tile``; more are a street with strays, or not in metres:
    then sparse tiles have no ground, and memory grows with points, not with extent."""
    points_a_tile: int = 4000
    """Points that justify one more tile."""
    points_around: int = 1000
    """Points of a tile and its eight neighbours below which it is sparse."""
    near_tiles: int = 128
    """Planes kept, of 256 kB, while the windows around neighbouring tiles are read: three rows of them and more."""
    levelled: int = 16
    """Rounds in which the ground of a gap becomes the mean of the cells around: enough for gaps of some cells."""


GROUND_LAYING = GroundLaying()
GAP_STEP_M = 0.5 * CELL_SIZE
"""Unit of a gap's width: a cell is 2 units straight on, 3 across a corner (chamfer 2-3; Borgefors 1986)."""


@record(votes=True)
@dataclass(frozen=True, slots=True)
class GroundGrowth:
    """Numbers by which the ground grows from cell to cell. Its unit of distance is ``GAP_STEP_M``."""

    widest: int = 100
    """Widest gap that the ground crosses, units: 15 m."""
    near_cells: int = 5
    """Cells within which ground bounds the height of a point from above and below: 1.5 m."""
    noise_m: float = 0.06
    """Noise of a voxel's mean height, metres: range and pose noise, a cobble."""
    climb: float = 0.15
    """Steepest rise of ground, metres per metre; a steeper one is an object."""
    fall: float = 0.5
    """Steepest fall of ground, metres per metre; beyond ``climb`` it must be a broad one."""
    broad: int = 14
    """Cells of the 24 around at a like height, before a point off the expected ground is ground: a steep fall, a kerb's
    step up, a surface between measurements that contradict each other. Reflections make patches of 12."""
    kerb_m: float = 0.2
    """Rise of a step above a slope up to which it is ground, metres: a kerb."""
    higher_around: int = 4
    """Cells of the 8 around that lie higher behind a kerb, at least; before it there are 3."""
    open_m: float = 1.0
    """Free height above a kerb, metres: a car's underside has none."""
    beyond_gap: int = 2
    """Cells of the 24 around with points at a like height, before the ground goes on beyond a gap."""


GROUND_GROWTH = GroundGrowth()
# Kernels take no records: they read these names.
WIDEST = GROUND_GROWTH.widest
UNREACHED = 255
"""Gap of a cell that the ground never came to."""
SEED = 254
"""Gap of a cell from which it shall grow."""
_NEAR_CELLS = GROUND_GROWTH.near_cells
_AWAY_M = CELL_SIZE * np.sqrt(sum(axis**2 for axis in np.indices((2 * _NEAR_CELLS + 1,) * 2) - _NEAR_CELLS))
"""(11, 11) distances of the cells near by."""
_NOISE_M = GROUND_GROWTH.noise_m
_CLIMB = GROUND_GROWTH.climb
_FALL = GROUND_GROWTH.fall
_BROAD = GROUND_GROWTH.broad
_KERB_M = GROUND_GROWTH.kerb_m
_MOST_AROUND = GROUND_GROWTH.higher_around
_OPEN_M = GROUND_GROWTH.open_m
_BEYOND_GAP = GROUND_GROWTH.beyond_gap

Heights = tuple[I64, F32]
"""(flat cell within its tile (n,), height (n,) in map metres) of points."""


def lay_ground(
    points: Mapping[TileIndex, Heights],
    road: Mapping[TileIndex, Heights],
    n_points: Mapping[TileIndex, int],
    numbers: GroundLaying = GROUND_LAYING,
) -> dict[TileIndex, F32]:
    """Height of the ground in every cell of every tile, (256, 256) float32 map metres, NaN where unknown.

    ``n_points``: number of points of each tile. ``road``: the height of the road under driven paths. The ground grows
    from there (:func:`grow`). In places that it does not reach, and in maps without a driven path, it starts from cells
    that the measured cells around agree with and above which nothing rises as gently as ground. Tiles are read one by
    one, in ascending order: a large map holds only its heights in memory, and no cell of sparse tiles.
    """
    # The heights of all tiles with enough points.
    tiles = _populated(n_points, numbers)
    start, heights = _by_cell((points[tile] for tile in tiles), len(tiles))
    ground = np.full(len(tiles) * CELLS, np.nan, dtype=np.float32)
    gap = np.full(len(tiles) * CELLS, UNREACHED, dtype=np.uint8)
    neighbours = tiles_around(tiles)
    # The ground grows from the road, then from cells that their surroundings agree with.
    for k, tile in enumerate(tiles):
        if tile in road:
            cells, z = _lowest_of_each(*road[tile])
            ground[k * CELLS + cells] = z
            gap[k * CELLS + cells] = SEED
    if road:
        grow(start, heights, neighbours, ground, gap)
    least = numbers.min_agreeing_off_road if road else numbers.min_agreeing
    _sow(start, heights, neighbours, ground, gap, least, numbers)
    grow(start, heights, neighbours, ground, gap)
    ground[gap > numbers.known_m / GAP_STEP_M] = np.nan
    settled = settle(start, heights, neighbours, ground, gap, numbers)
    laid = dict(zip(tiles, settled.reshape(-1, TILE_CELLS, TILE_CELLS), strict=True))
    unknown = read_only(np.full((TILE_CELLS, TILE_CELLS), np.nan, dtype=np.float32))
    return laid if len(tiles) == len(points) else dict.fromkeys(points, unknown) | laid


def _populated(n_points: Mapping[TileIndex, int], numbers: GroundLaying) -> list[TileIndex]:
    """The tiles with enough points for ground, in ascending order."""
    tiles = sorted(n_points)
    if len(tiles) <= numbers.few_tiles + sum(n_points.values()) // numbers.points_a_tile:
        return tiles
    around = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    least = numbers.points_around
    return [(r, c) for r, c in tiles if sum(n_points.get((r + i, c + j), 0) for i, j in around) >= least]


def _by_cell(points: Iterable[Heights], tiles: int) -> tuple[I32 | I64, F32]:
    """(start (cells + 1,), heights (n,)): flat cell c has the points heights[start[c]:start[c + 1]], lowest first."""
    start: I32 | I64 = np.zeros(tiles * CELLS + 1, dtype=np.int32)
    heights = np.empty(0, dtype=np.float32)
    n = 0
    for k, (cells, z) in enumerate(points):
        if n + len(z) > np.iinfo(start.dtype).max:
            start = start.astype(np.int64)
        # Resized, not concatenated: nothing is there twice.
        heights.resize(n + len(z), refcheck=False)
        heights[n:] = _sorted_by_cell(cells, z)
        start[k * CELLS + 1 : (k + 1) * CELLS + 1] = n + np.cumsum(np.bincount(cells, minlength=CELLS))
        n += len(z)
    return start, heights


def _sorted_by_cell(cells: I64, z: F32) -> F32:
    """Heights (n,) of the points of one cell (n,) after the other, lowest first: cell and height make one number, for
    numbers are sorted in a tenth of the time that pairs take."""
    bits = z.view(np.int32)
    rank = bits ^ ((bits >> 31) & np.int32(0x7FFFFFFF))  # floats as integers of the same order; of itself the inverse
    both = np.sort((cells << 32) + rank)
    rank = (both - ((both + (1 << 31)) >> 32 << 32)).astype(np.int32)
    return (rank ^ ((rank >> 31) & np.int32(0x7FFFFFFF))).view(np.float32)


def _lowest_of_each(cells: I64, z: F32) -> Heights:
    """The lowest point of each cell; where vehicles drove above each other, the road below is kept."""
    order = np.lexsort((z, cells))
    first = np.flatnonzero(np.diff(cells[order], prepend=-1))
    return cells[order][first], z[order][first]


def _sow(
    start: I32 | I64, heights: F32, neighbours: I32, ground: F32, gap: U8, least: int, numbers: GroundLaying
) -> None:
    """Seeds: cells whose lowest point most cells around agree with, and which no lower ground explains as objects.

    Arguments as :func:`grow`. Seeds do not count as known ground here: no plane below changes on the way.
    """
    around_cells = numbers.around_cells
    grade = numbers.grade
    nothing = np.full((TILE_CELLS, TILE_CELLS), np.inf, dtype=np.float32)
    near = slice(TILE_CELLS - around_cells, 2 * TILE_CELLS + around_cells)
    thirds = [slice(k * TILE_CELLS, (k + 1) * TILE_CELLS) for k in range(3)]
    unmeasured = gap > numbers.bridged_m / GAP_STEP_M

    @lru_cache(maxsize=numbers.near_tiles)
    def low(tile: int) -> F32:
        """(256, 256) the lowest point of each cell without measured ground nearby, inf where there is none."""
        first = start[tile * CELLS : (tile + 1) * CELLS + 1]
        has_points = (first[:-1] < first[1:]) & unmeasured[tile * CELLS : (tile + 1) * CELLS]
        plane = nothing.reshape(-1).copy()
        plane[has_points] = heights[first[:-1][has_points]]
        return plane.reshape(nothing.shape)

    @lru_cache(maxsize=numbers.near_tiles)
    def known_ground(tile: int) -> F32:
        """(256, 256) the ground that is known, inf elsewhere."""
        cells = slice(tile * CELLS, (tile + 1) * CELLS)
        return np.where(unmeasured[cells], np.inf, ground[cells]).reshape(nothing.shape)

    @lru_cache(maxsize=numbers.near_tiles)
    def supported(tile: int) -> F32:
        if not np.isfinite(low(tile)).any():
            return nothing
        around = np.block([[low(j) if j >= 0 else nothing for j in row] for row in neighbours[tile].tolist()])
        out = np.empty_like(nothing)
        window = np.ascontiguousarray(around[near, near])
        _support(window, around_cells, grade * CELL_SIZE, numbers.agreeing, least, out)
        return out

    # Supported cells that the lower envelope of all ground around does not explain as objects.
    envelope = np.empty((3 * TILE_CELLS, 3 * TILE_CELLS))
    for k in range(len(neighbours)):
        if np.isfinite(supported(k)).any():
            for i, row in enumerate(neighbours[k].tolist()):
                for j, tile in enumerate(row):
                    envelope[thirds[i], thirds[j]] = (
                        np.minimum(supported(tile), known_ground(tile)) if tile >= 0 else np.inf
                    )
            lower_envelope(envelope, grade * CELL_SIZE, grade * CELL_SIZE * np.sqrt(2.0))
            lies = np.isfinite(supported(k)) & (supported(k) <= envelope[thirds[1], thirds[1]] + 0.1)
            cells = k * CELLS + np.flatnonzero(lies)
            ground[cells] = heights[start[cells]]
            gap[cells] = SEED


@kernel
def _support(low: F32, reach: int, grade: float, share: float, least: int, out: F32) -> None:
    """Enter into ``out`` the plane ``low`` without a rim of ``reach`` cells, and without the cells (inf instead) that
    too few of the known cells within ``reach`` agree with.

    Agreement: within 0.3 m, and ``grade`` (metres per cell) times the distance more; by at least ``least`` cells and a
    ``share`` of them. Reflections below the road come singly or in small clusters far below all
    others, and the envelope would follow each down a cone.
    """
    rows, cols = low.shape
    plenty = share * (2 * reach + 1) ** 2
    for r in range(reach, rows - reach):
        for c in range(reach, cols - reach):
            out[r - reach, c - reach] = np.inf
            if not np.isfinite(low[r, c]):
                continue
            known = 0
            agree = 0
            for i in range(r - reach, r + reach + 1):
                for j in range(c - reach, c + reach + 1):
                    if np.isfinite(low[i, j]):
                        known += 1
                        apart = max(abs(i - r), abs(j - c))
                        if abs(np.float64(low[i, j]) - np.float64(low[r, c])) <= CELL_SIZE + grade * apart:
                            agree += 1
                if agree >= plenty and agree > least:
                    break
            if agree > least and agree >= share * known:  # the cell itself is one of them
                out[r - reach, c - reach] = low[r, c]


@inlined
def _cell_at(tile: int, row: int, col: int, neighbours: I32) -> int:
    """Flat cell of (row, col) counted from a tile's corner; -1 if it lies in a tile that the map does not have."""
    down = row // TILE_CELLS
    right = col // TILE_CELLS
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
    low = -np.inf
    steep = -np.inf
    high = np.inf
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
    found = 0
    within = _is_within(row, col, 2)
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
        low = expected - _NOISE_M - _CLIMB * GAP_STEP_M * width
        high = expected + _NOISE_M + _CLIMB * GAP_STEP_M * width
        steep = low
    best = np.nan
    falls = np.nan
    rises = np.nan
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
    grade = _CLIMB
    below = np.inf
    clear = 0.0
    least = _BROAD if near else _BEYOND_GAP
    if not np.isfinite(best):
        best = rises
        clear = _OPEN_M
        least = _BROAD
        if np.isfinite(falls):
            best = falls
            grade = _FALL
            below = low
            clear = 0.0
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
        ground[cell] = measured
        gap[cell] = 0
    else:
        ground[cell] = z
        gap[cell] = width


def grow(start: I32 | I64, heights: F32, neighbours: I32, ground: F32, gap: U8) -> None:
    """Let the ground grow from where it is known to lie: cells whose ``gap`` is SEED, at the height ``ground``.

    ``heights[start[c]:start[c + 1]]`` are the points of flat cell c = tile * CELLS + row * TILE_CELLS + col, metres;
    ``neighbours`` (tiles, 3, 3) the tiles around each, -1 where the map has none. In place: ``ground`` (cells,) metres,
    ``gap`` (cells,) the distance to measured ground in units of GAP_STEP_M, UNREACHED where ground did not come.

    Seeds are all entered before any of them is left: only the rim of what they cover waits in the queue.
    """
    seeds = np.flatnonzero(gap == SEED)
    waits = np.full(len(gap), UNREACHED, np.uint8)
    waits[seeds] = 0
    queue = tuple(np.empty(1024, kind) for kind in (np.int64, np.float32, np.int32))
    ends = np.full((2, WIDEST + 4), -1, np.int32)
    state = np.array([0, -1, 0, 0], dtype=np.int64)
    _enter_seeds(seeds, start, heights, neighbours, ground, gap)
    while not _grow(start, heights, neighbours, ground, gap, waits, *queue, ends, state):
        queue = tuple(np.concatenate([part, np.empty_like(part)]) for part in queue)  # it was full


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
    first = ends[0]
    last = ends[1]
    n = state[0]
    spare = state[1]
    looked_at = state[2]
    width = state[3]
    while width <= WIDEST:
        if n + 8 > len(cells):
            state[0] = n
            state[1] = spare
            state[2] = looked_at
            state[3] = width
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
            following[entry] = spare
            spare = entry
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
                    free = spare
                    spare = following[spare]
                else:
                    free = n
                    n += 1
                cells[free] = other
                expected[free] = ground[cell]
                _append(first, first, last, following, farther, free)
                width = min(width, farther)
    return True


def settle(
    start: I32 | I64, heights: F32, neighbours: I32, ground: F32, gap: U8, numbers: GroundLaying = GROUND_LAYING
) -> F32:
    """(cells,) the ``ground`` without the preference of the side it grew from, metres: it grows from the road, so that
    doubtful cells at a kerb came out as low as the gutter. Arguments as :func:`grow`."""
    settled = ground.copy()
    gaps = np.flatnonzero((gap > 0) & np.isfinite(ground))
    level = np.empty(len(gaps), np.float32)
    for _ in range(2):  # a cell between a gap and the gutter sees how high the gap lies the second time
        _raise_at_kerbs(start, heights, neighbours, ground, gap, settled.copy(), settled)
        for _ in range(numbers.levelled):
            _level(gaps, neighbours, settled, level)
            settled[gaps] = level
    return settled


@kernel
def _raise_at_kerbs(
    start: I32 | I64, heights: F32, neighbours: I32, ground: F32, gap: U8, around: F32, out: F32
) -> None:
    """Raise measured cells behind kerbs, into ``out`` (cells,). Where a cell ``around`` is up to a kerb higher, the
    cell lies at its own points that are as much higher if they outnumber those at its ``ground``, and halfway if they
    are as many. A cell with a single point lies at the mean of the cells around if most of them are higher. A pose
    error brings points of the gutter into the first cell behind a kerb."""
    for cell in range(len(ground)):
        if gap[cell] > 0:
            continue
        z = ground[cell]
        here = 0
        there = 0
        raised = 0.0
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
        above = 0
        level = 0.0
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
    """Enter into ``out`` (n,) the mean height of each of the ``cells`` and of those around it that are at most a kerb
    higher or lower: over a gap between kerb and gutter the ground slopes, and is off by half the kerb at most."""
    for k in range(len(cells)):
        cell = cells[k]
        tile, row, col = _placed(cell)
        within = _is_within(row, col, 1)
        known = 0
        total = 0.0
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
