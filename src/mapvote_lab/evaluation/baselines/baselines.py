"""Yardsticks: nearest neighbours, and how all of them are run beside the vote."""

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
from mapvote.core.point_map import PointMap
from mapvote.core.reference import reference_window
from mapvote.core.types import F64, I32, N_STATES, NO_VOTE, U8, Bool, CellState
from mapvote.core.voting import one_hot, plurality
from mapvote.core.voxels import voxel_downsample
from mapvote.formats.atomic import whole_folder
from mapvote.localisation.localiser import GivenPoses
from mapvote.perception.frontend import Observation
from mapvote_lab.evaluation.baselines.dempster_shafer import EvidenceMap, combine
from mapvote_lab.evaluation.experiments.cases import paper_cases
from mapvote_lab.evaluation.experiments.passes import Pass, SharedPass
from mapvote_lab.evaluation.experiments.scene import BALLOTS_FROM, Progress, Scene, key_of, sources_digest
from mapvote_lab.evaluation.scoring.map_points import map_obstacles
from mapvote_lab.simulation.processes import processes

DISTANCE_M = 0.5
_MERGE_EVERY = 16


def heights_above_ground(point_map: PointMap, points: F64) -> F64:
    """(n,) metres above the map's ground of points (n, 3); above the nearest known ground where it is unknown."""
    lattice = point_map.lattice
    rows, cols = lattice.cells_of(points) if len(points) else (np.zeros(1, np.int64), np.zeros(1, np.int64))
    row, col = int(rows.min()), int(cols.min())
    window = Grid(lattice, row, col, int(rows.max()) - row + 1, int(cols.max()) - col + 1)
    reference = reference_window(point_map, window)
    filled = np.where(np.isnan(reference.ground_z), reference.base * CELL_SIZE, reference.ground_z)
    return points[:, 2] - filled[rows - row, cols - col] if len(points) else np.zeros(0)


class NearestNeighbour:
    """One vehicle's detector: push every scan, then ask for its states. One cloud of 0.3 m voxels is kept."""

    def __init__(self, obstacles_map: F64, grid: Grid, window_m: float = 80.0) -> None:
        """``obstacles_map`` (n, 3): the old map's points above ground; states are given over ``grid``."""
        self._map = obstacles_map
        self._grid = grid
        self._half = 0.5 * window_m
        self._seen = np.zeros(grid.shape, dtype=np.bool_)
        self._clouds = [np.zeros((0, 3))]

    def push(self, points_map: F64, origin_map: F64, obstacle: Bool, moving: Bool) -> None:
        """One scan: points (n, 3) and sensor (3,) in map metres; which are above ground, which belong to movers."""
        near = np.abs(points_map[:, :2] - origin_map[:2]).max(axis=1) <= self._half
        self._clouds.append(points_map[near & obstacle & ~moving])
        if len(self._clouds) > _MERGE_EVERY:
            self._clouds = [self._cloud()]
        x, y = self._grid.centres()
        rows, cols = np.abs(y - origin_map[1]) <= self._half, np.abs(x - origin_map[0]) <= self._half
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
        """Per cell, how many ``points`` are farther than DISTANCE_M from ``other``, and how many there are."""
        far = np.ones(len(points), dtype=np.bool_)
        if len(points) and len(other):
            far = np.isinf(cKDTree(other).query(points, distance_upper_bound=DISTANCE_M)[0])
        rows, cols, inside = self._grid.indices_of(points)
        cell = rows * self._grid.cols + cols
        size = self._grid.rows * self._grid.cols
        counts = [
            np.bincount(cell[chosen], minlength=size).reshape(self._grid.shape) for chosen in (inside & far, inside)
        ]
        return counts[0], counts[1]


@dataclass(frozen=True, slots=True)
class Yardstick:
    """What one yardstick decided, and its cost on a vehicle."""

    states: U8
    """Over the truth's window."""
    vehicle_states: list[U8]
    cost: dict[str, Any]
    """ms a scan (median), bytes of its grid."""


def yardsticks(
    scene: Scene, drives: Sequence[Pass], workers: int, progress: Progress | None = None
) -> tuple[dict[str, Yardstick], dict[str, Any]]:
    """(nearest and evidence, the cost of the paper's own grid on the same scans); passes are cached like ballots."""
    tasks = [
        (scene, drive.vehicle, drive.T_map_lidar) for drive in drives if not _folder(scene, drive.vehicle).exists()
    ]
    if progress:
        progress("yardsticks", 0, len(tasks))
    if workers > 1 and len(tasks) > 1:
        with processes(workers) as pool:
            list(pool.map(_measure, tasks))
    else:
        for task in tasks:
            _measure(task)
    folders = [_folder(scene, drive.vehicle) for drive in drives]
    costs = [json.loads((folder / "cost.json").read_text()) for folder in folders]
    mean = {name: {k: float(np.mean([c[name][k] for c in costs])) for k in costs[0][name]} for name in costs[0]}
    nearest = [np.load(folder / "nearest.npy") for folder in folders]
    votes: I32 = np.sum([one_hot(states) for states in nearest], axis=0, dtype=np.int32)
    reference = reference_window(scene.point_map, scene.truth.grid_on(scene.point_map.lattice))
    maps = [_read_evidence(folder / "evidence.npz", EvidenceMap(reference)) for folder in folders]
    own = [combine([one], reference) for one in maps]
    return {
        "nearest": Yardstick(plurality(votes), nearest, mean["nearest"]),
        "evidence": Yardstick(combine(maps, reference), own, mean["evidence"]),
    }, mean["case 5"]


def _folder(scene: Scene, vehicle: str) -> Path:
    key = key_of(
        sources_digest(
            (
                *BALLOTS_FROM,
                "evaluation/baselines/baselines.py",
                "evaluation/baselines/dempster_shafer.py",
                "evaluation/baselines/baselines.py",
            )
        )
    )
    return scene.work / f"yardsticks-{key}" / vehicle


def _measure(task: tuple[Scene, str, F64]) -> None:
    """One vehicle's pass at the poses it found before: both yardsticks watch the scans that vote."""
    scene, name, T_map_lidar = task
    drive, point_map = scene.drive(name), scene.point_map
    reference = reference_window(point_map, scene.truth.grid_on(point_map.lattice))
    nearest, evidence = NearestNeighbour(map_obstacles(point_map), reference.grid), EvidenceMap(reference)
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
    ballot, stages = vehicle.ballot(case), vehicle.report.stage_s
    start = time.thread_time()
    states = nearest.states()
    at_end = (time.thread_time() - start) / max(len(there), 1)
    tally_bytes = len(ballot.tiles) * TILE_CELLS * TILE_CELLS * N_STATES * 4
    cost = {
        "case 5": {"ms_per_scan": _median_ms(np.add(stages["see"], stages["vote"])), "memory_bytes": tally_bytes},
        "nearest": {
            "ms_per_scan": _median_ms(seconds["nearest"]) + 1000 * at_end,
            "memory_bytes": nearest.memory_bytes,
        },
        "evidence": {"ms_per_scan": _median_ms(seconds["evidence"]), "memory_bytes": evidence.memory_bytes},
    }
    with whole_folder(_folder(scene, name), sign="cost.json") as folder:
        np.save(folder / "nearest.npy", states)
        known = np.flatnonzero((evidence.occupied > 0) | (evidence.free > 0)).astype(np.int32)
        np.savez(folder / "evidence.npz", known=known, occupied=evidence.occupied[known], free=evidence.free[known])
        (folder / "cost.json").write_text(json.dumps(cost))


def _median_ms(seconds: Any) -> float:
    return 1000.0 * float(np.median(seconds))


def _read_evidence(path: Path, into: EvidenceMap) -> EvidenceMap:
    with np.load(path) as file:
        into.occupied[file["known"]] = file["occupied"]
        into.free[file["known"]] = file["free"]
    return into
