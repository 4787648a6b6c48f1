"""Maps larger than memory: the largest memory and the time of each verb on a synthetic town.

    python benchmarks/large_map.py --points 10 30 100 --out results/large_maps.csv

Writes a town of so many million points as LAZ, block by block, and runs the verbs on it as a user would. Memory is that
of the verb's processes together, sampled ten times a second; pages of files that the system may drop are in it.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import laspy
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from mapvote.formats.atomic import whole_file
from page import BLOCK_M, STREET_M, _block

VERBS = {
    "import": ["import", "{laz}", "{map}"],
    "info": ["info", "{map}"],
    "doctor": ["doctor", "{map}"],
    "export LAZ": ["export", "{map}", "{folder}/out.laz"],
    "export PCD": ["export", "{map}", "{folder}/out.pcd"],
    "export PLY": ["export", "{map}", "{folder}/out.ply"],
    "export Autoware": ["export", "{map}", "{folder}/out"],
    "import PCD": ["import", "{folder}/out.pcd", "{folder}/pcd_map"],
    "import PLY": ["import", "{folder}/out.ply", "{folder}/ply_map"],
    "import Autoware": ["import", "{folder}/out", "{folder}/autoware_map"],
}


def write_town(file: Path, millions: float) -> int:
    """How many points were written: streets and blocks of houses in a square, with intensity, as one LAZ file."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 0.001)
    random, written, block = np.random.default_rng(0), 0, 0
    wide = max(round(np.sqrt(millions * 1e6 / 150_000)), 1)
    with laspy.open(file, mode="w", header=header) as stream:
        while written < millions * 1e6:
            row, col = divmod(block, wide)
            points = np.concatenate(list(_block(random))) + np.array([col, row, 0.0]) * (BLOCK_M + STREET_M)
            record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
            record.x, record.y, record.z = points.T
            record.intensity = random.integers(0, 65536, len(points))
            stream.write_points(record)
            written, block = written + len(points), block + 1
    return written


def memory_mb(process: int) -> float:
    """Of a process and all that it started (PSS)."""
    total, waiting = 0, [process]
    while waiting:
        one = waiting.pop()
        try:
            lines = Path(f"/proc/{one}/smaps_rollup").read_text().splitlines()
            total += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
            waiting += [int(child) for child in Path(f"/proc/{one}/task/{one}/children").read_text().split()]
        except (OSError, StopIteration):
            continue
    return total / 1024


def measured(verb: list[str]) -> tuple[float, float, float, int]:
    """(largest memory in MB, seconds of CPU, seconds on the clock, exit code) of ``mapvote verb``."""
    began, most = time.monotonic(), 0.0
    child = subprocess.Popen([sys.executable, "-m", "mapvote", *verb], stdout=subprocess.DEVNULL)
    while True:
        ended, status, used = os.wait4(child.pid, os.WNOHANG)
        if ended:
            break
        most = max(most, memory_mb(child.pid))
        time.sleep(0.1)
    child.returncode = os.waitstatus_to_exitcode(status)
    return most, used.ru_utime + used.ru_stime, time.monotonic() - began, child.returncode


def main() -> None:
    """Parse and run."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--points", type=float, nargs="+", default=[10.0], metavar="MILLION")
    asked.add_argument("--verbs", default="import,info", help=f"in this order; of {', '.join(VERBS)}")
    asked.add_argument("--out", type=Path, help="CSV; rows of the same size and verb replace older ones")
    asked.add_argument("--scratch", type=Path, help="where there is room: 60 bytes a point")
    options = asked.parse_args()
    for millions in options.points:
        with tempfile.TemporaryDirectory(dir=options.scratch) as name:
            folder = Path(name)
            places = {"laz": folder / "town.laz", "map": folder / "map", "folder": folder}
            n = write_town(places["laz"], millions)
            for verb in options.verbs.split(","):
                memory, cpu_s, clock_s, code = measured([part.format(**places) for part in VERBS[verb]])
                row = {"million_points": f"{n / 1e6:.1f}", "verb": verb, "memory_mb": f"{memory:.0f}"}
                row |= {"cpu_s": f"{cpu_s:.0f}", "clock_s": f"{clock_s:.0f}", "exit": str(code)}
                print(row, flush=True)
                if options.out:
                    write(options.out, row, ("million_points", "verb"))


def write(file: Path, row: dict, key: tuple[str, ...]) -> None:
    """One more row; an older one of the same ``key`` goes."""
    old = []
    if file.exists():
        with file.open(newline="") as stream:
            old = list(csv.DictReader(stream))
    with whole_file(file) as partial, partial.open("w", newline="") as stream:
        table = csv.DictWriter(stream, fieldnames=list(row))
        table.writeheader()
        table.writerows([*(r for r in old if any(r[name] != row[name] for name in key)), row])


if __name__ == "__main__":
    main()
