"""The paper's Table IV on `as_published`, over several seeds: what the paper prints, and what comes out here.

    python benchmarks/published.py --seeds 41,42,43,44,45 --folder out/published --csv results/as_published.csv
    python benchmarks/published.py --seeds 41 --cars 0,8,12 --csv results/as_published_cars.csv    # two stages over one
    python benchmarks/published.py --seeds 41 --sensors vlp16,hdl32e,hdl64e                        # bytes and cost
    python benchmarks/published.py --without-strays                       # on the product's own map, as all else

A seed whose JSON lies in the folder already is not driven again. The JSON also holds bytes, times and causes.
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

from mapvote_lab.evaluation.scores import PAPER_F1
from mapvote_lab.simulation.scenario import load_scenario

CASES = "1", "2", "3", "4", "5"
SCENARIO = "as_published"
CARS, SENSOR = load_scenario(SCENARIO).temporary_cars, load_scenario(SCENARIO).sensor
"""The scenario's own: cars parked for one pass only, a vehicle, and the vehicles' LiDAR."""


def driven(seed: int, folder: Path, cars: int, sensor: str, drop_strays: bool) -> dict[str, Any]:
    """The numbers of one seed, as ``mapvote evaluate`` writes them."""
    other = [f"cars_{cars}"] * (cars != CARS) + [sensor] * (sensor != SENSOR) + ["without_strays"] * drop_strays
    file = folder / f"{'_'.join([str(seed), *other])}.json"
    if not file.exists():
        words = ["evaluate", SCENARIO, "--seed", str(seed), "--case", ",".join(CASES), "--readings"]
        words += ["--json", str(file), "--cars", str(cars), "--sensor", sensor]
        environment = {**os.environ, "MAPVOTE_MAPPING__DROP_STRAYS": str(drop_strays).lower()}
        subprocess.run([sys.executable, "-m", "mapvote", *words], check=True, env=environment)
    return dict(json.loads(file.read_text()))


def table(head: list[str], rows: list[list[str]]) -> None:
    for row in (head, ["---"] * len(head), *rows):
        print(f"| {' | '.join(row)} |")
    print(flush=True)


def show(runs: list[dict[str, Any]]) -> None:
    """Macro-F1 of every reading and truth, and bytes of a ballot, by case: mean and range over the seeds."""

    def spread(values: list[float], digits: int) -> str:
        return f"{fmean(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"

    rows = [["the paper, on its street", *(f"{PAPER_F1[case]:.3f}" for case in CASES)]]
    for reading, cases in runs[0]["readings"].items():
        for truth in cases[CASES[0]]:
            every = [[run["readings"][reading][c][truth]["macro_f1"] for run in runs] for c in CASES]
            rows.append([f"{reading}; {truth}", *(spread(each, 3) for each in every)])
    for what, key in (("votes, kB a vehicle", "state_bytes_per_vehicle"), ("whole ballot, kB", "bytes_per_vehicle")):
        sizes = [[n / 1000 for run in runs for n in run["cases"][case][key]] for case in CASES]
        rows.append([what, *(spread(size, 1) for size in sizes)])
    table(["mean (range)", *(f"case {case}" for case in CASES)], rows)
    rows = []
    for a, b in (("1", "2"), ("5", "1"), ("1", "3"), ("2", "4"), ("3", "4")):
        one, other = ([run["readings"]["as set"][c]["provenance"]["macro_f1"] for run in runs] for c in (a, b))
        ahead = [x - y for x, y in zip(one, other, strict=True)]
        rows.append([f"case {a} over case {b}", spread(ahead, 3), f"{sum(x > 0 for x in ahead)} of {len(runs)}"])
    table(["claim; provenance", "ahead by", "on seeds"], rows)


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
    seeds = [int(seed) for seed in options.seeds.split(",")]
    runs: dict[tuple[int, str], list[dict[str, Any]]] = {}
    for cars in map(int, options.cars.split(",")):
        for sensor in options.sensors.split(","):
            print(f"\n{cars} cars a pass, {sensor}\n")
            runs[cars, sensor] = [driven(s, options.folder, cars, sensor, options.without_strays) for s in seeds]
            show(runs[cars, sensor])
    if options.csv is not None:
        write_csv(options.csv, runs)


if __name__ == "__main__":
    main()
