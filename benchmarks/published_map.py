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
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean

import numpy as np

from mapvote.config import Settings, cache_folder
from mapvote.core.point_map import PointMap, all_points, map_from_points
from mapvote.core.reference import reference_window
from mapvote.slam.accumulate import Layer
from mapvote.slam.road_prior import all_roads, road_under
from mapvote_lab.evaluation.experiments.cases import choose_cases
from mapvote_lab.evaluation.experiments.kept import read_kept
from mapvote_lab.evaluation.experiments.passes import pass_folder
from mapvote_lab.evaluation.experiments.scene import Scene
from mapvote_lab.evaluation.experiments.study import as_paper
from mapvote_lab.evaluation.experiments.sweep import decided
from mapvote_lab.evaluation.scoring.cells import CLASSES, Scores, score_cells
from mapvote_lab.evaluation.scoring.paper_tables import F1, PRECISION, RECALL
from mapvote_lab.simulation.scenario import load_scenario

SCENARIO, CASES = "as_published", "1,2,3,4,5"
VOTED, DROPPED, KEPT = "as voted on", "laid again, without strays", "laid again, with strays"


def laid_again(scene: Scene) -> Iterator[tuple[str, PointMap]]:
    """The map of the surveys at the poses that its own SLAM found, without and with strays."""
    first, names = scene.point_map, scene.drive_names("survey_")
    poses = {name: scene.survey_poses(name) for name in names}
    registered = {name: np.ones(len(T), dtype=np.bool_) for name, T in poses.items()}
    cloud = all_points(first)
    road = all_roads([road_under(poses[name], registered[name], cloud) for name in names])
    layer = Layer(map_from_points(cloud, lattice=first.lattice, road=road), scene.settings, road)
    for name in names:
        layer.lay(scene.drive(name), poses[name], registered[name], lambda: None)
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
    tables(rows)


def tables(rows: Sequence[Sequence[str]]) -> None:
    """Macro-F1 by map and case, precision and recall of the changed classes, and the paper's order of cases."""
    seeds = sorted({row[0] for row in rows})
    values = {(row[0], row[1], row[2]): [float(v) for v in row[3:]] for row in rows}
    cases = CASES.split(",")

    def line(name: str, cells: Sequence[str]) -> None:
        print(f"| {' | '.join([name, *cells])} |")

    line(f"macro-F1, mean (range) of seeds {', '.join(seeds)}", [f"case {case}" for case in cases])
    line("---", ["---"] * len(cases))
    line("the paper, on its street", [f"{F1[case]:.3f}" for case in cases])
    for name in (VOTED, DROPPED, KEPT):
        each = [[values[seed, name, case][0] for seed in seeds] for case in cases]
        line(name, [f"{fmean(some):.3f} ({min(some):.3f} to {max(some):.3f})" for some in each])
    for k, kind in ((1, "changed-occupied"), (2, "changed-empty")):
        line(f"{kind}, P / R: the paper", [f"{PRECISION[case][k]:.3f} / {RECALL[case][k]:.3f}" for case in cases])
        for name in (VOTED, KEPT):
            each = [[fmean(values[seed, name, case][i] for seed in seeds) for i in (k + 1, k + 4)] for case in cases]
            line(f"{kind}, P / R: {name}", [f"{p:.3f} / {r:.3f}" for p, r in each])
    for a, b in (("1", "2"), ("5", "1"), ("1", "3"), ("2", "4"), ("3", "4")):
        for name in (VOTED, KEPT):
            gains = [values[seed, name, a][0] - values[seed, name, b][0] for seed in seeds]
            ahead = sum(gain > 0 for gain in gains)
            print(f"case {a} over {b}, {name}: {fmean(gains):+.3f}, ahead on {ahead} of {len(seeds)}")


if __name__ == "__main__":
    main()
