"""The experiments: what is put to the vote, on which drives, under which conditions.

An experiment on one street is one result, kept as JSON under a name that says what it depends on: a run that was cut
short goes on where it stopped, and experiments that share drives, maps or ballots share them in the cache.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import asdict

from mapvote.codec.ballot import Ballot
from mapvote.config import Settings
from mapvote.core.point_map import PointMap
from mapvote.formats.atomic import whole_file
from mapvote_lab.evaluation.experiments.attacks import ATTACKS
from mapvote_lab.evaluation.experiments.cases import Case, choose_cases, fuse_case
from mapvote_lab.evaluation.experiments.conditions import Conditions
from mapvote_lab.evaluation.experiments.localisation_errors import localisation, map_shift
from mapvote_lab.evaluation.experiments.passes import Pass, have_voted, passes
from mapvote_lab.evaluation.experiments.scene import BALLOTS_FROM, Progress, Scene, key_of, sources_digest
from mapvote_lab.evaluation.results import MatrixResult, RoundResult, to_json
from mapvote_lab.evaluation.scoring.cells import UNSCORED, determined, ratio, score_cells
from mapvote_lab.evaluation.scoring.jury import CaseOutcome, Jury
from mapvote_lab.simulation.processes import processes

_SCORES_FROM = (
    *BALLOTS_FROM, "fusion", "simulation", "evaluation/scoring", "evaluation/evaluate.py", "evaluation/results.py",
    "evaluation/experiments/attacks.py", "evaluation/experiments/cases.py", "evaluation/experiments/conditions.py",
    "evaluation/experiments/matrix.py",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class BallotSet:
    """One set of ballots that the server is given."""

    name: str
    min_votes: int
    ballots: Sequence[Ballot]


BallotSets = Callable[[Sequence[Pass], Sequence[Case], PointMap], Iterator[BallotSet]]
"""What is made of the vehicles' passes."""


def as_sent(drives: Sequence[Pass], cases: Sequence[Case], first_map: PointMap) -> Iterator[BallotSet]:
    """Every case, all vehicles."""
    for case in cases:
        yield BallotSet(case.name, case.min_votes, [drive.ballots[case.name] for drive in drives])


def growing(drives: Sequence[Pass], cases: Sequence[Case], first_map: PointMap) -> Iterator[BallotSet]:
    """Every case, with the first 3, 5, 7 and 10 vehicles."""
    for case, n in product(cases, (3, 5, 7, 10)):
        if n <= len(drives):
            yield BallotSet(f"{case.name}, {n} vehicles", case.min_votes, [d.ballots[case.name] for d in drives[:n]])


def with_liars(drives: Sequence[Pass], cases: Sequence[Case], first_map: PointMap) -> Iterator[BallotSet]:
    """Surfaces, for k = 1, 2, 3: 2k + 1 vehicles with min_votes = k + 1, all honest, and the last k of them lying."""
    for k in (1, 2, 3):
        n = 2 * k + 1
        if n > len(drives):
            return
        honest = [drive.ballots["surfaces"] for drive in drives[:n]]
        yield BallotSet(f"surfaces, {n} honest", k + 1, honest)
        for name, attack in ATTACKS.items():
            lies = [attack(ballot, first_map, honest[0]) for ballot in honest[-k:]]
            yield BallotSet(f"surfaces, {k} of {n} {name}", k + 1, [*honest[:-k], *lies])


@dataclass(frozen=True)
class Experiment:
    """Some cases on the drives of a street under some conditions."""

    cases: str
    overrides: Mapping[str, Any] = field(default_factory=dict)
    """Of the scenario."""
    conditions: Conditions = field(default_factory=Conditions)
    rounds: BallotSets = as_sent


_BOTH = "1 column,surfaces"
"""Experiments with the same cases on the same drives share their ballots."""
_TEN = {"vehicles": 10}
EXPERIMENTS: Mapping[str, Experiment] = {
    "main": Experiment("all"),
    "liars": Experiment("all", rounds=with_liars),
    "noise": Experiment(_BOTH, conditions=Conditions(noise_m=0.1, noise_deg=0.2)),
    "2 Hz": Experiment(_BOTH, conditions=Conditions(scans="::5")),
    "parked": Experiment(_BOTH, {"temporary_cars": 12}),
    "vehicles": Experiment(_BOTH, _TEN, rounds=growing),
    "many liars": Experiment(_BOTH, _TEN, rounds=with_liars),
    "5 Hz": Experiment(_BOTH, conditions=Conditions(scans="::2")),
    "noise told": Experiment(_BOTH, conditions=Conditions(noise_m=0.1, noise_deg=0.2, noise_told=True)),
    "all true": Experiment(_BOTH, conditions=Conditions(true_poses=True, true_moving=True, true_ground=True)),
    "true poses": Experiment(_BOTH, conditions=Conditions(true_poses=True)),
    "true moving": Experiment(_BOTH, conditions=Conditions(true_moving=True)),
    "true ground": Experiment(_BOTH, conditions=Conditions(true_ground=True)),
    "64 beams": Experiment(_BOTH, {"sensor": "hdl64e"}),
    "16 beams": Experiment(_BOTH, {"sensor": "vlp16"}),
}
"""In the order in which they are run: the most important first."""


@dataclass(frozen=True)
class Matrix:
    """Scenarios and seeds to run the experiments on."""

    scenario: str
    seeds: tuple[int, ...]
    cache: Path
    settings: Settings
    workers: int = 2
    cases: str | None = None
    """Instead of all that there are, where an experiment is on all: fewer cases, less time."""
    parked: int | None = None
    """Instead of twelve, where an experiment parks cars: a short street has no room for them."""

    def scene(self, experiment: Experiment, seed: int) -> Scene:
        """The drives of one experiment."""
        overrides = dict(experiment.overrides)
        if self.parked is not None and "temporary_cars" in overrides:
            overrides["temporary_cars"] = self.parked
        return Scene(self.scenario, seed, self.settings, self.cache, overrides, experiment.conditions)

    def result_file(self, name: str, seed: int) -> Path:
        """Where the result of an experiment on one seed is kept."""
        experiment = EXPERIMENTS[name]
        key = key_of(sources_digest(_SCORES_FROM), self.settings.model_dump_json(), self._cases(experiment))
        return self.scene(experiment, seed).work / "results" / f"{name.replace(' ', '-')}-{key}.json"

    def run_all(self, names: Sequence[str]) -> Iterator[tuple[str, int, MatrixResult]]:
        """(experiment, seed, result) of every experiment on every seed, as each ends: ``workers`` at a time, each on
        one core, the first of ``names`` first. Two of one seed never run together: they share drives, map and ballots.
        """
        alone = replace(self, workers=1)
        waiting = [(name, seed) for name in names for seed in self.seeds]
        running: dict[Future[MatrixResult], tuple[str, int]] = {}
        with processes(self.workers) as pool:
            while waiting or running:
                for name, seed in list(waiting):
                    if len(running) < self.workers and all(seed != other for _, other in running.values()):
                        running[pool.submit(alone.run, name, seed)] = (name, seed)
                        waiting.remove((name, seed))
                for ended in wait(running, return_when=FIRST_COMPLETED).done:
                    yield *running.pop(ended), ended.result()

    def run(self, name: str, seed: int, progress: Progress | None = None) -> MatrixResult:
        """The result of one experiment on one seed: entries by round, as in ``evaluate --json``, and the poses'."""
        file = self.result_file(name, seed)
        if not file.is_file():
            result = self._measure(EXPERIMENTS[name], seed, progress)
            with whole_file(file) as partial:
                partial.write_text(to_json(result))
        return msgspec.json.Decoder(MatrixResult).decode(file.read_bytes())

    def _measure(self, experiment: Experiment, seed: int, progress: Progress | None) -> MatrixResult:
        scene = self.scene(experiment, seed)
        cases, _ = choose_cases(self.settings, self._cases(experiment))
        if not have_voted(scene, cases):
            scene.prepare(progress)
        drives = passes(scene, cases, self.workers, progress)
        first_map = scene.point_map
        jury = Jury(first_map, scene.truth)
        entries = {}
        for i, turn in enumerate(experiment.rounds(drives, cases, first_map)):
            if progress:
                progress("scoring", i, 0)
            outcome = fuse_case(first_map, turn.ballots, turn.min_votes, self.settings.fuse, jury.window)
            entries[turn.name] = _judged(outcome, jury)
        return MatrixResult(
            scenario=self.scenario,
            seed=seed,
            cells=int(scene.truth.strict.size),
            map_shift=map_shift(scene),
            localisation=localisation(scene, drives),
            ceilings=jury.ceilings(),
            rounds=entries,
        )

    def _cases(self, experiment: Experiment) -> str:
        return self.cases if self.cases and experiment.cases == "all" else experiment.cases

    def drop_drives(self, names: Sequence[str], seed: int) -> None:
        """Delete the scans of a seed once every experiment of ``names`` on them has its result."""
        scenes = {self.scene(EXPERIMENTS[name], seed).folder: self.scene(EXPERIMENTS[name], seed) for name in names}
        for name in names:
            if not self.result_file(name, seed).is_file():
                scenes.pop(self.scene(EXPERIMENTS[name], seed).folder, None)
        for folder, scene in scenes.items():
            if folder.exists():
                scene.drop_drives()


def _judged(outcome: CaseOutcome, jury: Jury) -> RoundResult:
    """With two more views that others may prefer: old surfaces that no survey saw counted as unchanged, and the share
    of cells that the fleet determined."""
    strict, provenance = jury.truth.with_old_surfaces()
    scored = jury.truth.strict != UNSCORED
    return RoundResult(
        **asdict(jury.of_update(outcome)),
        strict_old_unchanged=score_cells(outcome.states, strict),
        provenance_old_unchanged=score_cells(outcome.states, provenance),
        determined=ratio(np.count_nonzero(determined(outcome.states) & scored), np.count_nonzero(scored)),
    )
