"""The paper's premise, "when the environment changes, the accuracy of self-localization will deteriorate", put to test.

    python benchmarks/premise.py --seeds 1,2,3 --csv results/premise.csv

On `half_gone`, where half of a block's facades go and little else stands, and on the same street with those facades
built instead. Each vehicle follows its drive in the old map and in the one updated by columns_v1, by NDT with voxels of
one size, as the paper has it: the next pose is guessed from the last two, there is no prior and no second opinion.
Beside it the product's own tracker, with its prior. Counted are scans within 30 m of a change. A scan is lost where its
pose is off by more than half a metre; the next one starts from the truth again.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mapvote.config import Settings, cache_folder
from mapvote.core.geometry import exp
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Drive
from mapvote.core.voxels import thin
from mapvote.localisation.map_window import window_points
from mapvote.localisation.ndt import Level, NdtMap, in_rows, refine
from mapvote.localisation.prepare import deskew, motion_at, twist_between
from mapvote_lab.evaluation.experiments.cases import COLUMNS_V1, choose_cases, fuse_case
from mapvote_lab.evaluation.experiments.changed_areas import localise_in, scans_near_changes
from mapvote_lab.evaluation.experiments.passes import passes
from mapvote_lab.evaluation.experiments.pose_errors import map_frame
from mapvote_lab.evaluation.experiments.scene import Scene
from mapvote_lab.evaluation.scoring.truth import pose_errors

SCENARIO = "half_gone"
LEVELS = {"NDT, .5 m": Level(0.5, 0.05, 0.5, 30), "NDT, 1 m": Level(1.0, 0.1, 0.5, 30)}
TRACKER = "own tracker, with prior"
LOST_M = 0.5
_BUILT = [{"side": side, "from_m": 38.0, "to_m": 112.0, "count": 5, "kind": "built"} for side in ("north", "south")]
STREETS: Mapping[str, Mapping[str, Any]] = {"gone": {}, "built": {"changes": _BUILT}}
"""What became of the facades, as overrides of the scenario."""
HEAD = ["street", "seed", "vehicle", "localised by", "map", "scans", "lost", "median, cm", "99 %, cm", "worst, cm"]


def by_plain_ndt(drive: Drive, T_true: F64, point_map: PointMap, level: Level) -> F64:
    """(n, 4, 4) every scan's pose by NDT with one size of voxels, each guess from the two poses before it.

    ``T_true`` (n, 4, 4), in the map's frame: where the drive begins, and begins anew after a lost scan.
    """
    out, before, twist = np.empty_like(T_true), T_true[0], motion_at(drive.stamps_ns, T_true, 0)
    ndt_map: NdtMap | None = None
    for i, scan in enumerate(drive):
        seconds = 1e-9 * float(drive.stamps_ns[i] - drive.stamps_ns[i - 1]) if i else 0.0
        guess = before @ exp(seconds * twist)
        if ndt_map is None or not ndt_map.is_central(guess[:3, 3]):
            ndt_map = NdtMap(guess[:3, 3], (level,))
            ndt_map.enter(window_points(point_map, guess[:3, 3]))
        points = deskew(scan, twist)
        out[i] = refine(ndt_map, [in_rows(points[thin(points, level.points_m)])], guess).T_map_lidar
        if np.linalg.norm(out[i, :3, 3] - T_true[i, :3, 3]) > LOST_M:
            before, twist = T_true[i], motion_at(drive.stamps_ns, T_true, i)
            continue
        if i:
            twist = twist_between(before, out[i], seconds)
        before = out[i]
    return out


def summary(T_found: F64, T_true: F64) -> list[str]:
    """Scans, how many of them lost, and the errors of all that were given a pose, in centimetres."""
    there = np.isfinite(T_found).all(axis=(1, 2))
    metres, _ = pose_errors(T_found[there], T_true[there])
    lost = int(np.count_nonzero(~there) + np.count_nonzero(metres > LOST_M))
    cm = 100.0 * metres
    return [str(len(T_found)), str(lost), *(f"{v:.1f}" for v in (np.median(cm), np.percentile(cm, 99), cm.max()))]


def measure(street: str, scene: Scene) -> Iterator[list[str]]:
    """A row for each vehicle, way of localising and map."""
    scene.prepare()
    cases, _ = choose_cases(scene.settings, COLUMNS_V1)
    drives = passes(scene, cases, 1)
    old, T_map_world = scene.point_map, map_frame(scene)
    window = scene.truth.grid_on(old.lattice)
    ballots = [drive.ballots[COLUMNS_V1] for drive in drives]
    updated = fuse_case(old, ballots, cases[0].min_votes, scene.settings.fuse, window).updated
    for name in scene.drive_names("v"):
        drive, T_true = scene.drive(name), T_map_world @ scene.true_poses(name)
        near = scans_near_changes(scene, scene.truth, name)
        for map_name, point_map in (("old", old), ("updated", updated)):
            first = [street, str(scene.seed), name]
            for way, level in LEVELS.items():
                found = by_plain_ndt(drive, T_true, point_map, level)[near]
                yield [*first, way, map_name, *summary(found, T_true[near])]
            found = localise_in(drive, near, point_map, scene)
            yield [*first, TRACKER, map_name, *summary(found, T_true[near])]


def pooled(rows: list[list[str]]) -> Iterator[list[str]]:
    """Over seeds and vehicles: scans and lost ones summed; the median of medians, and the worst of the others."""
    for street, way, name in dict.fromkeys((row[0], row[3], row[4]) for row in rows):
        mine = np.array(
            [[float(v) for v in row[5:]] for row in rows if (row[0], row[3], row[4]) == (street, way, name)]
        )
        scans, lost = mine[:, :2].sum(axis=0)
        cm = [np.median(mine[:, 2]), mine[:, 2].max(), mine[:, 3].max(), mine[:, 4].max()]
        yield [street, way, name, f"{scans:.0f}", f"{lost:.0f}", *(f"{v:.1f}" for v in cm)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1,2,3")
    parser.add_argument("--facades", default="gone,built", help="what became of them, by commas")
    parser.add_argument("--cache", type=Path, default=cache_folder())
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    streets = {name: STREETS[name] for name in options.facades.split(",")}
    rows = [
        row
        for street, overrides in streets.items()
        for seed in map(int, options.seeds.split(","))
        for row in measure(street, Scene(SCENARIO, seed, Settings(), options.cache, overrides))
    ]
    head = [
        "facades",
        "localised by",
        "map",
        "scans",
        "lost",
        "median of drives, cm",
        "worst median, cm",
        "worst 99 %, cm",
    ]
    for line in ([*head, "worst scan, cm"], ["---"] * (len(head) + 1), *pooled(rows)):
        print(f"| {' | '.join(line)} |")
    if options.csv is not None:
        with options.csv.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([HEAD, *rows])


if __name__ == "__main__":
    main()
