"""The paper's tables on `as_published`, over several seeds: what the paper prints, what comes out here, and why.

    python benchmarks/published.py --seeds 41,42,43,44,45 --folder out/published --csv results/as_published.csv
    python benchmarks/published.py --seeds 41 --cars 0,8,12 --csv results/as_published_cars.csv    # two stages over one
    python benchmarks/published.py --seeds 41 --sensors vlp16,hdl32e,hdl64e                        # bytes and cost
    python benchmarks/published.py --without-strays                       # on the product's own map, as all else

A seed whose JSON lies in the folder already is not driven again.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
from pathlib import Path
from statistics import fmean
from typing import Any

from mapvote.core.sensors import SENSORS
from mapvote_lab.simulation.scenario import load_scenario

CASES = "1", "2", "3", "4", "5"
PAPER = {"1": 0.830, "2": 0.829, "3": 0.811, "4": 0.807, "5": 0.850}
TRUTHS = "strict", "provenance", "could be known"
SET, VOTES = "as set", "occluded votes"


SCENARIO = "as_published"
CARS, SENSOR = load_scenario(SCENARIO).temporary_cars, load_scenario(SCENARIO).sensor
"""The scenario's own: cars parked for one pass only, a vehicle, and the vehicles' LiDAR."""


def driven(seed: int, folder: Path, cars: int, sensor: str, drop_strays: bool) -> dict[str, Any]:
    """The numbers of one seed, as ``mapvote evaluate`` writes them."""
    other = [f"cars_{cars}"] * (cars != CARS) + [sensor] * (sensor != SENSOR) + ["without_strays"] * drop_strays
    name = "_".join([str(seed), *other])
    file = folder / f"{name}.json"
    if not file.exists():
        words = ["evaluate", SCENARIO, "--seed", str(seed), "--case", ",".join(CASES), "--readings"]
        words += ["--json", str(file)]
        words += ["--cars", str(cars), "--sensor", sensor]
        environment = {**os.environ, "MAPVOTE_MAPPING__DROP_STRAYS": str(drop_strays).lower()}
        subprocess.run([sys.executable, "-m", "mapvote", *words], check=True, env=environment)
    return dict(json.loads(file.read_text()))


def macro(run: dict[str, Any], case: str, truth: str, reading: str = SET) -> float:
    return float(run["readings"][reading][case][truth]["macro_f1"])


def table(head: list[str], rows: list[list[str]]) -> None:
    for row in (head, ["---"] * len(head), *rows):
        print(f"| {' | '.join(row)} |")
    print()


def mean_and_range(values: list[float]) -> str:
    return f"{fmean(values):.3f} ({min(values):.3f} to {max(values):.3f})"


def tables(runs: list[dict[str, Any]]) -> None:
    """Table IV beside the paper's, and every reading."""
    rows = [["the paper, on its street", *(f"{PAPER[case]:.3f}" for case in CASES)]]
    for reading in (SET, VOTES):
        for truth in TRUTHS:
            values = [mean_and_range([macro(run, case, truth, reading) for run in runs]) for case in CASES]
            rows.append([f"{reading}; {truth}", *values])
    table(["macro-F1, mean (range)", *(f"case {case}" for case in CASES)], rows)
    names = list(runs[0]["readings"])
    rows = [
        [name, *(f"{fmean(macro(r, case, 'provenance', name) for r in runs):.3f}" for case in CASES)] for name in names
    ]
    table(["reading; provenance, mean", *(f"case {case}" for case in CASES)], rows)


def demands(runs: list[dict[str, Any]]) -> None:
    """What the paper's Table IV says, held against the mean over the seeds."""
    mean = {case: fmean(macro(run, case, "provenance") for run in runs) for case in CASES}
    rows = [[f"case {case} within .05 of the paper", f"{mean[case] - PAPER[case]:+.3f}"] for case in CASES]
    for a, b, least in (("1", "2", 0.0), ("5", "1", 0.0), ("1", "3", 0.01)):
        ahead = sum(macro(run, a, "provenance") > macro(run, b, "provenance") for run in runs)
        said = f"case {a} over case {b}" + (f" by {least}" if least else "")
        rows.append([said, f"{mean[a] - mean[b]:+.3f}; ahead on {ahead} of {len(runs)} seeds"])
    table(["demand", "measured"], rows)


def costs(runs: list[dict[str, Any]]) -> None:
    """Bytes of a vehicle's ballot, votes alone and all of it, and seconds of a seed."""
    rows = []
    for case in CASES:
        sizes = [
            [fmean(run["cases"][case][key]) / 1000 for run in runs]
            for key in ("state_bytes_per_vehicle", "bytes_per_vehicle")
        ]
        rows.append([f"case {case}", *(f"{fmean(size):.1f}" for size in sizes)])
    table(["", "votes, kB a vehicle", "whole ballot, kB"], rows)
    rows = [
        [str(run["seed"]), *(f"{run['timings'][key]:.0f}" for key in ("prepare_s", "vote_s", "score_s"))]
        for run in runs
    ]
    table(["seed", "simulate and map, s", "vote, s", "score, readings, causes, s"], rows)


def by_cars(runs: dict[int, list[dict[str, Any]]]) -> None:
    """What two stages gain over one, and many votes a scan over one, by the cars that park for one pass only."""
    rows = []
    for cars, some in runs.items():
        gains = []
        for a, b in (("1", "3"), ("2", "4"), ("1", "2"), ("3", "4")):
            each = [macro(run, a, "provenance") - macro(run, b, "provenance") for run in some]
            gains.append(f"{fmean(each):+.3f} ({min(each):+.3f} to {max(each):+.3f})")
        means = [f"{fmean(macro(run, case, 'provenance') for run in some):.3f}" for case in CASES]
        rows.append([str(cars), str(len(some)), *means, *gains])
    table(["cars a pass", "seeds", *(f"case {case}" for case in CASES), "1 - 3", "2 - 4", "1 - 2", "3 - 4"], rows)


def by_sensor(runs: dict[str, list[dict[str, Any]]]) -> None:
    """Bytes of a vehicle's votes and ballot, and milliseconds a scan, by the LiDAR."""
    rows = []
    for sensor, some in runs.items():
        row = [str(SENSORS[sensor].beams)]
        for key in ("state_bytes_per_vehicle", "bytes_per_vehicle"):
            for case in ("1", "3", "5"):
                row.append(f"{fmean(n for run in some for n in run['cases'][case][key]) / 1000:.1f}")
        stages = [stage for run in some for stage in run["timings"]["stages_ms"].values()]
        row += [f"{fmean(stage[name] for stage in stages):.1f}" for name in ("localise", "moving", "see")]
        row += [f"{fmean(macro(run, case, 'provenance') for run in some):.3f}" for case in ("1", "3", "5")]
        rows.append(row)
    three = [f"case {case}" for case in ("1", "3", "5")]
    head = ["beams", *(f"votes, kB, {c}" for c in three), *(f"ballot, kB, {c}" for c in three)]
    table([*head, "localise, ms a scan", "movers, ms", "see, ms", *(f"macro-F1, {c}" for c in three)], rows)


def write_csv(file: Path, runs: dict[tuple[int, str], list[dict[str, Any]]]) -> None:
    """Every macro-F1, a line each."""
    with file.open("w", newline="") as opened:
        out = csv.writer(opened, lineterminator="\n")
        out.writerow(["seed", "cars", "sensor", "strays", "reading", "truth", "case", "macro_f1"])
        for (cars, sensor), some in runs.items():
            for run in some:
                strays = "dropped" if run["settings"]["mapping"].get("drop_strays", True) else "kept"
                for reading, cases in run["readings"].items():
                    for case, truths in cases.items():
                        first = [run["seed"], cars, sensor, strays, reading]
                        out.writerows([*first, t, case, f"{v['macro_f1']:.4f}"] for t, v in truths.items())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="41,42,43,44,45")
    parser.add_argument("--cars", default=str(CARS), help="cars parked for one pass only, a vehicle, by commas")
    parser.add_argument("--sensors", default=SENSOR, help="the vehicles' LiDARs, by commas")
    parser.add_argument("--without-strays", action="store_true", help="on a map that leaves out what is no surface")
    parser.add_argument("--folder", type=Path, default=Path("out/published"), help="JSON and pictures of each seed")
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    cars, sensors = [int(n) for n in options.cars.split(",")], options.sensors.split(",")
    seeds = [int(seed) for seed in options.seeds.split(",")]
    drop = options.without_strays
    runs = {(n, s): [driven(seed, options.folder, n, s, drop) for seed in seeds] for n in cars for s in sensors}
    for (n, sensor), some in runs.items():
        print(f"\n{n} cars a pass, {sensor}\n")
        demands(some)
        tables(some)
        costs(some)
    by_cars({n: runs[n, sensors[0]] for n in cars})
    by_sensor({sensor: runs[cars[0], sensor] for sensor in sensors})
    if options.csv is not None:
        write_csv(options.csv, runs)


if __name__ == "__main__":
    main()
