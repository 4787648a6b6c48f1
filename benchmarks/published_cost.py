"""What the paper claims of bytes and cost, on a stretch of `as_published`, with LiDARs of 16, 32 and 64 beams.

    python benchmarks/published_cost.py --csv results/published_cost.csv

The paper: two-stage voting sends less than one-stage (IV); a 2D grid with votes costs less than the 3D voxels with
evidence of Kim et al. [15] (I). Bytes are means over three vehicles; milliseconds are CPU time a scan, median, of one
vehicle on one core, after moving objects are known: rays, votes and counting for the paper's case 5, and the same scans
entered into an evidence map of 3D voxels and into a nearest-neighbour comparison (evaluation/baselines/).
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from mapvote.config import Settings, cache_folder
from mapvote.core.sensors import SENSORS
from mapvote_lab.evaluation.baselines.run import yardsticks
from mapvote_lab.evaluation.experiments.cases import choose_cases
from mapvote_lab.evaluation.experiments.passes import passes
from mapvote_lab.evaluation.experiments.scene import Scene
from mapvote_lab.evaluation.experiments.study import as_paper

STRETCH: Mapping[str, Any] = {
    "length_m": 90.0,
    "temporary_cars": 2,
    "changes": [
        {"kind": "built", "side": "north", "from_m": 24.0, "to_m": 46.0},
        {"kind": "demolished", "side": "south", "from_m": 40.0, "to_m": 76.0, "count": 2},
    ],
}
HEAD = [
    "beams", "points a scan", "votes, kB: two-stage (case 1)", "one-stage (case 3)", "times as much",
    "whole ballot, kB: case 1", "case 3", "ms a scan: case 5", "evidence in 3D", "nearest neighbour",
    "MB of its grid: case 5", "evidence in 3D", "nearest neighbour",
]  # fmt: skip


def measure(sensor: str, seed: int, cache: Path) -> list[str]:
    """A row of the table."""
    settings = as_paper(Settings(), "as_published")
    scene = Scene("as_published", seed, settings, cache, {**STRETCH, "sensor": sensor})
    scene.prepare()
    cases, _ = choose_cases(settings, "1,3,5")
    drives = passes(scene, cases, 1)
    first = scene.drive(drives[0].vehicle)
    points = np.mean([len(first.read_scan(i).points) for i in range(0, len(first), 10)])
    votes, whole = {}, {}
    for case in ("1", "3"):
        ballots = [drive.ballots[case] for drive in drives]
        votes[case] = fmean(sum(len(t.states or t.tally or b"") for t in ballot.tiles) for ballot in ballots) / 1000
        whole[case] = fmean(drive.sizes[case] for drive in drives) / 1000
    measured, ours = yardsticks(scene, drives[:1], 1)
    costs = [ours, measured["evidence"].cost, measured["nearest"].cost]
    return [
        str(SENSORS[sensor].beams), f"{points:.0f}", f"{votes['1']:.2f}", f"{votes['3']:.1f}",
        f"{votes['3'] / votes['1']:.0f}", f"{whole['1']:.1f}", f"{whole['3']:.1f}",
        *(f"{cost['ms_per_scan']:.1f}" for cost in costs), *(f"{cost['memory_bytes'] / 1e6:.1f}" for cost in costs),
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sensors", default="vlp16,hdl32e,hdl64e")
    parser.add_argument("--cache", type=Path, default=cache_folder())
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    rows = [measure(sensor, options.seed, options.cache) for sensor in options.sensors.split(",")]
    for line in (HEAD, ["---"] * len(HEAD), *rows):
        print(f"| {' | '.join(line)} |")
    if options.csv is not None:
        with options.csv.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([HEAD, *rows])


if __name__ == "__main__":
    main()
