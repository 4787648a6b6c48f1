"""``mapvote evaluate``: a scenario and a seed become Tables II-IV and what else there is to measure (paper V)."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from msgspec.structs import asdict

from mapvote.codec.ballot import Ballot
from mapvote.core.grid import Grid
from mapvote.core.point_map import PointMap
from mapvote_lab.evaluation.baselines.baselines import yardsticks
from mapvote_lab.evaluation.experiments.cases import Case, fuse_case
from mapvote_lab.evaluation.experiments.localisation_errors import (
    T_map_world_of,
    in_changed_areas,
    localisation,
    map_shift,
    survey_anew,
)
from mapvote_lab.evaluation.experiments.paper_readings import read_kept, swept
from mapvote_lab.evaluation.experiments.passes import Pass, pass_folder, passes
from mapvote_lab.evaluation.experiments.scene import Progress, Scene
from mapvote_lab.evaluation.results import CaseResult, Cost, EvaluationResult, Timings
from mapvote_lab.evaluation.scoring.cells import Scores
from mapvote_lab.evaluation.scoring.jury import CaseOutcome, Jury
from mapvote_lab.evaluation.scoring.scene_truth import Truth
from mapvote_lab.evaluation.scoring.truths import SIDE_BY_SIDE, sizes_by_height


@dataclass(frozen=True)
class Evaluation:
    """The numbers, and what pictures need."""

    result: EvaluationResult
    scene: Scene
    truth: Truth
    window: Grid
    first_map: PointMap
    outcomes: Mapping[str, CaseOutcome]
    drives: Sequence[Pass]
    best: str
    """The case whose updated map is shown: the one that the settings vote by, else the first."""


def evaluate(
    scene: Scene,
    cases: Sequence[Case],
    with_yardsticks: bool = False,
    progress: Progress | None = None,
    readings: str | None = None,
) -> Evaluation:
    """Run what the cache lacks, decide and score every case. Two processes where there are two cores.

    ``readings``: the open sentence of the paper (a setting of ``[paper]``) whose other readings are scored too; "all":
    every sentence; None: no other reading.
    """
    started = time.perf_counter()
    scene.prepare(progress)
    prepared = time.perf_counter()
    workers = min(2, os.cpu_count() or 1)
    drives = passes(scene, cases, workers, progress, keep=readings is not None)
    voted = time.perf_counter()
    truth, first_map = scene.truth, scene.point_map
    beams = scene.drive(drives[0].vehicle).sensor.beams
    jury = Jury(first_map, truth)
    best = _best(scene, cases)
    outcomes, entries = _scored(scene, cases, drives, jury, progress)
    T_map_world = T_map_world_of(scene)
    maps = {"old map": (first_map, T_map_world), f"updated map ({best})": (outcomes[best].updated, T_map_world)}
    scored = time.perf_counter()
    costs = {}
    if with_yardsticks:
        maps["map surveyed anew"] = survey_anew(scene, drives[0].vehicle, progress)
        measured, costs["case 5"] = yardsticks(scene, drives, workers, progress)
        for name, yardstick in measured.items():
            costs[name] = yardstick.cost
            judgement = jury.of_states(yardstick.states, yardstick.vehicle_states)
            entries[name] = CaseResult(**asdict(judgement), bytes_per_vehicle=[])
    result = EvaluationResult(
        scenario=scene.scenario,
        seed=scene.seed,
        poses="truth" if scene.conditions.true_poses else "ndt",
        cells=int(truth.strict.size),
        coverage=entries[best].coverage,
        settings=scene.settings.model_dump(mode="json"),
        map_shift=map_shift(scene),
        localisation=localisation(scene, drives),
        changed_areas=in_changed_areas(scene, truth, drives[0].vehicle, maps),
        ceilings=jury.ceilings(),
        truth_sizes={name: sizes_by_height(jury.truths[name], truth, jury.first_map) for name in SIDE_BY_SIDE},
        cases=entries,
        readings={} if readings is None else _readings(scene, cases, jury, readings, progress),
        timings=Timings(
            prepare_s=prepared - started,
            vote_s=voted - prepared,
            score_s=scored - voted,
            yardsticks_s=time.perf_counter() - scored,
            methods={name: Cost(beams, cost["ms_per_scan"], cost["memory_bytes"]) for name, cost in costs.items()},
            stages_ms={drive.vehicle: drive.stage_ms for drive in drives},
            fuse_s={name: outcome.seconds for name, outcome in outcomes.items()},
        ),
    )
    return Evaluation(result, scene, truth, jury.window, first_map, outcomes, drives, best)


def _readings(
    scene: Scene, cases: Sequence[Case], jury: Jury, only: str, progress: Progress | None
) -> dict[str, dict[str, dict[str, Scores]]]:
    """Scores by reading, case and truth, from what the scans of the vehicles' drives said."""
    kept = [read_kept(pass_folder(scene, cases, name, True)) for name in scene.drive_names("v")]
    truths = {name: jury.truths[name] for name in SIDE_BY_SIDE}
    return swept(kept, jury.first_map.counts > 0, scene.settings, truths, None if only == "all" else only, progress)


def _best(scene: Scene, cases: Sequence[Case]) -> str:
    names = [case.name for case in cases]
    return scene.settings.voting.method if scene.settings.voting.method in names else names[0]


def _scored(
    scene: Scene, cases: Sequence[Case], drives: Sequence[Pass], jury: Jury, progress: Progress | None
) -> tuple[dict[str, CaseOutcome], dict[str, CaseResult]]:
    """By case: what the server makes of its ballots, and the scores."""
    outcomes: dict[str, CaseOutcome] = {}
    entries: dict[str, CaseResult] = {}
    for i, case in enumerate(cases):
        if progress:
            progress("scoring", i, len(cases))
        ballots = [drive.ballots[case.name] for drive in drives]
        outcome = fuse_case(scene.point_map, ballots, case.min_votes, scene.settings.fuse, jury.window)
        outcomes[case.name] = outcome
        entries[case.name] = CaseResult(
            **asdict(jury.of_update(outcome)),
            bytes_per_vehicle=[drive.sizes[case.name] for drive in drives],
            state_bytes_per_vehicle=[_state_bytes(ballot) for ballot in ballots],
        )
    if progress:
        progress("scoring", len(cases), len(cases))
    return outcomes, entries


def _state_bytes(ballot: Ballot) -> int:
    """Bytes of the votes alone, without new points and other planes."""
    return sum(len(tile.states or tile.tally or b"") for tile in ballot.tiles)
