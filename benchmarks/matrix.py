"""The experiment matrix: every case, every condition, over seeds; means, spread and worst in Markdown.

    python benchmarks/matrix.py --seeds 3,5,6,7,8 --out out/matrix  # everything: days
    python benchmarks/matrix.py --scenario corner --seeds 1 --experiments main,liars # minutes

A run that was cut short goes on where it stopped: OUT/EXPERIMENT-SEED.json is kept for every experiment that is done.
Seed 1 of `street570` is for development: report on others.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import msgspec

from mapvote.codec.ballot import Ballot
from mapvote.config import cache_folder, load_settings
from mapvote.core.point_map import PointMap
from mapvote.formats.atomic import whole_file
from mapvote_lab.evaluation.experiments.cases import Case, choose_cases, fuse_case
from mapvote_lab.evaluation.experiments.conditions import ATTACKS, Conditions
from mapvote_lab.evaluation.experiments.scene import Pass, Scene, have_voted, passes
from mapvote_lab.evaluation.reporting.tables import Sheet
from mapvote_lab.evaluation.results import CaseResult, to_json
from mapvote_lab.evaluation.truths import Jury

Round = tuple[str, int, Sequence[Ballot]]
"""Name, quorum and ballots that the server is given."""
Rounds = Callable[[Sequence[Pass], Sequence[Case], PointMap], Iterator[Round]]
FALSE_OBJECT_M2 = 2.0
FIGURES: Mapping[str, Callable[[CaseResult], float]] = {
    "macro strict": lambda e: e.strict.macro_f1,
    "macro prov.": lambda e: e.provenance.macro_f1,
    "macro border": lambda e: e.also["border"].macro_f1,
    "F1 ch.-occ. strict": lambda e: e.strict.f1.changed_occupied,
    "F1 ch.-empty strict": lambda e: e.strict.f1.changed_empty,
    "determined by a vehicle": lambda e: e.coverage,
    "stale deleted": lambda e: e.map.stale_deleted if e.map else 0.0,
    "valid deleted": lambda e: e.map.valid_deleted if e.map else 0.0,
    "new added": lambda e: e.map.new_added if e.map else 0.0,
    "added on no surface": lambda e: e.map.added_false if e.map else 0.0,
    "objects found": lambda e: statistics.fmean(e.objects.found or [True]),
    "false objects > 2 m2": lambda e: float(sum(area > FALSE_OBJECT_M2 for area in e.objects.false_m2)),
}
HARMS = "valid deleted", "added on no surface", "false objects > 2 m2"


def as_sent(drives: Sequence[Pass], cases: Sequence[Case], first_map: PointMap) -> Iterator[Round]:
    """Every case, all vehicles."""
    for case in cases:
        yield case.name, case.min_votes, [drive.ballots[case.name] for drive in drives]


def growing(drives: Sequence[Pass], cases: Sequence[Case], first_map: PointMap) -> Iterator[Round]:
    """Every case, with the first 3, 5, 7 and 10 vehicles."""
    for case, n in product(cases, (3, 5, 7, 10)):
        if n <= len(drives):
            yield f"{case.name}, {n} vehicles", case.min_votes, [d.ballots[case.name] for d in drives[:n]]


def with_liars(drives: Sequence[Pass], cases: Sequence[Case], first_map: PointMap) -> Iterator[Round]:
    """Surfaces, for k = 1, 2, 3: 2k + 1 vehicles with min_votes = k + 1, all honest, and the last k of them lying."""
    for k in (1, 2, 3):
        n = 2 * k + 1
        if n > len(drives):
            return
        honest = [drive.ballots["surfaces"] for drive in drives[:n]]
        yield f"surfaces, {n} honest", k + 1, honest
        for name, attack in ATTACKS.items():
            lies = [attack(ballot, first_map, honest[0]) for ballot in honest[-k:]]
            yield f"surfaces, {k} of {n} {name}", k + 1, [*honest[:-k], *lies]


@dataclass(frozen=True)
class Experiment:
    """Some cases on the drives of a street under some conditions."""

    cases: str = "1 column,surfaces"
    overrides: Mapping[str, Any] = field(default_factory=dict)
    """Of the scenario."""
    conditions: Conditions = field(default_factory=Conditions)
    rounds: Rounds = as_sent


EXPERIMENTS: Mapping[str, Experiment] = {
    "main": Experiment("all"),
    "liars": Experiment("all", rounds=with_liars),
    "noise": Experiment(conditions=Conditions(noise_m=0.1, noise_deg=0.2)),
    "2 Hz": Experiment(conditions=Conditions(scans="::5")),
    "parked": Experiment(overrides={"temporary_cars": 12}),
    "vehicles": Experiment(overrides={"vehicles": 10}, rounds=growing),
    "many liars": Experiment(overrides={"vehicles": 10}, rounds=with_liars),
    "5 Hz": Experiment(conditions=Conditions(scans="::2")),
    "noise told": Experiment(conditions=Conditions(noise_m=0.1, noise_deg=0.2, noise_told=True)),
    "all true": Experiment(conditions=Conditions(true_poses=True, true_moving=True, true_ground=True)),
    "true poses": Experiment(conditions=Conditions(true_poses=True)),
    "true moving": Experiment(conditions=Conditions(true_moving=True)),
    "true ground": Experiment(conditions=Conditions(true_ground=True)),
    "64 beams": Experiment(overrides={"sensor": "hdl64e"}),
    "16 beams": Experiment(overrides={"sensor": "vlp16"}),
}
"""The most important first."""


def measured(asked: argparse.Namespace, name: str, seed: int) -> dict[str, CaseResult]:
    """By round what came of an experiment on one seed; kept in OUT."""
    file = asked.out / f"{name.replace(' ', '_')}-{seed}.json"
    if not file.is_file():
        experiment, settings = EXPERIMENTS[name], load_settings(asked.config)
        scene = Scene(asked.scenario, seed, settings, asked.cache, dict(experiment.overrides), experiment.conditions)
        cases, _ = choose_cases(settings, experiment.cases)
        if not have_voted(scene, cases):
            scene.prepare()
        drives, jury = passes(scene, cases, 1), Jury(scene.point_map, scene.truth)
        found: dict[str, CaseResult] = {}
        for of_round, quorum, ballots in experiment.rounds(drives, cases, scene.point_map):
            found[of_round] = jury.of_update(fuse_case(scene.point_map, ballots, quorum, settings.fuse, jury.window))
        with whole_file(file) as partial:
            partial.write_text(to_json(found))
    return msgspec.json.decode(file.read_bytes(), type=dict[str, CaseResult])


def table(title: str, by_seed: Sequence[Mapping[str, CaseResult]]) -> Sheet:
    """A line for each round, "mean ± deviation (worst)" for each figure."""
    rows = []
    for of_round in by_seed[0]:
        row = [of_round]
        for figure, of in FIGURES.items():
            values = [of(found[of_round]) for found in by_seed if of_round in found]
            deviation = statistics.stdev(values) if len(values) > 1 else 0.0
            worst = max(values) if figure in HARMS else min(values)
            row.append(f"{statistics.fmean(values):.3f} ± {deviation:.3f} ({worst:.3f})")
        rows.append(row)
    return Sheet(title, ["", *FIGURES], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="street570", help="a scenario's name or file (default street570)")
    parser.add_argument("--seeds", default="3,5,6,7,8", help="comma-separated (default 3,5,6,7,8)")
    parser.add_argument("--experiments", default=",".join(EXPERIMENTS), help=f"of: {', '.join(EXPERIMENTS)}")
    parser.add_argument("--out", type=Path, default=Path("out/matrix"))
    parser.add_argument("--cache", type=Path, default=cache_folder(), help="where drives, maps and ballots are kept")
    parser.add_argument("--config", type=Path, help="settings (TOML)")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    sheets = []
    for name in asked.experiments.split(","):
        by_seed = [measured(asked, name, int(seed)) for seed in asked.seeds.split(",")]
        sheets.append(table(f"{name} (seeds {asked.seeds})", by_seed).to_markdown())
        (asked.out / "matrix.md").write_text("\n".join(sheets))
        print(sheets[-1])


if __name__ == "__main__":
    main()
