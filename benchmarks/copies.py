"""Ballots that are copies: how much honest drives differ, and what copies cost.

    python benchmarks/copies.py corner --seeds 2 4 21 --vehicles 7
    python benchmarks/copies.py corner --seeds 1 --vehicles 3 --alike      # as alike as honest vehicles can be

First, of every street: how many pairs of drives on a tile were judged, the smallest difference among them
(fusion/copies.py), and how many honest drives were taken for copies. ``--alike``: all in one lane at 20 km/h, without
traffic or cars that come and go. Then a row for k = 1, 2, 3 of 2k + 1 vehicles that send the first one's ballot, as it
is or moved by a cell, beside the same vehicles, all honest, and the k + 1 without them: macro F1 (strict and
provenance), false objects above 2 m2, and drives taken for copies on a tile. ``--judge 0`` does without the rule.
Drives, maps and ballots are cached.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mapvote.codec.ballot import Ballot, unpack_states
from mapvote.config import FuseSettings, Settings
from mapvote.fusion.copies import LEAST_MOVED, difference
from mapvote.fusion.offline import update_map
from mapvote_lab.evaluation.experiments.attacks import jitter, replay
from mapvote_lab.evaluation.experiments.cases import COLUMNS_V1, choose_cases, fuse_case
from mapvote_lab.evaluation.experiments.passes import have_voted, passes
from mapvote_lab.evaluation.experiments.scene import Scene
from mapvote_lab.evaluation.scoring.jury import Jury

ALIKE: dict[str, Any] = {
    "vehicle_lanes": ["east outer"],
    "speed_kmh": 20.0,
    "traffic": {"car_spacing_m": 0, "two_wheeler_spacing_m": 0, "pedestrian_spacing_m": 0},
    "clutter": {"visitor_share": 0},
}


def fleet(scene: Scene) -> list[Ballot]:
    """What every vehicle of a scene says, by columns_v1."""
    cases, _ = choose_cases(scene.settings, f"{COLUMNS_V1},{COLUMNS_V1} one-stage")
    if not have_voted(scene, cases):
        scene.prepare()
    ballots = [drive.ballots[COLUMNS_V1] for drive in passes(scene, cases, 1)]
    scene.drop_drives()
    return ballots


def differences(ballots: Sequence[Ballot]) -> list[float]:
    """Of every two drives on every tile that are judged, the difference, as a share of what three cells make."""
    planes = [{tile.tile: unpack_states(tile.states) for tile in b.tiles if tile.states is not None} for b in ballots]
    pairs = [
        difference(a[index], b[index]) for a, b in itertools.combinations(planes, 2) for index in sorted(a.keys() & b)
    ]
    return [differ / whole for differ, whole in pairs if whole >= LEAST_MOVED]


def attacked(scene: Scene, ballots: Sequence[Ballot], fuse: FuseSettings) -> None:
    """A row of the second table for every k and lie."""
    first_map = scene.point_map
    jury = Jury(first_map, scene.truth)
    for k in (1, 2, 3):
        honest = ballots[: 2 * k + 1]
        if len(honest) < 2 * k + 1:
            return
        told = {"all honest": honest}
        for name, lie in (("copied", replay), ("copied, moved by a cell", jitter)):
            told[name] = [*honest[:-k], *(lie(ballot, first_map, honest[0]) for ballot in honest[-k:])]
        told["left out"] = honest[:-k]
        for name, sent in told.items():
            min_votes = 2 if name == "left out" else k + 1
            outcome = fuse_case(first_map, sent, min_votes, fuse, jury.window)
            found = jury.of_update(outcome)
            false = sum(area > 2.0 for area in found.objects.false_m2)
            copies = sum(len(decision.copies) for decision in outcome.decisions.values())
            who = f"{scene.scenario} {scene.seed} | {k} of {2 * k + 1} {name}"
            macro = f"{found.strict.macro_f1:.3f} | {found.provenance.macro_f1:.3f}"
            print(f"| {who} | {macro} | {false} | {copies} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario")
    parser.add_argument("--seeds", type=int, nargs="+", default=[2, 4, 21])
    parser.add_argument("--vehicles", type=int, default=7)
    parser.add_argument("--alike", action="store_true")
    parser.add_argument("--judge", type=float, default=FuseSettings().min_difference, help="fuse.min_difference")
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "mapvote")
    options = parser.parse_args()
    fuse = FuseSettings(min_difference=options.judge)
    overrides = {"vehicles": options.vehicles} | (ALIKE if options.alike else {})
    for seed in options.seeds:
        scene = Scene(options.scenario, seed, Settings(), options.cache, overrides)
        ballots = fleet(scene)
        found = np.array(differences(ballots))
        decisions = update_map(scene.point_map, ballots, fuse)[1].values()
        copies = sum(len(decision.copies) for decision in decisions)
        least, low = found.min(), np.quantile(found, 0.05)
        print(f"{scene.scenario} {seed}: {len(found)} pairs, least {least:.3f}, 5 % below {low:.3f}, {copies} copies")
        attacked(scene, ballots, fuse)


if __name__ == "__main__":
    main()
