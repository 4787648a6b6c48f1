"""Voxels that fall with a demolished object (fusion/gravity.py): simulated streets decided with gravity and without.

    python benchmarks/gravity.py --seeds 301 302 303 304 305            # street570: some ten minutes a seed
    python benchmarks/gravity.py --scenario overhead --seeds 311 312    # wires, signs, bridges and crowns
    python benchmarks/gravity.py --seeds 303 --picture gravity.png      # the house of which most hung in the air

A seed is simulated, surveyed and voted on once; ballots are kept in the cache. The same ballots are then fused twice,
without gravity (no group is short enough to fall) and with it. Each line is a seed. Then follow the means, in brackets
the worst, and what was left of every demolished object. Last comes what hangs over the street, by kind.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean

import numpy as np
from scipy.spatial import cKDTree

from mapvote.config import Settings, cache_folder
from mapvote.core.types import Bool
from mapvote.fusion.gravity import GRAVITY, Gravity
from mapvote_lab.evaluation.cases import Case, fuse_case, rule_cases
from mapvote_lab.evaluation.scene import Scene, passes
from mapvote_lab.evaluation.scores import CaseResult, map_obstacles, same_rows
from mapvote_lab.evaluation.truths import CaseOutcome, Jury
from mapvote_lab.simulation.scenario import load_scenario
from mapvote_lab.simulation.shapes import sample
from mapvote_lab.simulation.world import Role, make_world

WITHOUT = Gravity(longest_cells=0)
KINDS = {"without": WITHOUT, "with": GRAVITY}
OVERHEAD = "wire", "board", "bridge", "crown", "gantry", "sign", "tree", "pole"
"""Bodies that hang in the air, or carry what does."""
ON_M = 0.15
"""A point of the map this near to a surface lies on it, metres."""


@dataclass(frozen=True)
class Street:
    """One seed, decided in both ways."""

    seed: int
    scene: Scene
    jury: Jury
    outcomes: dict[str, CaseOutcome]
    results: dict[str, CaseResult]
    ceiling: float
    """Strict macro-F1 of perfect labels."""


def decided(scene: Scene, case: Case) -> Street:
    """The street of a scene."""
    scene.prepare()
    ballots = [drive.ballots[case.name] for drive in passes(scene, [case], workers=2)]
    jury = Jury(scene.point_map, scene.truth)
    outcomes = {
        name: fuse_case(scene.point_map, ballots, case.min_votes, scene.settings.fuse, jury.window, gravity)
        for name, gravity in KINDS.items()
    }
    results = {name: jury.of_update(outcome) for name, outcome in outcomes.items()}
    return Street(scene.seed, scene, jury, outcomes, results, jury.ceilings()["strict"].macro_f1)


# Tables ---------------------------------------------------------------------------------------------------------------

MEASURES: dict[str, Callable[[CaseResult], float]] = {
    "stale deleted, %": lambda one: 100.0 * (one.map.stale_deleted if one.map else 0.0),
    "changed-empty F1": lambda one: one.strict.f1.changed_empty,
    "provenance": lambda one: one.provenance.macro_f1,
    "strict": lambda one: one.strict.macro_f1,
}
"""Higher is better."""


def points_left(result: CaseResult) -> int:
    assert result.map is not None
    return round((1.0 - result.map.stale_deleted) * result.map.stale_points)


def valid_lost(result: CaseResult) -> int:
    assert result.map is not None
    return round(result.map.valid_deleted * result.map.valid_points)


def table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
    print("\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *lines)), "\n", flush=True)


def pair(street: Street, told: Callable[[CaseResult], str]) -> str:
    """Without gravity, then with it."""
    return ", ".join(told(street.results[name]) for name in KINDS)


def show(streets: Sequence[Street]) -> None:
    """The table of the seeds, their means, and the demolished objects."""
    head = ["seed: without, with", "stale deleted, %", "points left", "changed-empty F1", "provenance"]
    head += ["valid deleted", "visible rests", "strict", "its ceiling"]
    lines = []
    for street in streets:
        objects = len(street.results["with"].rests.left) if street.results["with"].rests else 0
        lines.append(
            [
                str(street.seed),
                pair(street, lambda one: f"{MEASURES['stale deleted, %'](one):.2f}"),
                pair(street, lambda one: str(points_left(one))),
                pair(street, lambda one: f"{MEASURES['changed-empty F1'](one):.3f}"),
                pair(street, lambda one: f"{MEASURES['provenance'](one):.3f}"),
                pair(street, lambda one: str(valid_lost(one))),
                pair(street, lambda one: str(one.rests.visible if one.rests else 0)) + f" of {objects}",
                pair(street, lambda one: f"{MEASURES['strict'](one):.3f}"),
                f"{street.ceiling:.3f}",
            ]
        )
    table(head, lines)
    rows = []
    for name in KINDS:
        results = [street.results[name] for street in streets]
        spread = [f"{fmean(map(of, results)):.3f} ({min(map(of, results)):.3f})" for of in MEASURES.values()]
        shares = [100.0 * share for one in results if one.rests for share in one.rests.left]
        left = f"{fmean(shares):.2f} ({max(shares):.2f})" if shares else "none"
        visible = sum(one.rests.visible for one in results if one.rests)
        valid = sum(one.map.valid_points for one in results if one.map)
        lost = 100.0 * sum(map(valid_lost, results)) / max(valid, 1)
        rows.append([name, left, f"{visible} of {len(shares)}", f"{lost:.4f}", *spread])
    shown = ["mean (worst)", "points left of a demolished object, %", "visible rests", "valid deleted, %", *MEASURES]
    table(shown, rows)


# What hangs over the street -------------------------------------------------------------------------------------------


def on_kept_bodies(street: Street) -> dict[str, Bool]:
    """Which obstacle points (n,) of the first map lie on what hangs, by kind. A point that is nearer to another surface
    does not."""
    scene = street.scene
    world = make_world(load_scenario(scene.scenario, scene.overrides), scene.seed)
    samples, kinds = [], []
    for body in world.bodies[1:]:
        points = sample(body.triangles, 0.1, np.random.default_rng(0))
        samples.append(points)
        kinds += [body.kind if body.role == Role.KEPT else ""] * len(points)
    old = map_obstacles(scene.point_map)
    distance, nearest = cKDTree(np.concatenate(samples)).query(old, distance_upper_bound=ON_M)
    named = np.array([*kinds, ""])[nearest]
    return {kind: (named == kind) & (distance < np.inf) for kind in OVERHEAD}


def show_overhead(streets: Sequence[Street]) -> None:
    """How many points of each kind the maps held, and how many of them went."""
    held = dict.fromkeys(OVERHEAD, 0)
    lost = {name: dict.fromkeys(OVERHEAD, 0) for name in KINDS}
    for street in streets:
        old = map_obstacles(street.scene.point_map)
        gone = {name: ~same_rows(old, map_obstacles(street.outcomes[name].updated))[0] for name in KINDS}
        for kind, on in on_kept_bodies(street).items():
            held[kind] += int(on.sum())
            for name in KINDS:
                lost[name][kind] += int((on & gone[name]).sum())
    rows = [[kind, str(held[kind]), *(str(lost[name][kind]) for name in KINDS)] for kind in OVERHEAD if held[kind]]
    table(["what stands", "points in the maps", *(f"deleted {name} gravity" for name in KINDS)], rows)


# The picture ----------------------------------------------------------------------------------------------------------


def draw(streets: Sequence[Street], file: Path) -> None:
    """Seen from the road: the demolished object of which most hung in the air, before and after."""
    from matplotlib.figure import Figure

    # The object of which gravity deletes the most points.
    best: tuple[int, Street, Bool] | None = None
    for street in streets:
        old = map_obstacles(street.scene.point_map)
        stays = {name: same_rows(old, map_obstacles(street.outcomes[name].updated))[0] for name in KINDS}
        fell = street.jury.points.stale & stays["without"] & ~stays["with"]
        for one in street.scene.truth.objects:
            inside = street.scene.truth.grid.value_at(street.scene.truth.cells_of(one["footprint"]), old)
            count = int((fell & inside).sum())
            if one["kind"] == "demolished" and (best is None or count > best[0]):
                best = count, street, inside
    assert best is not None, "no object was demolished"
    # Its points in the three maps, and what stands beside it.
    _, street, inside = best
    old = map_obstacles(street.scene.point_map)
    low, high = old[inside].min(axis=0) - 4.0, old[inside].max(axis=0) + 4.0
    stale = street.jury.points.stale & inside
    maps = {"the map of the survey": street.scene.point_map} | {
        f"updated, {name} gravity": street.outcomes[name].updated for name in KINDS
    }
    figure = Figure(figsize=(11.0, 3.4), layout="constrained")
    for place, (title, point_map) in zip(figure.subplots(1, 3, sharey=True), maps.items(), strict=True):
        held, fresh = same_rows(old, map_obstacles(point_map))
        beside = np.concatenate([old[held & ~stale], fresh])  # noise on no surface too
        near = ((beside[:, :2] >= low[:2]) & (beside[:, :2] <= high[:2])).all(axis=1)
        for points, colour, label in (
            (beside[near], "#8a97a3", "others"),
            (old[held & stale], "#c0392b", "of the demolished house"),
        ):
            place.plot(points[:, 0], points[:, 2], ".", markersize=1.5, color=colour, label=label)
        place.set_title(f"{title}: {np.count_nonzero(held & stale)} points", fontsize=9)
        place.set_xlabel("along the street, m")
        place.set_aspect("equal")
    figure.axes[0].set_ylabel("height, m")
    figure.axes[0].legend(fontsize=8, markerscale=5, loc="upper left")
    figure.savefig(file, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="street570")
    parser.add_argument("--seeds", type=int, nargs="+", default=[301, 302, 303, 304, 305])
    parser.add_argument("--cache", type=Path, help="folder of the simulated streets; default: that of evaluate")
    parser.add_argument("--picture", type=Path, help="draw the object of which gravity deletes most")
    asked = parser.parse_args()
    settings = Settings()
    case = rule_cases(settings)["surfaces"]
    new_scene = partial(Scene, asked.scenario, settings=settings, cache=asked.cache or cache_folder())
    streets = []
    for seed in asked.seeds:
        streets.append(decided(new_scene(seed=seed), case))
        print(f"seed {seed} done", flush=True)
    show(streets)
    show_overhead(streets)
    if asked.picture is not None:
        draw(streets, asked.picture)


if __name__ == "__main__":
    main()
