"""Changes injected into a real street (METHOD 4): the drive stays as recorded, the map is made to differ from it.

Built: the points of real things are cut out of the map, so that the drive shows something the map lacks. Demolished:
hollow boxes of points are put into the map where nothing stands, so that the map shows something that is not there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapvote.core.columns import GROUND_MARGIN_M, map_points, reference_window, tile_points
from mapvote.core.grid import CELL_SIZE, Grid, tile_grid
from mapvote.core.types import F64, U8, U64, Bool, CellState, PointMap
from mapvote.evaluation.metrics import ratio

APART_M = 6.0
"""Between the middles of two injected objects."""
NEAR_M = 1.5
"""Precision counts decided cells this close to an injection."""
_SIZES = ((2.4, 1.8), (4.2, 1.8), (3.0, 3.0))
_HEIGHT_M = (1.5, 3.0)
_FEWEST_CELLS = 8


@dataclass(frozen=True, slots=True)
class Injected:
    """One injected object: ``kind`` "built" or "demolished", its ``cells`` (rows, cols) over the window."""

    kind: str
    middle: tuple[float, float]
    cells: Bool


def inject(
    point_map: PointMap, window: Grid, seen: Bool, count: int, rng: np.random.Generator
) -> tuple[PointMap, list[Injected]]:
    """``count`` objects of each kind at random, in cells that the vehicles ``seen`` (rows, cols): (other map, objects)."""
    reference = reference_window(point_map, window)
    objects: list[Injected] = []
    for kind in ("built", "demolished"):
        solid = reference.counts > 0
        open_road = seen & ~solid & np.isfinite(reference.ground_z)
        candidates = np.argwhere(seen & (reference.counts >= 5) if kind == "built" else open_road)
        for row, col in candidates[rng.permutation(len(candidates))]:
            if sum(o.kind == kind for o in objects) == count:
                break
            x, y = window.x0 + (col + 0.5) * CELL_SIZE, window.y0 + (row + 0.5) * CELL_SIZE
            if any(np.hypot(x - o.middle[0], y - o.middle[1]) < APART_M for o in objects):
                continue
            length, width = _SIZES[int(rng.integers(len(_SIZES)))]
            box = _box(window, x, y, length, width)
            cells = box & solid if kind == "built" else box & ~_box(window, x, y, length - 1.2, width - 1.2)
            enough = np.count_nonzero(cells) >= _FEWEST_CELLS
            if enough and (kind == "built" or (open_road[_box(window, x, y, length + 1.2, width + 1.2)].all())):
                objects.append(Injected(kind, (float(x), float(y)), cells))
    return edit(point_map, window, objects, rng), objects


def _box(window: Grid, x: float, y: float, length: float, width: float) -> Bool:
    """(rows, cols) cells whose centres lie in an axis-parallel box around (x, y)."""
    cx, cy = window.centres()
    return (np.abs(cy - y) < 0.5 * width)[:, None] & (np.abs(cx - x) < 0.5 * length)[None, :]


def edit(point_map: PointMap, window: Grid, objects: list[Injected], rng: np.random.Generator) -> PointMap:
    """The map without the built objects' points and with the demolished ones' phantoms. Known-free columns follow: what
    was cut out is free, as it would have been had the object not stood there; where a phantom stands nothing is free."""
    reference = reference_window(point_map, window)
    cut = np.zeros(window.shape, dtype=np.bool_)
    phantom, phantom_words = [np.zeros((0, 3))], np.zeros(window.shape, dtype=np.uint64)
    for item in objects:
        if item.kind == "built":
            cut |= item.cells
            continue
        height = rng.uniform(*_HEIGHT_M)
        for row, col in np.argwhere(item.cells):
            ground, base = float(reference.ground_z[row, col]), int(reference.base[row, col])
            layers = np.arange(base + 2, int((ground + height) / CELL_SIZE) + 1)
            jitter = rng.uniform(0.05, 0.25, (len(layers), 3))
            corner = np.array([window.x0 + col * CELL_SIZE, window.y0 + row * CELL_SIZE, 0.0])
            phantom.append(corner + jitter + np.outer(layers, [0.0, 0.0, CELL_SIZE]))
            for layer in layers:
                phantom_words[row, col] |= np.uint64(1) << np.uint64(min(layer - base, 63))
    words = np.where(cut, reference.occupied, np.uint64(0))
    return _rebuilt(point_map, window, cut, words, np.concatenate(phantom), phantom_words)


def _rebuilt(point_map: PointMap, window: Grid, cut: Bool, freed: U64, phantom: F64, taken: U64) -> PointMap:
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
        mine = phantom[grid.indices_of(phantom)[2]]
        free = tile.free
        if free is not None:
            free = free.copy()
            free[here] = (free[here] | freed[there]) & ~taken[there]
        tiles[index] = replace(tile, points=np.concatenate([kept, tile_points(grid, mine)]), free=free)
    return replace(point_map, map_id=f"{point_map.map_id}-injected", tiles=tiles)


def score_injection(states: U8, objects: list[Injected]) -> dict[str, float]:
    """Recall over the cells of each kind, precision within NEAR_M of any injection, share of objects half found."""
    near_cells = round(NEAR_M / CELL_SIZE)
    from scipy import ndimage

    out: dict[str, float] = {}
    touched = np.any([o.cells for o in objects], axis=0)
    near = ndimage.distance_transform_edt(~touched) <= near_cells
    for kind, state in (("built", CellState.CHANGED_OCCUPIED), ("demolished", CellState.CHANGED_EMPTY)):
        mine = [o.cells for o in objects if o.kind == kind]
        truth = np.any(mine, axis=0) if mine else np.zeros(states.shape, np.bool_)
        decided = states == state
        halves = [ratio(np.count_nonzero(cells & decided), np.count_nonzero(cells)) >= 0.5 for cells in mine]
        out[f"{kind}_objects"] = len(mine)
        out[f"{kind}_half_found"] = ratio(sum(halves), len(mine))
        out[f"{kind}_recall"] = ratio(np.count_nonzero(truth & decided), np.count_nonzero(truth))
        out[f"{kind}_precision"] = ratio(np.count_nonzero(truth & decided), np.count_nonzero(decided & near))
    return out
