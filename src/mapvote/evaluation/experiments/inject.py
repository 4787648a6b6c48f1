"""Changes injected into a real map: the street stays, the map is made to lie.

Points cut out of the map are an object that the vehicles will find *built*; a phantom box of points where the map
knows free space is one that they will find *demolished*. The cut voxels are marked free: had the object not stood
there, the rays that ended on it would have gone on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from mapvote.core.columns import GROUND_MARGIN_M, column_bits
from mapvote.core.grid import Grid
from mapvote.core.point_map import PointMap
from mapvote.core.reference import reference_window
from mapvote.core.types import F64, U8, U64, Bool, CellState, MapvoteError, Reference
from mapvote.evaluation.scoring.cells import ratio

APART_M = 5.0
"""Between the middles of two injected objects."""
NEAR_CELLS = 5
"""1.5 m: precision is counted this close to the injections, because over a street it depends on their number."""
_CHUNK_M = (1.5, 3.0)
_PATH_M = (4.0, 25.0)
_ROOM_CELLS = 8
"""2.4 m: half the diagonal of the largest phantom, which must not stand in anything, nor beyond the window."""
_TRIES = 20_000


@dataclass
class Injection:
    """An ``edit`` for :func:`mapvote.evaluation.experiments.real_drive.run_real`; afterwards it knows what it did."""

    seed: int
    path_xy: F64
    """(n, 2) where the vehicles drive, roughly, map metres: objects are placed beside it."""
    objects: int = 10
    truth: U8 = field(default_factory=lambda: np.zeros((0, 0), np.uint8))
    """(rows, cols) 0 unchanged, 1 built, 2 demolished."""
    cells: list[tuple[str, Bool]] = field(default_factory=list)
    """("built" or "demolished", (rows, cols)) of every object."""

    def __call__(self, point_map: PointMap, grid: Grid, movers: Bool) -> PointMap:
        """Cut ``objects`` chunks out of the map, and put as many phantom boxes in. MapvoteError if there is no room."""
        rng = np.random.default_rng(self.seed)
        reference = reference_window(point_map, grid)
        self.truth, self.cells = np.zeros(grid.shape, dtype=np.uint8), []
        cut = np.zeros(grid.shape, dtype=np.uint64)
        added: list[F64] = []
        taken: list[F64] = []
        while len(self.cells) < 2 * self.objects:
            kind = "built" if len(self.cells) < self.objects else "demolished"
            centre = self._place(rng, reference, movers, taken, kind)
            taken.append(centre)
            if kind == "built":
                here = _square(grid, centre, rng.uniform(*_CHUNK_M)) & (reference.occupied != 0)
                cut[here] = reference.occupied[here]
                self.truth[here] = 1
            else:
                points = phantom(rng, centre, _ground_at(reference, centre))
                rows, cols, _ = grid.indices_of(points)
                here = np.zeros(grid.shape, dtype=np.bool_)
                here[rows, cols] = True
                added.append(points)
                self.truth[here] = 2
            self.cells.append((kind, here))
        return _edited(point_map, grid, reference, cut, np.concatenate(added))

    def _place(
        self, rng: np.random.Generator, reference: Reference, movers: Bool, taken: Sequence[F64], kind: str
    ) -> F64:
        """A spot beside the path, away from movers and other injections, with what its kind needs."""
        grid = reference.grid
        if kind == "built":
            wanted = (reference.counts >= 4) & (reference.top_z - reference.ground_z >= 1.0) & ~movers
        else:
            taken_cells = (reference.occupied != 0) | movers
            near = ndimage.binary_dilation(taken_cells, np.ones((3, 3)), iterations=_ROOM_CELLS, border_value=1)
            wanted = ~near & np.isfinite(reference.ground_z)
            if reference.free is not None:
                wanted &= (reference.free & np.uint64(0b111110)) == np.uint64(0b111110)
        rows, cols = np.nonzero(wanted)
        x, y = grid.centres()
        for k in rng.integers(0, max(len(rows), 1), _TRIES if len(rows) else 0):
            spot = np.array([x[cols[k]], y[rows[k]]])
            distance = np.linalg.norm(self.path_xy - spot, axis=1).min()
            apart = all(np.linalg.norm(spot - other) >= APART_M for other in taken)
            if _PATH_M[0] <= distance <= _PATH_M[1] and apart:
                return spot
        raise MapvoteError(f"no room for another {kind} object beside this drive: ask for fewer")


def phantom(rng: np.random.Generator, centre: F64, ground_z: float) -> F64:
    """Surface points (n, 3) of a box of a car's to a kiosk's size, one per 0.3 m voxel or so, 1 cm of noise."""
    length, width, height = rng.uniform(1.5, 4.0), rng.uniform(1.2, 2.0), rng.uniform(1.3, 2.5)
    turn = rng.uniform(0.0, np.pi)
    a, b, h = (np.arange(0.15, extent, 0.28) for extent in (length, width, height))
    walls = [np.stack(np.meshgrid([side], b, h), -1).reshape(-1, 3) for side in (0.0, length)]
    walls += [np.stack(np.meshgrid(a, [side], h), -1).reshape(-1, 3) for side in (0.0, width)]
    walls.append(np.stack(np.meshgrid(a, b, [height]), -1).reshape(-1, 3))
    box = np.concatenate(walls) - [length / 2, width / 2, 0.0]
    c, s = np.cos(turn), np.sin(turn)
    box[:, :2] = box[:, :2] @ np.array([[c, s], [-s, c]])
    box += [centre[0], centre[1], ground_z]
    return box[box[:, 2] - ground_z >= GROUND_MARGIN_M] + rng.normal(0.0, 0.01, (1, 3))


def _square(grid: Grid, centre: F64, side_m: float) -> Bool:
    x, y = grid.centres()
    return (np.abs(x[None, :] - centre[0]) <= side_m / 2) & (np.abs(y[:, None] - centre[1]) <= side_m / 2)


def _ground_at(reference: Reference, spot: F64) -> float:
    rows, cols, _ = reference.grid.indices_of(spot[None])
    return float(reference.ground_z[rows[0], cols[0]])


def _edited(point_map: PointMap, grid: Grid, reference: Reference, cut: U64, added: F64) -> PointMap:
    """The map without the points in ``cut`` voxels, with ``added`` points; known-free columns follow."""
    tiles = dict(point_map.tiles)
    for index, tile in tiles.items():
        window = tile.window
        points = tile.points_map
        rows, cols, inside = grid.indices_of(points)
        rows, cols = rows.clip(0, grid.rows - 1), cols.clip(0, grid.cols - 1)
        bit, high = column_bits(points[:, 2], reference.ground_z[rows, cols], reference.base[rows, cols])
        gone = inside & high & ((cut[rows, cols] >> bit.astype(np.uint64)) & np.uint64(1)).astype(np.bool_)
        a, b, mine = window.indices_of(added)
        kept = np.concatenate([tile.points[~gone], window.from_map(added[mine])])
        free = tile.free
        if free is not None:
            common = window.intersection(grid)
            free = free.copy()
            free[common.slices_in(window)] |= cut[common.slices_in(grid)]
            free[a[mine], b[mine]] = 0
        tiles[index] = replace(tile, points=kept, free=free)
    return replace(point_map, map_id=point_map.map_id + "-injected", tiles=tiles)


@dataclass(frozen=True, slots=True)
class InjectionScores:
    """How well one case found the injected objects of one kind."""

    cell_recall: float
    """Share of the true cells found: the reached ones, as the strict truth of simulation has it."""
    found: int
    """Objects of which at least half of those cells were found."""
    objects: int
    """Objects with such a cell."""
    recall_of_all: float
    """The same share of every cell that was cut out of the map, met again by a ray or not."""
    precision_near: float
    """Share of the cells decided so within 1.5 m of an injection of this kind that are right."""


def score_injection(injection: Injection, states: U8, kind: str, reached: Bool) -> InjectionScores:
    """``states`` (rows, cols) as decided and ``reached`` (rows, cols), both over the injection's window.

    A map holds thin and half-hidden cells that no ray of the vehicles meets again. Nobody can find these *built*, so
    recall counts the cut cells in which a vehicle's scan met something (``reached``), whatever the method made of it.
    Of phantoms every cell counts.
    """
    state, value = (CellState.CHANGED_OCCUPIED, 1) if kind == "built" else (CellState.CHANGED_EMPTY, 2)
    true, decided = injection.truth == value, states == state
    near = ndimage.binary_dilation(true, np.ones((3, 3)), iterations=NEAR_CELLS)
    asked = reached if kind == "built" else np.ones_like(reached)
    objects = [cells & asked for k, cells in injection.cells if k == kind and (cells & asked).any()]
    shares = [ratio(np.count_nonzero(decided & cells), np.count_nonzero(cells)) for cells in objects]
    return InjectionScores(
        cell_recall=ratio(np.count_nonzero(decided & true & asked), np.count_nonzero(true & asked)),
        found=sum(share >= 0.5 for share in shares),
        objects=len(shares),
        recall_of_all=ratio(np.count_nonzero(decided & true), np.count_nonzero(true)),
        precision_near=ratio(np.count_nonzero(decided & true), np.count_nonzero(decided & near)),
    )
