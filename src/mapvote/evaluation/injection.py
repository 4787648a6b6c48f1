"""Changes injected into a real street (METHOD 4): the drive stays as recorded, the map is made to differ from it.

Built: the points of real things are cut out of the map, so that the drive shows something the map lacks. Demolished:
hollow boxes of points are put into the map where nothing stands, so that the map shows something that is not there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from mapvote.core.columns import GROUND_MARGIN_M, map_points, tile_points
from mapvote.core.grid import CELL_SIZE, Grid, tile_grid
from mapvote.core.types import F64, I64, U8, U64, Bool, CellState, PointMap, Reference
from mapvote.evaluation.metrics import ratio

APART_M = 6.0
"""Between the middles of two injected objects."""
NEAR_M = 1.5
"""Precision counts decided cells this close to an injection."""
SHOWN = 5
"""Points of all vehicles together that make a cell one that the drives show: n_min of the paper."""
_SIZES_M = ((2.4, 1.8), (4.2, 1.8), (3.0, 3.0))
_HEIGHTS_M = (1.5, 3.0)
_FEWEST_CELLS = 8


@dataclass(frozen=True, slots=True)
class Injected:
    """One injected object: ``kind`` "built" or "demolished", its ``cells`` (rows, cols) over the window."""

    kind: str
    middle: tuple[float, float]
    cells: Bool
    height_m: float


def choose_objects(
    reference: Reference, shown: I64, passed: Bool, count: int, rng: np.random.Generator
) -> list[Injected]:
    """``count`` objects of each kind at random places of the map's window, or fewer if no more fit.

    ``shown`` (rows, cols): above-ground points of all vehicles together in each cell; ``passed`` (rows, cols): cells
    that a vehicle's rays went through. Built: something real in a box, of which the cells count that the drives show.
    Demolished: a hollow box where neither map nor drives have anything and rays pass.
    """
    window, solid = reference.grid, reference.counts > 0
    vacant = ~solid & (shown == 0) & passed & np.isfinite(reference.ground_z)
    objects: list[Injected] = []
    for kind in ("built", "demolished"):
        candidates = np.argwhere(solid & (shown >= SHOWN) if kind == "built" else vacant)
        for row, col in candidates[rng.permutation(len(candidates))]:
            if sum(o.kind == kind for o in objects) == count:
                break
            x, y = window.x0 + (col + 0.5) * CELL_SIZE, window.y0 + (row + 0.5) * CELL_SIZE
            if any(np.hypot(x - o.middle[0], y - o.middle[1]) < APART_M for o in objects):
                continue
            length, width = _SIZES_M[int(rng.integers(len(_SIZES_M)))]
            box = _box(window, x, y, length, width)
            cells = box & solid if kind == "built" else box & ~_box(window, x, y, length - 1.2, width - 1.2)
            counted = cells & (shown >= SHOWN) if kind == "built" else cells
            free_around = bool(vacant[_box(window, x, y, length + 1.2, width + 1.2)].all())
            if np.count_nonzero(counted) >= _FEWEST_CELLS and (kind == "built" or free_around):
                objects.append(Injected(kind, (float(x), float(y)), cells, float(rng.uniform(*_HEIGHTS_M))))
    return objects


def _box(window: Grid, x: float, y: float, length: float, width: float) -> Bool:
    """(rows, cols) cells whose centres lie in an axis-parallel box around (x, y)."""
    cx, cy = window.centres()
    return (np.abs(cy - y) < 0.5 * width)[:, None] & (np.abs(cx - x) < 0.5 * length)[None, :]


def inject(point_map: PointMap, reference: Reference, objects: Sequence[Injected]) -> PointMap:
    """The map without the built objects' points and with the demolished ones' phantoms, one point a voxel.

    Known-free columns follow: what was cut out is free, as it would be had the object not stood there; where a phantom
    stands nothing is free. ``reference`` is the map's own, over the window of the objects.
    """
    window = reference.grid
    cut = np.zeros(window.shape, dtype=np.bool_)
    taken = np.zeros(window.shape, dtype=np.uint64)
    phantom = [np.zeros((0, 3))]
    for item in objects:
        if item.kind == "built":
            cut |= item.cells
            continue
        for row, col in np.argwhere(item.cells):
            base, ground = int(reference.base[row, col]), float(reference.ground_z[row, col])
            layers = np.arange(base + 2, int((ground + item.height_m) / CELL_SIZE) + 1)
            middle = np.array([window.x0 + (col + 0.5) * CELL_SIZE, window.y0 + (row + 0.5) * CELL_SIZE, 0.15])
            phantom.append(middle + np.outer(layers, [0.0, 0.0, CELL_SIZE]))
            taken[row, col] = np.bitwise_or.reduce(np.uint64(1) << (layers - base).clip(0, 63).astype(np.uint64))
    freed = np.where(cut, reference.occupied, np.uint64(0))
    return _edited(point_map, window, cut, freed, np.concatenate(phantom), taken)


def _edited(point_map: PointMap, window: Grid, cut: Bool, freed: U64, phantom: F64, taken: U64) -> PointMap:
    tiles = dict(point_map.tiles)
    for index, tile in point_map.tiles.items():
        grid = tile_grid(point_map.lattice, index)
        common = grid.intersection(window)
        if common.rows == 0 or common.cols == 0:
            continue
        here, there = common.slices_in(grid), common.slices_in(window)
        gone = np.zeros(grid.shape, dtype=np.bool_)
        gone[here] = cut[there]
        points = map_points(grid, tile.points)
        rows, cols, _ = grid.indices_of(points)
        low = points[:, 2] - tile.ground_z[rows, cols] < GROUND_MARGIN_M
        kept = tile.points[~gone[rows, cols] | low]
        mine = tile_points(grid, phantom[grid.indices_of(phantom)[2]])
        free = None if tile.free is None else tile.free.copy()
        if free is not None:
            free[here] = (free[here] | freed[there]) & ~taken[there]
        tiles[index] = replace(tile, points=np.concatenate([kept, mine]), free=free)
    return replace(point_map, tiles=tiles)


def score_injection(states: U8, objects: Sequence[Injected], shown: I64) -> dict[str, float]:
    """Recall over each kind's cells, objects at least half found, and precision within NEAR_M of any injection.

    Of a built object only the cells count that the drives show (see :func:`choose_objects`); a decided cell of it is
    right in any case.
    """
    near = ndimage.distance_transform_edt(~np.any([o.cells for o in objects], axis=0)) <= NEAR_M / CELL_SIZE
    out: dict[str, float] = {}
    for kind, state in (("built", CellState.CHANGED_OCCUPIED), ("demolished", CellState.CHANGED_EMPTY)):
        mine = [o.cells for o in objects if o.kind == kind]
        counted = [cells & (shown >= SHOWN) if kind == "built" else cells for cells in mine]
        decided, changed = states == state, np.any([np.zeros(states.shape, np.bool_), *mine], axis=0)
        found = [np.count_nonzero(cells & decided) for cells in counted]
        wanted = [np.count_nonzero(cells) for cells in counted]
        out[f"{kind}_objects"] = len(mine)
        out[f"{kind}_half_found"] = ratio(sum(2 * f >= w for f, w in zip(found, wanted, strict=True)), len(mine))
        out[f"{kind}_recall"] = ratio(sum(found), sum(wanted))
        out[f"{kind}_precision"] = ratio(np.count_nonzero(changed & decided), np.count_nonzero(decided & near))
    return out
