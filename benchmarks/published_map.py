"""What the paper's cases make of a map that keeps its strays, on the drives that `published.py` has had voted.

    python benchmarks/published.py --without-strays --folder out/published      # drives, maps and what each scan said
    python benchmarks/published_map.py --seeds 41,42,43,44,45 --csv results/published_map.csv

The surveys are laid again at the poses of their map, once leaving strays out (a check: near what was voted on) and once
keeping them; then the cases are decided by look-up from what the vehicles' scans said. What does not follow the map
that way: the vehicles' poses, and which cells case 5 calls invalid. Truth: provenance.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean

import numpy as np

from mapvote.config import Settings, cache_folder
from mapvote.core.point_map import PointMap, all_points, map_from_points
from mapvote.core.reference import reference_window
from mapvote.evaluation.experiments.cases import choose_cases
from mapvote.evaluation.experiments.kept import read_kept
from mapvote.evaluation.experiments.passes import pass_folder
from mapvote.evaluation.experiments.scene import Scene
from mapvote.evaluation.experiments.study import as_paper
from mapvote.evaluation.experiments.sweep import decided
from mapvote.evaluation.scoring.cells import CLASSES, Scores, score_cells
from mapvote.simulation.scenario import load_scenario
from mapvote.slam.accumulate import Layer

SCENARIO, CASES = "as_published", "1,2,3,4,5"
VOTED, DROPPED, KEPT = "as voted on", "laid again, without strays", "laid again, with strays"


def laid_again(scene: Scene) -> Iterator[tuple[str, PointMap]]:
    """The map of the surveys at the poses that its own SLAM found, without and with strays."""
    first = scene.point_map
    road = np.concatenate(first.driven)
    layer = Layer(map_from_points(all_points(first), lattice=first.lattice, road=road), scene.settings, road)
    for name in scene.drive_names("survey_"):
        poses = scene.survey_poses(name)
        layer.lay(scene.drive(name), poses, np.ones(len(poses), dtype=np.bool_), lambda: None)
    for name, drop in ((DROPPED, True), (KEPT, False)):
        mapping = scene.settings.mapping.model_copy(update={"drop_strays": drop})
        layer.settings = scene.settings.model_copy(update={"mapping": mapping})
        yield name, layer.finish()


def measured(scene: Scene) -> Iterator[tuple[str, dict[str, Scores]]]:
    """By map: the scores of each case."""
    cases, _ = choose_cases(scene.settings, CASES)
    truth, first = scene.truth, scene.point_map
    window = truth.grid_on(first.lattice)
    drives = [read_kept(pass_folder(scene, cases, name, True), window) for name in scene.drive_names("v")]
    for name, point_map in ((VOTED, first), *laid_again(scene)):
        states = decided(drives, reference_window(point_map, window).counts > 0, cases)
        yield name, {case: score_cells(server, truth.provenance) for case, (server, _) in states.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="41,42,43,44,45")
    parser.add_argument("--cache", type=Path, default=cache_folder())
    parser.add_argument("--csv", type=Path, help="a seed that is in it already is not laid again")
    options = parser.parse_args()
    settings = as_paper(Settings(), SCENARIO, ["mapping.drop_strays"])
    scenario = load_scenario(SCENARIO)
    overrides = {"sensor": scenario.sensor, "temporary_cars": scenario.temporary_cars}
    rows: list[list[str]] = []
    if options.csv is not None and options.csv.exists():
        rows = list(csv.reader(options.csv.open()))[1:]
    for seed in options.seeds.split(","):
        if any(row[0] == seed for row in rows):
            continue
        for name, scores in measured(Scene(SCENARIO, int(seed), settings, options.cache, overrides)):
            for case, score in scores.items():
                values = [score.macro_f1, *score.precision, *score.recall]
                rows.append([seed, name, case, *(f"{value:.4f}" for value in values)])
        if options.csv is not None:
            with options.csv.open("w", newline="") as file:
                head = ["macro_f1", *(f"{what}_{kind}" for what in ("precision", "recall") for kind in CLASSES)]
                csv.writer(file, lineterminator="\n").writerows([["seed", "map", "case", *head], *rows])
    for name in (VOTED, DROPPED, KEPT):
        for case in CASES.split(","):
            mine = [[float(v) for v in row[3:]] for row in rows if row[1:3] == [name, case]]
            means = " ".join(f"{fmean(column):.3f}" for column in zip(*mine, strict=True))
            macros = [row[0] for row in mine]
            print(f"{name}; case {case}: {means}; macro-F1 {min(macros):.3f} to {max(macros):.3f}")


if __name__ == "__main__":
    main()
