"""The paper's Table IV on `as_published`, over several seeds: what the paper prints, and what comes out here.

    python benchmarks/published.py --seeds 41,42,43,44,45 --folder out/published
    python benchmarks/published.py --without-strays                       # on the product's own map, as all else

A seed whose JSON lies in the folder already is not driven again. The JSON also holds bytes, times and causes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from statistics import fmean
from typing import Any

from mapvote_lab.evaluation.scores import PAPER_F1

CASES = "1", "2", "3", "4", "5"


def driven(seed: str, folder: Path, drop_strays: bool) -> dict[str, Any]:
    """The numbers of one seed, as ``mapvote evaluate`` writes them."""
    file = folder / f"{seed}{'_without_strays' * drop_strays}.json"
    if not file.exists():
        words = ["evaluate", "as_published", "--seed", seed, "--case", ",".join(CASES), "--readings", "--json", file]
        environment = {**os.environ, "MAPVOTE_MAPPING__DROP_STRAYS": str(drop_strays).lower()}
        subprocess.run([sys.executable, "-m", "mapvote", *map(str, words)], check=True, env=environment)
    return dict(json.loads(file.read_text()))


def spread(values: list[float], digits: int = 3) -> str:
    return f"{fmean(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="41,42,43,44,45")
    parser.add_argument("--without-strays", action="store_true", help="on a map that leaves out what is no surface")
    parser.add_argument("--folder", type=Path, default=Path("out/published"), help="JSON of each seed")
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    runs = [driven(seed, asked.folder, asked.without_strays) for seed in asked.seeds.split(",")]
    rows = [["the paper, on its street", *(f"{PAPER_F1[case]:.3f}" for case in CASES)]]
    for reading, cases in runs[0]["readings"].items():
        for truth in cases["1"]:
            every = [[run["readings"][reading][c][truth]["macro_f1"] for run in runs] for c in CASES]
            rows.append([f"{reading}; {truth}", *map(spread, every)])
    for what, key in (("votes, kB a vehicle", "state_bytes_per_vehicle"), ("whole ballot, kB", "bytes_per_vehicle")):
        sizes = [[n / 1000 for run in runs for n in run["cases"][case][key]] for case in CASES]
        rows.append([what, *(spread(size, 1) for size in sizes)])
    claims = []
    for a, b in (("1", "2"), ("5", "1"), ("1", "3"), ("2", "4"), ("3", "4")):
        one, other = ([run["readings"]["as set"][c]["provenance"]["macro_f1"] for run in runs] for c in (a, b))
        ahead = [x - y for x, y in zip(one, other, strict=True)]
        claims.append([f"case {a} over case {b}", spread(ahead), f"{sum(x > 0 for x in ahead)} of {len(runs)}"])
    heads = ["mean (range)", *(f"case {case}" for case in CASES)], ["claim; provenance", "ahead by", "on seeds"]
    for head, lines in zip(heads, (rows, claims), strict=True):
        print("\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *lines)), "\n")


if __name__ == "__main__":
    main()
