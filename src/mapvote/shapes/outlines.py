"""Changed cells as shapes on the lattice: connected pieces, buildings side by side, things, polygons.

Nothing here knows of tiles, so no tile border shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
import shapely

from mapvote.core.grid import CELL_SIZE
from mapvote.core.record import record
from mapvote.core.types import F64, I32, I64, Bool

Ring = I64
"""(n, 2) corners (col, row) of the lattice, closed: the first corner is repeated at the end."""


@dataclass(frozen=True, slots=True)
class Pieces:
    """Labels (n,) of n cells; numbers follow the cells' order, by row and then by column, of their first cell."""

    objects: I32
    """8-connected: what counts as one change."""
    polygons: I32
    """4-connected: what one polygon can cover, as two squares that meet at a corner are two polygons."""


def pieces(rows: I64, cols: I64, kinds: I64) -> Pieces:
    """Connected cells of the same kind; cells (n,) on the lattice, sorted by row, then column, each once."""
    key = _key(rows, cols)
    straight = [_pairs(key, kinds, rows + dr, cols + dc) for dr, dc in ((0, 1), (1, 0))]
    diagonal = [_pairs(key, kinds, rows + dr, cols + dc) for dr, dc in ((1, -1), (1, 1))]
    return Pieces(_labels(straight + diagonal, len(rows)), _labels(straight, len(rows)))


def rings(rows: I64, cols: I64, polygons: I32) -> list[list[Ring]]:
    """The outline of every 4-connected piece: first its outer ring, counter-clockwise, then its holes, clockwise.

    ``polygons`` (n,) are the labels of the cells, 0 ... k - 1. Rings are simple, turn at every corner and begin at
    their lowest, then leftmost corner: valid by RFC 7946 and OGC Simple Features, equal for equal cells.
    """
    squares = shapely.box(cols, rows, cols + 1, rows + 1)
    return [_outline(shapely.coverage_union_all(squares[own])) for own in members(polygons)]


def _outline(polygon: shapely.Polygon) -> list[Ring]:
    outer, *holes = shapely.get_rings(polygon)
    return [_ring(outer, True), *sorted((_ring(hole, False) for hole in holes), key=lambda hole: tuple(hole[0, ::-1]))]


def _ring(ring: shapely.LinearRing, counter_clockwise: bool) -> Ring:
    """The corners where a ring turns, in one sense of rotation, from the lowest, then leftmost on."""
    corners = shapely.get_coordinates(ring)[:-1].astype(np.int64)
    if shapely.is_ccw(ring) != counter_clockwise:
        corners = corners[::-1]
    turns = (np.roll(corners, 1, axis=0) != np.roll(corners, -1, axis=0)).all(axis=1)
    corners = corners[turns]
    corners = np.roll(corners, -np.lexsort(corners.T)[0], axis=0)
    return np.concatenate([corners, corners[:1]])


def members(labels: I32) -> list[I64]:
    """The indices of each label 0 ... k - 1, ascending."""
    return np.split(np.argsort(labels, kind="stable"), np.cumsum(np.bincount(labels))[:-1]) if len(labels) else []


def _key(rows: I64, cols: I64) -> I64:
    """One sortable number per cell: by row, then by column; indices within +-2^30."""
    key: I64 = (rows << np.int64(32)) + cols
    return key


def _find(sorted_keys: I64, wanted: I64) -> I64:
    """Index of each wanted key in ``sorted_keys``, -1 where it is missing."""
    at = np.minimum(np.searchsorted(sorted_keys, wanted), len(sorted_keys) - 1)
    return np.where(sorted_keys[at] == wanted, at, -1)


def _pairs(key: I64, kinds: I64, rows: I64, cols: I64) -> tuple[I64, I64]:
    """(i, j) of cells i whose neighbour at (rows, cols) is cell j of the same kind."""
    other = _find(key, _key(rows, cols))
    joined = np.flatnonzero((other >= 0) & (kinds[other] == kinds))
    return joined, other[joined]


def _labels(pairs: list[tuple[I64, I64]], n: int) -> I32:
    i = np.concatenate([a for a, _ in pairs])
    j = np.concatenate([b for _, b in pairs])
    graph = scipy.sparse.coo_array((np.ones(len(i), dtype=np.int8), (i, j)), shape=(n, n))
    _, labels = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return _in_order(labels)


@record()
@dataclass(frozen=True, slots=True)
class PieceRule:
    """Numbers by which changed cells are cut into objects and joined."""

    least_share: float = 0.2
    """Least share of the cells on either side of a cut: no wall is cut off its building."""
    cuts: int = 12
    """Cuts of one group of cells: each building of a row needs its own."""
    reach_m: float = 1.5
    """Largest distance of a piece from the hull of its object, metres: a gap that occlusion leaves in a wall."""
    part_share: float = 1 / 3
    """Size of a piece relative to its neighbour beyond which it is an object of its own, unless their hulls overlap:
    houses stand closer together than the walls of one house."""
    touch_cells: float = 1.0
    """Overlap of hulls up to which they only touch, cells: houses wall to wall."""
    wall_cells: int = 10
    """Least length of a slot, cells: 3 m."""
    slot_cells: int = 4
    """Greatest width of a slot, cells: 1.2 m, for two walls of one room are farther apart."""


PIECE_RULE = PieceRule()


def buildings(rows: I64, cols: I64, kinds: I64) -> Pieces:
    """Connected cells of one kind, see :func:`pieces`, cut between buildings that stand side by side."""
    cut = pieces(rows, cols, kinds)
    part = np.zeros(len(rows), dtype=np.int64)
    done: set[tuple[int, int]] = set()
    for turn in range(1, PIECE_RULE.cuts + 1):
        fresh = _cut_each(rows, cols, cut.objects, done)
        if not fresh.any():
            break
        part[fresh] += 1 << turn
        _, apart = np.unique(np.stack([kinds, part]), axis=1, return_inverse=True)
        cut = pieces(rows, cols, apart.reshape(-1))
    return cut


def _cut_each(rows: I64, cols: I64, objects: I32, done: set[tuple[int, int]]) -> Bool:
    """(n,) the cells on one side of the cut through each piece that has one. ``done``: pieces without, by their first
    cell and size, which need not be asked again."""
    fresh = np.zeros(len(rows), dtype=np.bool_)
    sizes = np.bincount(objects)
    for label in np.flatnonzero(sizes >= 2 * PIECE_RULE.wall_cells / PIECE_RULE.least_share):
        own = np.flatnonzero(objects == label)
        name = int(own[0]), len(own)
        if name in done:
            continue
        side = _beyond_cut(rows[own], cols[own])
        if side is None:
            done.add(name)
        else:
            fresh[own[side]] = True
    return fresh


def _beyond_cut(rows: I64, cols: I64) -> Bool | None:
    """(n,) the cells beyond the cut along the longest slot that has enough on either side; None without one."""
    margin = PIECE_RULE.slot_cells
    disk = np.hypot(*np.indices((margin + 1, margin + 1)) - margin // 2) <= margin / 2 + 0.25
    r = rows - rows.min() + margin
    c = cols - cols.min() + margin
    image = np.zeros((r.max() + margin + 1, c.max() + margin + 1), dtype=np.bool_)
    image[r, c] = True
    slots, count = scipy.ndimage.label(scipy.ndimage.binary_closing(image, disk) & ~image, np.ones((3, 3)))
    at = np.stack([r, c], axis=1).astype(np.float64)
    best: tuple[float, Bool] | None = None
    for k in range(1, count + 1):
        slot = np.argwhere(slots == k).astype(np.float64)
        if len(slot) < PIECE_RULE.wall_cells:
            continue
        middle, along, length, width = _line(slot)
        across = (at - middle) @ np.array([-along[1], along[0]])
        beyond = across > 0
        bridge = 0.5 * np.count_nonzero(np.abs(across) < 1)
        narrow = max(PIECE_RULE.wall_cells, bridge) <= length and width <= margin
        enough = PIECE_RULE.least_share <= beyond.mean() <= 1 - PIECE_RULE.least_share
        if narrow and enough and (best is None or length > best[0]):
            best = length, beyond
    return None if best is None else best[1]


def _line(cells: F64) -> tuple[F64, F64, float, float]:
    """(middle (2,), direction (2,), length, width) of cells (n, 2), in cells, along their principal axis."""
    middle = cells.mean(axis=0)
    along = np.linalg.svd(cells - middle, full_matrices=False)[2][0]
    offset = cells - middle
    length, width = (np.ptp(offset @ way) + 1.0 for way in (along, np.array([-along[1], along[0]])))
    return middle, along, float(length), float(width)


def group(rows: I64, cols: I64, kinds: I64, pieces: I32, reach_m: float = PIECE_RULE.reach_m) -> I32:
    """(n,) labels of things, 0 ... k - 1, of cells (n,) whose ``pieces`` are 8-connected and of one kind each.

    From the largest piece down, each joins the nearest thing of its kind within ``reach_m`` of whose convex hull it
    lies, or becomes one. A label's number follows the order of its first cell.
    """
    if not len(rows):
        return np.zeros(0, dtype=np.int32)
    each = members(pieces)
    corners = [_corners(rows[own], cols[own]) for own in each]
    low = np.array([c.min(axis=0) for c in corners])
    high = np.array([c.max(axis=0) for c in corners])
    size = np.array([len(own) for own in each])
    kind = np.array([kinds[own[0]] for own in each])
    owner = np.arange(len(each))
    reach = reach_m / CELL_SIZE
    leaders: dict[int, list[int]] = {int(k): [] for k in np.unique(kind)}
    hulls: dict[int, F64] = {}
    for piece in np.argsort(-size, kind="stable").tolist():
        same = np.array(leaders[int(kind[piece])], dtype=np.int64)
        near = same[((low[same] <= high[piece] + reach) & (high[same] >= low[piece] - reach)).all(axis=1)]
        gaps = [_gap(hulls[leader], corners[piece]) for leader in near.tolist()]
        fits = [
            (gap, leader)
            for gap, leader in zip(gaps, near.tolist(), strict=True)
            if gap < -PIECE_RULE.touch_cells or (gap <= reach and size[piece] <= PIECE_RULE.part_share * size[leader])
        ]
        if fits:
            owner[piece] = min(fits)[1]
        else:
            leaders[int(kind[piece])].append(piece)
            hulls[piece] = scipy.spatial.ConvexHull(corners[piece]).equations
    return _in_order(owner[pieces])


def widths_m(rows: I64, cols: I64, pieces: I32) -> F64:
    """(k,) metres: the narrowest gate that each piece (n,) labels 0 ... k - 1 would fit through, across a side of its
    convex hull."""
    return np.array([_width(_corners(rows[own], cols[own])) for own in members(pieces)]) * CELL_SIZE


def _width(corners: F64) -> float:
    across = corners @ scipy.spatial.ConvexHull(corners).equations[:, :2].T
    return float(np.ptp(across, axis=0).min())


def _corners(rows: I64, cols: I64) -> F64:
    """(4 n, 2) corners of cells, in cells."""
    lower = np.stack([cols, rows], axis=1).astype(np.float64)
    return np.concatenate([lower + corner for corner in np.array([(0, 0), (1, 0), (0, 1), (1, 1)])])


def _gap(hull: F64, corners: F64) -> float:
    """Cells from a convex hull (k, 3) to the nearest of some corners, beyond its farthest side; negative inside."""
    return float((corners @ hull[:, :2].T + hull[:, 2]).max(axis=1).min())


def _in_order(label: I64) -> I32:
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int32)
    rank[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
    return rank[inverse]
