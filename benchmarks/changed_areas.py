"""What the updated map is for: localisation within 30 m of a change, in the old map, the updated one, and a new one.

    python benchmarks/changed_areas.py --seeds 3,5,6,7,8 --out out/changed_areas.json

The first vehicle localises by NDT in each map from its own prior; errors are to the truth, in each map's frame. The
new map is our own SLAM over the other vehicles' drives with a survey vehicle's RTK. Drives, first maps and ballots come
from the cache that benchmarks/matrix.py fills, or are made.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mapvote.config import cache_folder, load_settings
from mapvote.formats.atomic import whole_file
from mapvote_lab.evaluation.experiments.cases import COLUMNS_V1, choose_cases, fuse_case
from mapvote_lab.evaluation.experiments.changed_areas import in_changed_areas, survey_anew
from mapvote_lab.evaluation.experiments.passes import passes
from mapvote_lab.evaluation.experiments.pose_errors import map_frame
from mapvote_lab.evaluation.experiments.scene import Scene
from mapvote_lab.evaluation.results import to_json
from mapvote_lab.evaluation.scoring.truth import PoseErrors

OLD, UPDATED, ANEW = "old map", "updated map", "map surveyed anew"


def measure(scene: Scene, workers: int) -> dict[str, PoseErrors]:
    """Errors by map, as :func:`mapvote_lab.evaluation.scoring.truth.error_summary` gives them."""
    scene.prepare()
    cases, _ = choose_cases(scene.settings, "all")
    drives = passes(scene, cases, workers)
    [columns] = [case for case in cases if case.name == COLUMNS_V1]
    first_map, truth = scene.point_map, scene.truth
    ballots = [drive.ballots[COLUMNS_V1] for drive in drives]
    window = truth.grid_on(first_map.lattice)
    updated = fuse_case(first_map, ballots, columns.min_votes, scene.settings.fuse, window).updated
    T_map_world = map_frame(scene)
    maps = {
        OLD: (first_map, T_map_world),
        UPDATED: (updated, T_map_world),
        ANEW: survey_anew(scene, drives[0].vehicle),
    }
    return in_changed_areas(scene, truth, drives[0].vehicle, maps)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="street570")
    parser.add_argument("--seeds", default="3,5,6,7,8")
    parser.add_argument("--cache", type=Path, default=cache_folder())
    parser.add_argument("--config", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/changed_areas.json"))
    arguments = parser.parse_args()
    settings = load_settings(arguments.config)
    results: dict[str, dict[str, PoseErrors]] = {}
    print("| seed | scans | " + " | ".join(f"{name}: median, 99 %, lost" for name in (OLD, UPDATED, ANEW)) + " |")
    print("|---|---|---|---|---|")
    for seed in map(int, arguments.seeds.split(",")):
        found = measure(Scene(arguments.scenario, seed, settings, arguments.cache), arguments.workers)
        results[str(seed)] = found
        cells = [
            f"{100 * e.median_m:.1f} cm, {100 * e.p99_m:.1f} cm, {e.scans - e.localised}"
            for e in (found[name] for name in (OLD, UPDATED, ANEW))
        ]
        print(f"| {seed} | {found[OLD].scans} | " + " | ".join(cells) + " |", flush=True)
        with whole_file(arguments.out) as partial:
            partial.write_text(to_json(results))
    worse = max(found[UPDATED].median_m - found[ANEW].median_m for found in results.values())
    print(f"updated map against one surveyed anew, median, worst seed: {100 * worse:+.1f} cm (must be +1.0 at most)")


if __name__ == "__main__":
    main()
