"""``mapvote evaluate``: a scenario and a seed become Tables II-IV and what else there is to measure (paper V)."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mapvote.core.ballot import Ballot
from mapvote.core.columns import GROUND_MARGIN_M, reference_window
from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.types import F64, U8, PointMap
from mapvote.evaluation.cases import Case, Outcome, Pass, fuse_case, passes
from mapvote.evaluation.changed_areas import in_changed_areas, survey_anew
from mapvote.evaluation.metrics import MapJudge, coverage, score_cells, score_objects
from mapvote.evaluation.nearest import map_obstacles
from mapvote.evaluation.scene import Progress, Scene
from mapvote.evaluation.truth import Truth, error_summary, rigid_between
from mapvote.evaluation.yardsticks import yardsticks


@dataclass(frozen=True)
class Evaluation:
    """The numbers, and what pictures need."""

    result: dict[str, Any]
    """What ``--json`` writes (DESIGN 6)."""
    scene: Scene
    truth: Truth
    window: Grid
    first_map: PointMap
    outcomes: Mapping[str, Outcome]
    drives: Sequence[Pass]


def evaluate(
    scene: Scene, cases: Sequence[Case], with_yardsticks: bool = False, progress: Progress | None = None
) -> Evaluation:
    """Run what the cache lacks, decide and score every case. Two processes where there are two cores."""
    started = time.perf_counter()
    scene.prepare(progress)
    prepared = time.perf_counter()
    workers = min(2, os.cpu_count() or 1)
    drives = passes(scene, cases, workers, progress)
    voted = time.perf_counter()
    truth, first_map = scene.truth, scene.point_map
    beams = scene.drive(drives[0].vehicle).sensor.beams
    jury = Jury(first_map, truth)
    best = "columns" if any(case.name == "columns" for case in cases) else cases[0].name
    outcomes, entries = {}, {}
    for i, case in enumerate(cases):
        if progress:
            progress("scoring", i, len(cases))
        ballots = [drive.ballots[case.name] for drive in drives]
        outcome = fuse_case(first_map, ballots, case.min_votes, scene.settings.fuse, jury.window)
        outcomes[case.name] = outcome
        entries[case.name] = {
            **jury.of_update(outcome),
            "bytes_per_vehicle": [drive.sizes[case.name] for drive in drives],
            "state_bytes_per_vehicle": [_state_bytes(ballot) for ballot in ballots],
        }
    if progress:
        progress("scoring", len(cases), len(cases))
    T_map_world = map_frame(scene)
    maps = {
        "old map": (first_map, T_map_world),
        f"updated map ({best})": (outcomes[best].updated, T_map_world),
    }
    scored = time.perf_counter()
    costs = {}
    if with_yardsticks:
        maps["map surveyed anew"] = survey_anew(scene, drives[0].vehicle, progress)
        measured, costs["case 5"] = yardsticks(scene, drives, workers, progress)
        for name, yardstick in measured.items():
            costs[name] = yardstick.cost
            entries[name] = {
                **jury.of_states(yardstick.states, yardstick.vehicle_states),
                "bytes_per_vehicle": [],
            }
    result = {
        "scenario": scene.scenario,
        "seed": scene.seed,
        "poses": "truth" if scene.conditions.true_poses else "ndt",
        "cells": int(truth.strict.size),
        "coverage": entries[best]["coverage"],
        "settings": scene.settings.model_dump(mode="json"),
        "map_shift": map_shift(scene),
        "localisation": localisation(scene, drives),
        "changed_areas": in_changed_areas(scene, truth, drives[0].vehicle, maps),
        "cases": entries,
        "timings": {
            "prepare_s": prepared - started,
            "vote_s": voted - prepared,
            "score_s": scored - voted,
            "yardsticks_s": time.perf_counter() - scored,
            "methods": {name: {"beams": beams, **cost} for name, cost in costs.items()},
            "stages_ms": {drive.vehicle: drive.stage_ms for drive in drives},
            "fuse_s": {name: outcome.seconds for name, outcome in outcomes.items()},
        },
    }
    return Evaluation(result, scene, truth, jury.window, first_map, outcomes, drives)


class Jury:
    """Scores whatever was decided about one first map against one truth."""

    def __init__(self, first_map: PointMap, truth: Truth) -> None:
        self.truth = truth
        self.window = truth.grid_on(first_map.lattice)
        self._points = MapJudge(map_obstacles(first_map), *_above_ground(first_map, truth))
        self._objects = [{"kind": o["kind"], "cells": truth.cells_of(o["footprint"])} for o in truth.objects]

    def of_states(self, states: U8, vehicle_states: Sequence[U8]) -> dict[str, Any]:
        """R for both truths, coverage, objects; all states over the truth's window."""
        strict, provenance = self.truth.strict, self.truth.provenance
        return {
            "strict": score_cells(states, strict).to_dict(),
            "provenance": score_cells(states, provenance).to_dict(),
            "coverage": coverage(vehicle_states, strict),
            "objects": score_objects(states, strict, self._objects, CELL_SIZE).to_dict(),
        }

    def of_update(self, outcome: Outcome) -> dict[str, Any]:
        """The same, and what became of the map's points."""
        points = self._points.score(map_obstacles(outcome.updated)).to_dict()
        return {**self.of_states(outcome.states, outcome.vehicle_states), "map": points}


def _above_ground(first_map: PointMap, truth: Truth) -> tuple[F64, F64, F64]:
    """Surface samples that could be obstacle points: at least 0.3 m above the map's ground, where that is known."""
    reference = reference_window(first_map, truth.grid_on(first_map.lattice))
    chosen = []
    for samples in truth.surfaces():
        rows, cols, inside = reference.grid.indices_of(samples)
        ground = reference.ground_z[rows.clip(0, reference.grid.rows - 1), cols.clip(0, reference.grid.cols - 1)]
        low = inside & (samples[:, 2] - ground < GROUND_MARGIN_M)
        chosen.append(samples[~low])
    return chosen[0], chosen[1], chosen[2]


def _state_bytes(ballot: Ballot) -> int:
    """Bytes of the votes alone, without new points and other planes."""
    return sum(len(tile.states or tile.tally or b"") for tile in ballot.tiles)


def map_shift(scene: Scene) -> dict[str, float]:
    """How far the first map lies from the truth: mean offset of the survey's poses, and the 95 % of their distances."""
    names = scene.drive_names("survey_")
    offset = np.concatenate([scene.survey_poses(n)[:, :3, 3] - scene.true_poses(n)[:, :3, 3] for n in names])
    mean = offset.mean(axis=0)
    return {
        "mean_m": float(np.linalg.norm(mean)),
        "x_m": float(mean[0]),
        "y_m": float(mean[1]),
        "z_m": float(mean[2]),
        "p95_m": float(np.percentile(np.linalg.norm(offset, axis=1), 95)),
    }


def map_frame(scene: Scene) -> F64:
    """T_map_world: the truth's frame in the map's, by the survey's trajectory."""
    names = scene.drive_names("survey_")
    believed = np.concatenate([scene.survey_poses(n) for n in names])
    return rigid_between(believed, np.concatenate([scene.true_poses(n) for n in names]))


def localisation(scene: Scene, drives: Sequence[Pass]) -> dict[str, dict[str, float]]:
    """Each vehicle's pose errors in the map's frame."""
    T_map_world = map_frame(scene)
    return {d.vehicle: error_summary(d.T_map_lidar, T_map_world @ scene.true_poses(d.vehicle)) for d in drives}
