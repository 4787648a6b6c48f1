"""The two yardsticks on the same drives, poses and moving-object masks as the vote, and what each costs."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mapvote.core.grid import TILE_CELLS
from mapvote.core.reference import reference_window
from mapvote.core.types import F64, I32, N_STATES, U8
from mapvote.core.voting import decide, one_hot
from mapvote.formats.atomic import whole_folder
from mapvote.localisation.localiser import GivenPoses
from mapvote.perception.frontend import Observation
from mapvote_lab.evaluation.baselines.dempster_shafer import EvidenceMap, combine
from mapvote_lab.evaluation.baselines.nearest_neighbour import NearestNeighbour
from mapvote_lab.evaluation.experiments.cases import paper_cases
from mapvote_lab.evaluation.experiments.passes import Pass
from mapvote_lab.evaluation.experiments.scene import BALLOTS_FROM, Progress, Scene, key_of, sources_digest
from mapvote_lab.evaluation.experiments.shared_pass import SharedPass
from mapvote_lab.evaluation.scoring.map_points import map_obstacles
from mapvote_lab.simulation.processes import processes


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
        "nearest": Yardstick(decide(votes), nearest, mean["nearest"]),
        "evidence": Yardstick(combine(maps, reference), own, mean["evidence"]),
    }, mean["case 5"]


def _folder(scene: Scene, vehicle: str) -> Path:
    key = key_of(
        sources_digest(
            (
                *BALLOTS_FROM,
                "evaluation/baselines/nearest_neighbour.py",
                "evaluation/baselines/dempster_shafer.py",
                "evaluation/baselines/run.py",
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
