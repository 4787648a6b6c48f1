"""`mapvote diff` and `mapvote merge` on simulated streets, judged by the simulator's truth.

    python benchmarks/two_maps.py FOLDER --scenario street --seeds 401 402 --merge

Each seed: three surveys, then three vehicles after the street changed; no parked car comes or goes. Maps are built of
all surveys (before), of all vehicles (after) and of each survey alone. Files that FOLDER holds already are taken from
there.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from mapvote.compare.cloud_changes import CloudChange, compare_cells, differences
from mapvote.compare.merge import merge_maps
from mapvote.compare.register import brought_into
from mapvote.config import Settings, choose_case
from mapvote.core.point_map import PointMap, all_points
from mapvote.formats import open_drive, read_map, write_map
from mapvote.fusion.fuse import states_over, update_map
from mapvote.survey.build import build_map
from mapvote.vehicle import vote_drive
from mapvote_lab.evaluation.scores import score_cells
from mapvote_lab.evaluation.truths import Truth, lay_on, read_truth
from mapvote_lab.simulation import simulate

_SCENE = {
    "clutter": {"visitor_share": 0.0},
    "surveys": ["east inner", "west inner", "east outer"],
    "vehicle_lanes": ["east outer", "east inner", "west inner"],
}
_BESIDE_M = 0.9
FALSE_M2 = 2.0


def map_of(folder: Path, name: str, drives: list[str]) -> PointMap:
    """The map of some drives, from ``folder``/``name`` or built there."""
    if not (folder / name).exists():
        built, _ = build_map([open_drive(folder / "drives" / drive) for drive in drives], Settings())
        write_map(built, folder / name)
    return read_map(folder / name)


def changes(map_a: PointMap, map_b: PointMap) -> list[CloudChange]:
    moved, registered = brought_into(map_a, map_b)
    return [one for one in differences(compare_cells(map_a, moved, registered)) if one.kind != "not seen"]


def is_of(one: CloudChange, thing: dict[str, object]) -> bool:
    """Whether a change touches the footprint of a true one of its kind."""
    corners = np.array(thing["footprint"])
    (x0, y0), (x1, y1) = corners.min(axis=0) - _BESIDE_M, corners.max(axis=0) + _BESIDE_M
    kind = "new" if thing["kind"] == "built" else "gone"
    return one.kind == kind and one.box[0] < x1 and one.box[2] > x0 and one.box[1] < y1 and one.box[3] > y0


def false_areas(found: list[CloudChange], truth: Truth, things: tuple[dict[str, object], ...]) -> str:
    """Areas of the changes that touch no thing, in the scored window and outside."""
    rows, cols = truth.strict.shape
    areas: dict[bool, list[str]] = {True: [], False: []}
    for one in found:
        if one.area_m2 > FALSE_M2 and not any(is_of(one, thing) for thing in things):
            x, y = 0.5 * (one.box[0] + one.box[2]), 0.5 * (one.box[1] + one.box[3])
            inside = truth.x0 < x < truth.x0 + 0.3 * cols and truth.y0 < y < truth.y0 + 0.3 * rows
            areas[inside].append(f"{one.area_m2:.1f}")
    return f"false > {FALSE_M2:g} m2 in the window {areas[True]}, outside {areas[False]}"


def votes_score(point_map: PointMap, drives: list[Path], truth: Truth) -> float:
    """Macro-F1 of what the vehicles publish on a map."""
    settings = choose_case(Settings(), "surfaces")
    _, decisions = update_map(
        point_map, [vote_drive(open_drive(d), point_map, settings)[0] for d in drives], settings.fuse
    )
    states = lay_on(*states_over(point_map.lattice, decisions), truth.grid_on(point_map.lattice))
    return score_cells(states, truth.strict).macro_f1


def judge_merge(folder: Path, surveys: list[str], vehicles: list[str], truth: Truth) -> None:
    """Surveys built apart and merged, against the map that was built of all."""
    together = map_of(folder, "before", surveys)
    merged = merge_maps([map_of(folder, name, [name]) for name in surveys]).point_map
    tree, points = KDTree(all_points(together)), all_points(merged)
    off = tree.query(points)[0]
    near = tree.data[tree.query(points[::10], k=8)[1]]
    middle = near.mean(axis=1)
    spread = near - middle[:, None]
    width, axes = np.linalg.eigh(np.einsum("nij,nik->njk", spread, spread))
    flat = width[:, 0] < 0.02 * width[:, 1]
    plane = np.abs(np.einsum("ij,ij->i", points[::10] - middle, axes[:, :, 0]))[flat]
    drives = [folder / "drives" / name for name in vehicles]
    print(
        f"  merged: points off {np.median(off):.3f} m (median), surfaces {np.median(plane):.3f} m (median), "
        f"{np.quantile(plane, 0.9):.3f} m (90 %); macro-F1 {votes_score(merged, drives, truth):.3f} instead of "
        f"{votes_score(together, drives, truth):.3f}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenario", default="street")
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--merge", action="store_true", help="also merge the surveys, and vote on both maps")
    options = parser.parse_args()
    for seed in options.seeds:
        folder = options.folder / f"{options.scenario}-{seed}"
        if not (folder / "drives").exists():
            folder.mkdir(parents=True, exist_ok=True)
            simulate(options.scenario, folder / "drives", seed, overrides=_SCENE)
        names = sorted(path.name for path in (folder / "drives").iterdir() if path.name != "truth")
        surveys = [name for name in names if name.startswith("survey")]
        vehicles = [name for name in names if not name.startswith("survey")]
        truth = read_truth(folder / "drives")
        before, after = map_of(folder, "before", surveys), map_of(folder, "after", vehicles)
        found = changes(before, after)
        hit = sum(any(is_of(one, thing) for one in found) for thing in truth.objects)
        print(f"{folder.name}: found {hit} of {len(truth.objects)}; {false_areas(found, truth, truth.objects)}")
        found = changes(*(map_of(folder, name, [name]) for name in surveys[:2]))
        print(f"  two surveys of one world: {false_areas(found, truth, ())}", flush=True)
        if options.merge:
            judge_merge(folder, surveys, vehicles, truth)


if __name__ == "__main__":
    main()
