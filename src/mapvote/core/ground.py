"""The ground: the surface that vehicles drive on, and the layer at which each column begins (paper II)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import lru_cache

import numpy as np

from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS, TileIndex
from mapvote.core.ground import SEED, STEP_M, UNREACHED, grow, settle, tiles_around
from mapvote.core.kernel import inlined, kernel
from mapvote.core.types import F32, F64, I32, I64, U8, read_only

KNOWN_M = 3.0
"""Farther than this from any measured ground it is unknown."""
_BRIDGED_M = 1.2
"""Where the ground only leapt, this far from what was measured, it may yet be found lower: a yard, an underpass."""
_GRADE = 0.15
"""Steepest ground that counts as agreeing; anything steeper stands on the ground, metres per metre."""
_AROUND_CELLS = 7
_AGREEING = 0.5
"""Share of the measured cells within 2.1 m that must agree before the ground may start from a cell."""
_BROAD = 30
"""Cells of them that must, where a driven path has shown the ground: apart from it many points are reflections."""
_FEW_TILES, _POINTS_A_TILE, _POINTS_AROUND = 64, 4000, 1000
"""A map of more tiles than 64 and one for each 4000 points is a street with strays, or not in metres: where a tile and
its eight neighbours hold fewer than 1000 points its ground is unknown. So memory grows with points, not with extent."""
_NEAR_TILES = 128
"""Planes kept, of 256 kB, while the windows around neighbouring tiles are read: three rows of them and more."""

Heights = tuple[I64, F32]
"""(flat cell within its tile (n,), height (n,) in map metres) of points."""


def base_layers(ground_z: F32) -> I32:
    """(rows, cols) lattice layer of bit 0: floor(ground_z / 0.3), unknown cells filled from the nearest known one."""
    known = np.isfinite(ground_z)
    if not known.any():
        return np.zeros(ground_z.shape, dtype=np.int32)
    low = ground_z.astype(np.float64)
    if not known.all():
        low[~known] = np.inf
        _lower_envelope(low, 0.02 * CELL_SIZE, 0.02 * CELL_SIZE * np.sqrt(2.0))
        np.copyto(low, ground_z, where=known)
    return np.floor(low / CELL_SIZE).astype(np.int32)


@kernel
def _lower_envelope(z: F64, straight: float, diagonal: float) -> None:
    """Two-pass chamfer: z[c] = min over c' of z[c'] + grade * |c - c'|, in place (Borgefors 1986)."""
    rows, cols = z.shape
    for r in range(rows):
        if r > 0:
            _reach_from(z[r - 1], z[r], straight, diagonal)
        for c in range(1, cols):
            z[r, c] = min(z[r, c], z[r, c - 1] + straight)
    for r in range(rows - 1, -1, -1):
        if r + 1 < rows:
            _reach_from(z[r + 1], z[r], straight, diagonal)
        for c in range(cols - 2, -1, -1):
            z[r, c] = min(z[r, c], z[r, c + 1] + straight)


@inlined
def _reach_from(beside: F64, row: F64, straight: float, diagonal: float) -> None:
    """What a row takes from the one beside it: no cell waits for another, so the compiler makes vectors of it."""
    last = len(row) - 1
    for c in range(last + 1):
        row[c] = min(row[c], beside[c] + straight)
    for c in range(last):
        row[c] = min(row[c], beside[c + 1] + diagonal)
        row[c + 1] = min(row[c + 1], beside[c] + diagonal)


@kernel
def _support(low: F32, reach: int, grade: float, share: float, least: int, out: F32) -> None:
    """Into ``out`` ``low`` without a rim of ``reach`` cells, and without the cells (inf instead) that too few of the
    known cells within ``reach`` agree with.

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
            known, agree = 0, 0
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


def lay_ground(
    points: Mapping[TileIndex, Heights], road: Mapping[TileIndex, Heights], n_points: Mapping[TileIndex, int]
) -> dict[TileIndex, F32]:
    """Height of the ground in every cell of every tile, (256, 256) float32 map metres, NaN where unknown.

    ``n_points``: of each tile. ``road``: where vehicles drove, the height of the road under them. The ground grows
    from there (:mod:`mapvote.core.ground`). Where it does not come to, and in maps of which nobody knows the
    path, it starts from places that the measured cells around agree on and above which nothing rises as gently as
    ground. Tiles are read one by one, in ascending order: of a large map only the heights are held, and no cell of
    tiles that a few strays make (:data:`_POINTS_AROUND`).
    """
    tiles = _populated(n_points)
    start, heights = _by_cell((points[tile] for tile in tiles), len(tiles))
    ground = np.full(len(tiles) * CELLS, np.nan, dtype=np.float32)
    gap = np.full(len(tiles) * CELLS, UNREACHED, dtype=np.uint8)
    neighbours = tiles_around(tiles)
    for k, tile in enumerate(tiles):
        if tile in road:
            cells, z = _lowest_of_each(*road[tile])
            ground[k * CELLS + cells], gap[k * CELLS + cells] = z, SEED
    if road:
        grow(start, heights, neighbours, ground, gap)
    _sow(start, heights, neighbours, ground, gap, _BROAD if road else 2)
    grow(start, heights, neighbours, ground, gap)
    ground[gap > KNOWN_M / STEP_M] = np.nan
    settled = settle(start, heights, neighbours, ground, gap)
    laid = dict(zip(tiles, settled.reshape(-1, TILE_CELLS, TILE_CELLS), strict=True))
    unknown = read_only(np.full((TILE_CELLS, TILE_CELLS), np.nan, dtype=np.float32))
    return laid if len(tiles) == len(points) else dict.fromkeys(points, unknown) | laid


def _populated(n_points: Mapping[TileIndex, int]) -> list[TileIndex]:
    """The tiles whose ground is looked for, in ascending order."""
    tiles = sorted(n_points)
    if len(tiles) <= _FEW_TILES + sum(n_points.values()) // _POINTS_A_TILE:
        return tiles
    around = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return [(r, c) for r, c in tiles if sum(n_points.get((r + i, c + j), 0) for i, j in around) >= _POINTS_AROUND]


def _by_cell(points: Iterable[Heights], tiles: int) -> tuple[I32 | I64, F32]:
    """(start (cells + 1,), heights (n,)): flat cell c has the points heights[start[c]:start[c + 1]], lowest first."""
    start: I32 | I64 = np.zeros(tiles * CELLS + 1, dtype=np.int32)
    heights, n = np.empty(0, dtype=np.float32), 0
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


def _sow(start: I32 | I64, heights: F32, neighbours: I32, ground: F32, gap: U8, least: int) -> None:
    """Seeds: cells whose lowest point most cells around agree with, and which no lower ground explains as things.

    Arguments as :func:`mapvote.core.ground.grow`. What is sown here was not known before and is not called so
    yet: no plane below changes on the way.
    """
    nothing = np.full((TILE_CELLS, TILE_CELLS), np.inf, dtype=np.float32)
    near = slice(TILE_CELLS - _AROUND_CELLS, 2 * TILE_CELLS + _AROUND_CELLS)
    thirds = [slice(k * TILE_CELLS, (k + 1) * TILE_CELLS) for k in range(3)]
    unmeasured = gap > _BRIDGED_M / STEP_M

    @lru_cache(maxsize=_NEAR_TILES)
    def low(tile: int) -> F32:
        """(256, 256) the lowest point of each cell without measured ground nearby, inf where there is none."""
        first = start[tile * CELLS : (tile + 1) * CELLS + 1]
        asked = (first[:-1] < first[1:]) & unmeasured[tile * CELLS : (tile + 1) * CELLS]
        plane = nothing.reshape(-1).copy()
        plane[asked] = heights[first[:-1][asked]]
        return plane.reshape(nothing.shape)

    @lru_cache(maxsize=_NEAR_TILES)
    def known(tile: int) -> F32:
        """(256, 256) the ground that is known, inf elsewhere."""
        cells = slice(tile * CELLS, (tile + 1) * CELLS)
        return np.where(unmeasured[cells], np.inf, ground[cells]).reshape(nothing.shape)

    @lru_cache(maxsize=_NEAR_TILES)
    def supported(tile: int) -> F32:
        if not np.isfinite(low(tile)).any():
            return nothing
        around = np.block([[low(j) if j >= 0 else nothing for j in row] for row in neighbours[tile].tolist()])
        out, window = np.empty_like(nothing), np.ascontiguousarray(around[near, near])
        _support(window, _AROUND_CELLS, _GRADE * CELL_SIZE, _AGREEING, least, out)
        return out

    envelope = np.empty((3 * TILE_CELLS, 3 * TILE_CELLS))
    for k in range(len(neighbours)):
        if np.isfinite(supported(k)).any():
            for i, row in enumerate(neighbours[k].tolist()):
                for j, tile in enumerate(row):
                    envelope[thirds[i], thirds[j]] = np.minimum(supported(tile), known(tile)) if tile >= 0 else np.inf
            _lower_envelope(envelope, _GRADE * CELL_SIZE, _GRADE * CELL_SIZE * np.sqrt(2.0))
            lies = np.isfinite(supported(k)) & (supported(k) <= envelope[thirds[1], thirds[1]] + 0.1)
            cells = k * CELLS + np.flatnonzero(lies)
            ground[cells], gap[cells] = heights[start[cells]], SEED
