"""The paper's tables on `as_published`, over several seeds: what the paper prints, what comes out here, and why.

    python benchmarks/published.py --seeds 41,42,43,44,45 --folder out/published --csv results/as_published.csv

A seed whose JSON lies in the folder already is not driven again.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from statistics import fmean
from typing import Any

CASES = "1", "2", "3", "4", "5"
PAPER = {"1": 0.830, "2": 0.829, "3": 0.811, "4": 0.807, "5": 0.850}
TRUTHS = "strict", "provenance", "could be known"
SET, VOTES = "as set", "occluded votes"


def driven(seed: int, folder: Path, cars: int | None) -> dict[str, Any]:
    """The numbers of one seed, as ``mapvote evaluate`` writes them."""
    name = folder / (f"{seed}.json" if cars is None else f"{seed}_cars_{cars}.json")
    if not name.exists():
        words = ["evaluate", "as_published", "--seed", str(seed), "--case", ",".join(CASES), "--readings"]
        words += ["--explain", "1,5", "--json", str(name), "--out", str(folder / f"pictures_{seed}")]
        words += [] if cars is None else ["--cars", str(cars)]
        subprocess.run([sys.executable, "-m", "mapvote", *words], check=True)
    return dict(json.loads(name.read_text()))


def macro(run: dict[str, Any], case: str, truth: str, reading: str = SET) -> float:
    return float(run["readings"][reading][case][truth]["macro_f1"])


def table(head: list[str], rows: list[list[str]]) -> None:
    for row in (head, ["---"] * len(head), *rows):
        print(f"| {' | '.join(row)} |")
    print()


def mean_and_range(values: list[float]) -> str:
    return f"{fmean(values):.3f} ({min(values):.3f} to {max(values):.3f})"


def tables(runs: list[dict[str, Any]]) -> None:
    """Table IV beside the paper's, every reading, and the causes of what case 1 and 5 lose."""
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
    for case in ("1", "5"):
        causes(runs, case)


def causes(runs: list[dict[str, Any]], case: str) -> None:
    """Of all true and false cells of all seeds, how many go to each cause."""
    rows = []
    for kind in runs[0]["budgets"][case]["provenance"]:
        cells: dict[str, int] = defaultdict(int)
        for run in runs:
            for cause, counted in run["budgets"][case]["provenance"][kind].items():
                cells[cause] += counted["cells"]
        total = sum(cells.values())
        most = sorted((n, cause) for cause, n in cells.items() if n)[::-1]
        told = "; ".join(f"{cause} {100 * n / total:.1f} %" for n, cause in most)
        rows.append([kind.replace("_", " "), str(total), told])
    table([f"case {case}, provenance", "cells", "causes"], rows)


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="41,42,43,44,45")
    parser.add_argument(
        "--cars", type=int, help="cars parked for one pass only, a vehicle; the scenario's own otherwise"
    )
    parser.add_argument("--folder", type=Path, default=Path("out/published"), help="JSON and pictures of each seed")
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    runs = [driven(int(seed), options.folder, options.cars) for seed in options.seeds.split(",")]
    demands(runs)
    tables(runs)
    costs(runs)
    if options.csv is not None:
        with options.csv.open("w", newline="") as file:
            out = csv.writer(file, lineterminator="\n")
            out.writerow(["seed", "reading", "truth", "case", "macro_f1"])
            for run in runs:
                for reading, cases in run["readings"].items():
                    for case, truths in cases.items():
                        out.writerows(
                            [run["seed"], reading, t, case, f"{v['macro_f1']:.4f}"] for t, v in truths.items()
                        )


if __name__ == "__main__":
    main()
