"""Yardsticks, run beside the vote: nearest neighbours, and an evidence-theory voxel map per vehicle.

The latter is after Kim et al. [15]. Every 0.3 m voxel carries Dempster-Shafer masses (occupied, free, unknown). A scan
gives evidence along its rays, a vehicle combines its scans, the server its vehicles and then the map; conflict with the
map is change. Kim et al. cluster features by similarity and have no released code: this keeps their evidence, not their
clustering. :class:`Evidence` has the masses.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Grid
from mapvote.core.kernel import kernel
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.reference import reference_window
from mapvote.core.types import F32, F64, I32, N_STATES, NO_VOTE, U8, U16, U64, Bool, CellState, Reference
from mapvote.core.voting import one_hot, plurality
from mapvote.core.voxels import voxel_downsample
from mapvote.formats.atomic import whole_folder
from mapvote.matching.localiser import GivenPoses
from mapvote.perception.frontend import Observation
from mapvote_lab.evaluation.cases import Progress, paper_cases, untold
from mapvote_lab.evaluation.scene import (
    BALLOTS_FROM,
    Pass,
    Scene,
    SharedPass,
    key_of,
    sources_digest,
)
from mapvote_lab.evaluation.scores import Cost, map_obstacles
from mapvote_lab.processes import mapping

LAYERS = 64
"""Voxels of a column, as in the map's column words: 19.2 m above the road."""


@record()
@dataclass(frozen=True, slots=True)
class Evidence:
    """Dempster-Shafer masses of the yardstick "evidence"."""

    hit: float = 0.7
    """Mass of "occupied" from a ray that ends in a voxel."""
    passed: float = 0.3
    """Mass of "free" from a ray that passes a voxel."""
    least_unknown: float = 0.01
    """Mass that always stays unknown, so that the present can outvote the past."""
    of_map: float = 0.9
    """Mass of "occupied" or "free" from the map."""
    conflict: float = 0.5
    """A voxel changed where the mass of "map and vehicles contradict each other" exceeds this."""


EVIDENCE = Evidence()


@record()
@dataclass(frozen=True, slots=True)
class NearestRule:
    """Numbers of the yardstick "nearest"."""

    far_m: float = 0.5
    """A point farther than this from every point of the other cloud is new or gone, metres."""
    merge_every: int = 16
    """Scans between two reductions of a vehicle's cloud to one point a voxel."""


NEAREST_RULE = NearestRule()


@kernel
def _march(
    points: F64, origin: F64, hits_count: Bool, base: I32, x0: float, y0: float, reach: float,
    hits: U16, passes: U16, touched: I32,
) -> int:  # fmt: skip
    """Count hits and passes per voxel along all rays (Amanatides and Woo 1987). Returns how many were touched."""
    rows, cols = base.shape
    n_touched = 0
    for i in range(len(points)):
        dx = points[i, 0] - origin[0]
        dy = points[i, 1] - origin[1]
        dz = points[i, 2] - origin[2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if length < CELL_SIZE:
            continue
        dx = dx / length
        dy = dy / length
        dz = dz / length
        c = int(np.floor((origin[0] - x0) / CELL_SIZE))
        r = int(np.floor((origin[1] - y0) / CELL_SIZE))
        z = int(np.floor(origin[2] / CELL_SIZE))
        ec = int(np.floor((points[i, 0] - x0) / CELL_SIZE))
        er = int(np.floor((points[i, 1] - y0) / CELL_SIZE))
        ez = int(np.floor(points[i, 2] / CELL_SIZE))
        sc = 1 if dx > 0 else -1
        sr = 1 if dy > 0 else -1
        sz = 1 if dz > 0 else -1
        wc = CELL_SIZE / max(abs(dx), 1e-12)
        wr = CELL_SIZE / max(abs(dy), 1e-12)
        wz = CELL_SIZE / max(abs(dz), 1e-12)
        tc = ((c + (sc > 0)) * CELL_SIZE + x0 - origin[0]) * sc / max(abs(dx), 1e-12)
        tr = ((r + (sr > 0)) * CELL_SIZE + y0 - origin[1]) * sr / max(abs(dy), 1e-12)
        tz = ((z + (sz > 0)) * CELL_SIZE - origin[2]) * sz / max(abs(dz), 1e-12)
        t = 0.0
        while t < length and t <= reach:
            end = c == ec and r == er and z == ez
            if 0 <= r < rows and 0 <= c < cols:
                k = z - base[r, c]
                if 0 <= k < LAYERS and (not end or hits_count[i]):
                    voxel = (r * cols + c) * LAYERS + k
                    if hits[voxel] == 0 and passes[voxel] == 0:
                        touched[n_touched] = voxel
                        n_touched += 1
                    if end:
                        hits[voxel] = min(hits[voxel] + 1, 65535)
                    else:
                        passes[voxel] = min(passes[voxel] + 1, 65535)
            if end:
                break
            if tc <= tr and tc <= tz:
                t = tc
                tc += wc
                c += sc
            elif tr <= tz:
                t = tr
                tr += wr
                r += sr
            else:
                t = tz
                tz += wz
                z += sz
    return n_touched


@kernel
def dempster(
    o1: float, f1: float, o2: float, f2: float, least_unknown: float = EVIDENCE.least_unknown
) -> tuple[float, float]:
    """Dempster's rule for two bodies of evidence on {occupied, free}: masses (occupied, free) of the combination.

    The rest of each mass is unknown; of the result at least ``least_unknown`` stays so, which also keeps it defined
    for total contradiction.
    """
    u1 = 1.0 - o1 - f1
    u2 = 1.0 - o2 - f2
    o = o1 * o2 + o1 * u2 + u1 * o2
    f = f1 * f2 + f1 * u2 + u1 * f2
    u = u1 * u2
    total = o + f + u
    if total <= 0.0:
        return 0.0, 0.0
    o = o / total
    f = f / total
    belief = o + f
    if belief > 1.0 - least_unknown:
        o = o * (1.0 - least_unknown) / belief
        f = f * (1.0 - least_unknown) / belief
    return o, f


@kernel
def _absorb(
    hits: U16, passes: U16, touched: I32, n: int, occupied: F32, free: F32,
    hit: float, passed: float, least_unknown: float,
) -> None:  # fmt: skip
    """One scan's counts into a vehicle's masses; the counts are cleared again."""
    for i in range(n):
        v = touched[i]
        o = 1.0 - (1.0 - hit) ** hits[v]
        f = 1.0 - (1.0 - passed) ** passes[v]
        o, f = dempster(o, 0.0, 0.0, f, least_unknown)
        occupied[v], free[v] = dempster(occupied[v], free[v], o, f, least_unknown)
        hits[v] = 0
        passes[v] = 0


@kernel
def _combine(occupied: F32, free: F32, other_occupied: F32, other_free: F32, least_unknown: float) -> None:
    """Another vehicle's masses into these, voxel by voxel, in place."""
    for v in range(len(occupied)):
        if other_occupied[v] > 0.0 or other_free[v] > 0.0:
            occupied[v], free[v] = dempster(occupied[v], free[v], other_occupied[v], other_free[v], least_unknown)


@kernel
def _cells(map_words: U64, occupied: F32, free: F32, states: U8, of_map: float, conflict: float) -> None:
    """Voxels to the cell states on which everything here is scored."""
    rows, cols = map_words.shape
    for r in range(rows):
        for c in range(cols):
            in_map = 0
            gone = 0
            new = 0
            seen = 0
            for k in range(LAYERS):
                v = (r * cols + c) * LAYERS + k
                mapped = (map_words[r, c] >> np.uint64(k)) & np.uint64(1) == np.uint64(1)
                known = occupied[v] + free[v] > 0.5
                seen += known
                if mapped:
                    in_map += known
                    gone += of_map * free[v] > conflict
                else:
                    new += of_map * occupied[v] > conflict
            if map_words[r, c] != 0 and in_map > 0:
                states[r, c] = CellState.CHANGED_EMPTY if 2 * gone > in_map else CellState.UNCHANGED_OCCUPIED
            elif map_words[r, c] != 0:
                states[r, c] = CellState.UNDETERMINED
            elif seen > 0:
                states[r, c] = CellState.CHANGED_OCCUPIED if new > 0 else CellState.UNCHANGED_EMPTY


class EvidenceMap:
    """One vehicle's voxel map: push every scan, then :func:`combine` the vehicles'."""

    def __init__(self, reference: Reference, window_m: float = 80.0, masses: Evidence = EVIDENCE) -> None:
        """``reference``: the old map over the whole window to be scored; 8 bytes a voxel are held for it."""
        self._reference = reference
        self._masses = masses
        self._reach = 0.5 * window_m
        voxels = reference.grid.rows * reference.grid.cols * LAYERS
        self.occupied = np.zeros(voxels, dtype=np.float32)
        self.free = np.zeros(voxels, dtype=np.float32)
        self._hits = np.zeros(voxels, dtype=np.uint16)
        self._passes = np.zeros(voxels, dtype=np.uint16)
        self._touched = np.zeros(voxels, dtype=np.int32)

    @property
    def memory_bytes(self) -> int:
        """Held between scans."""
        return self.occupied.nbytes + self.free.nbytes

    def push(self, points_map: F64, origin_map: F64, obstacle: Bool, moving: Bool) -> None:
        """One scan: points (n, 3) and sensor (3,) in map metres; movers' rays prove what they passed, nothing more."""
        grid = self._reference.grid
        counts = self._hits, self._passes, self._touched
        n = _march(
            points_map, origin_map, obstacle & ~moving, self._reference.base, grid.x0, grid.y0, self._reach, *counts
        )
        masses = self._masses
        _absorb(*counts, n, self.occupied, self.free, masses.hit, masses.passed, masses.least_unknown)


def combine(vehicles: Sequence[EvidenceMap], reference: Reference, masses: Evidence = EVIDENCE) -> U8:
    """The server's side: (rows, cols) CellState over the reference's window from all vehicles' masses and the map's."""
    states = np.full(reference.grid.shape, NO_VOTE, dtype=np.uint8)
    if not vehicles:
        return states
    occupied = vehicles[0].occupied.copy()
    free = vehicles[0].free.copy()
    for other in vehicles[1:]:
        _combine(occupied, free, other.occupied, other.free, masses.least_unknown)
    _cells(reference.occupied, occupied, free, states, masses.of_map, masses.conflict)
    return states


def heights_above_ground(point_map: PointMap, points: F64) -> F64:
    """(n,) metres above the map's ground of points (n, 3); above the nearest known ground where it is unknown."""
    lattice = point_map.lattice
    rows, cols = lattice.cells_of(points) if len(points) else (np.zeros(1, np.int64), np.zeros(1, np.int64))
    row = int(rows.min())
    col = int(cols.min())
    window = Grid(lattice, row, col, int(rows.max()) - row + 1, int(cols.max()) - col + 1)
    reference = reference_window(point_map, window)
    filled = np.where(np.isnan(reference.ground_z), reference.base * CELL_SIZE, reference.ground_z)
    return points[:, 2] - filled[rows - row, cols - col] if len(points) else np.zeros(0)


class NearestNeighbour:
    """One vehicle's detector: push every scan, then ask for its states. One cloud of 0.3 m voxels is kept."""

    def __init__(
        self, obstacles_map: F64, grid: Grid, window_m: float = 80.0, rule: NearestRule = NEAREST_RULE
    ) -> None:
        """``obstacles_map`` (n, 3): the old map's points above ground; states are given over ``grid``."""
        self._map = obstacles_map
        self._rule = rule
        self._grid = grid
        self._half = 0.5 * window_m
        self._seen = np.zeros(grid.shape, dtype=np.bool_)
        self._clouds = [np.zeros((0, 3))]

    def push(self, points_map: F64, origin_map: F64, obstacle: Bool, moving: Bool) -> None:
        """One scan: points (n, 3) and sensor (3,) in map metres; which are above ground, which belong to movers."""
        near = np.abs(points_map[:, :2] - origin_map[:2]).max(axis=1) <= self._half
        self._clouds.append(points_map[near & obstacle & ~moving])
        if len(self._clouds) > self._rule.merge_every:
            self._clouds = [self._cloud()]
        x, y = self._grid.centres()
        rows = np.abs(y - origin_map[1]) <= self._half
        cols = np.abs(x - origin_map[0]) <= self._half
        self._seen[np.ix_(rows, cols)] = True

    def _cloud(self) -> F64:
        cloud = np.concatenate(self._clouds)
        lattice = self._grid.lattice
        return cloud[voxel_downsample(cloud, CELL_SIZE, lattice.x0, lattice.y0)]

    @property
    def memory_bytes(self) -> int:
        """Held between scans."""
        return int(sum(cloud.nbytes for cloud in self._clouds) + self._seen.nbytes)

    def states(self) -> U8:
        """(rows, cols) CellState: changed where more than half of the cell's map points, or any new point, are far."""
        cloud = self._cloud()
        map_far, map_all = self._far_and_all(self._map, cloud)
        new_far, new_all = self._far_and_all(cloud, self._map)
        states = np.full(self._grid.shape, CellState.UNCHANGED_EMPTY, dtype=np.uint8)
        states[(map_all > 0) | (new_all > 0)] = CellState.UNCHANGED_OCCUPIED
        states[new_far > 0] = CellState.CHANGED_OCCUPIED
        states[2 * map_far > map_all] = CellState.CHANGED_EMPTY
        states[~self._seen] = NO_VOTE
        return states

    def _far_and_all(self, points: F64, other: F64) -> tuple[np.ndarray, np.ndarray]:
        """Per cell, how many ``points`` are farther than ``far_m`` from ``other``, and how many there are."""
        far = np.ones(len(points), dtype=np.bool_)
        if len(points) and len(other):
            far = np.isinf(cKDTree(other).query(points, distance_upper_bound=self._rule.far_m)[0])
        rows, cols, inside = self._grid.indices_of(points)
        cell = rows * self._grid.cols + cols
        size = self._grid.rows * self._grid.cols
        near_and_far = (np.bincount(cell[chosen], minlength=size) for chosen in (inside & far, inside))
        counts = [count.reshape(self._grid.shape) for count in near_and_far]
        return counts[0], counts[1]


def yardsticks(
    scene: Scene, drives: Sequence[Pass], workers: int, progress: Progress = untold
) -> tuple[dict[str, tuple[U8, list[U8]]], dict[str, Cost]]:
    """(by yardstick the states that it decides and those of each vehicle, over the truth's window; the cost of each
    method, the paper's own grid first). Passes are cached like ballots."""
    tasks = [
        (scene, drive.vehicle, drive.T_map_lidar) for drive in drives if not _folder(scene, drive.vehicle).exists()
    ]
    progress("yardsticks", 0, len(tasks))
    with mapping(workers if len(tasks) > 1 else 1) as run:
        list(run(_measure, tasks))
    folders = [_folder(scene, drive.vehicle) for drive in drives]
    costs = [json.loads((folder / "cost.json").read_text()) for folder in folders]
    beams = scene.drive(drives[0].vehicle).sensor.beams
    mean = {name: Cost(beams, *np.mean([cost[name] for cost in costs], axis=0).tolist()) for name in costs[0]}
    nearest = [np.load(folder / "nearest.npy") for folder in folders]
    votes: I32 = np.sum([one_hot(states) for states in nearest], axis=0, dtype=np.int32)
    reference = reference_window(scene.point_map, scene.truth.grid_on(scene.point_map.lattice))
    maps = []
    for folder in folders:
        maps.append(EvidenceMap(reference))
        with np.load(folder / "evidence.npz") as file:
            maps[-1].occupied[file["known"]] = file["occupied"]
            maps[-1].free[file["known"]] = file["free"]
    evidence = combine(maps, reference), [combine([one], reference) for one in maps]
    return {"nearest": (plurality(votes), nearest), "evidence": evidence}, mean


def _folder(scene: Scene, vehicle: str) -> Path:
    key = key_of(sources_digest((*BALLOTS_FROM, "evaluation/baselines.py")))
    return scene.work / f"yardsticks-{key}" / vehicle


def _measure(task: tuple[Scene, str, F64]) -> None:
    """One vehicle's pass at the poses it found before: both yardsticks watch the scans that vote."""
    scene, name, T_map_lidar = task
    drive = scene.drive(name)
    point_map = scene.point_map
    reference = reference_window(point_map, scene.truth.grid_on(point_map.lattice))
    nearest = NearestNeighbour(map_obstacles(point_map), reference.grid)
    evidence = EvidenceMap(reference)
    seconds: dict[str, list[float]] = {"nearest": [], "evidence": []}

    def watch(observations: list[Observation]) -> None:
        for seen in observations:
            for yardstick, times in ((nearest, seconds["nearest"]), (evidence, seconds["evidence"])):
                start = time.thread_time()
                yardstick.push(seen.scan.points_map, seen.scan.origin_map, seen.scan.obstacle, seen.moving)
                times.append(time.thread_time() - start)

    case = paper_cases(scene.settings)["5"]
    there = np.flatnonzero(np.isfinite(T_map_lidar).all(axis=(1, 2)))
    localise = GivenPoses(drive.stamps_ns[there], T_map_lidar[there])
    vehicle = SharedPass(drive, point_map, scene.settings, [case], localise=localise)
    for i in there:
        watch(vehicle.observe(drive.read_scan(int(i))))
    watch(vehicle.finish())
    ballot = vehicle.ballot(case)
    stages = vehicle.report.stage_s
    start = time.thread_time()
    states = nearest.states()
    at_end = (time.thread_time() - start) / max(len(there), 1)

    def median_ms(seconds: Any) -> float:
        return 1000.0 * float(np.median(seconds))

    tally_bytes = len(ballot.tiles) * TILE_CELLS * TILE_CELLS * N_STATES * 4
    cost = {  # milliseconds a scan, bytes of its grid
        "case 5": (median_ms(np.add(stages["see"], stages["vote"])), tally_bytes),
        "nearest": (median_ms(seconds["nearest"]) + 1000 * at_end, nearest.memory_bytes),
        "evidence": (median_ms(seconds["evidence"]), evidence.memory_bytes),
    }
    with whole_folder(_folder(scene, name), sign="cost.json") as folder:
        np.save(folder / "nearest.npy", states)
        believed = np.flatnonzero((evidence.occupied > 0) | (evidence.free > 0)).astype(np.int32)
        np.savez(
            folder / "evidence.npz", known=believed, occupied=evidence.occupied[believed], free=evidence.free[believed]
        )
        (folder / "cost.json").write_text(json.dumps(cost))
