"""Maps larger than memory: the largest memory and the time of each verb on a synthetic town.

    python benchmarks/large_map.py --points 10 30 100 --out results/large_maps.csv

Writes a town of so many million points as LAZ, block by block, and runs the verbs on it as a user would. Memory is that
of the verb's processes together, sampled ten times a second; pages of files that the system may drop are in it.

With `--drive DRIVE --street MAP` the map of a (simulated) street is part of the town, at its edge, and a drive through
it votes. "serve" takes the map into a store and goes on serving it: verbs of a URL ask that server, and what it takes
meanwhile is a row of its own.
"""

from __future__ import annotations

import argparse
import csv
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import laspy
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from mapvote.core.point_map import all_points
from mapvote.formats import read_map
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
    "vote": ["vote", "{drive}", "--map", "{map}", "--out", "{folder}/ballot"],
    "serve": ["serve", "{store}", "--map", "{map}", "--port", "0", "--open"],
    "export STORE LAZ": ["export", "{store}", "{folder}/store.laz"],
    "export STORE Autoware": ["export", "{store}", "{folder}/store_out"],
    "doctor STORE": ["doctor", "{store}"],
    "follow URL": ["follow", "{url}", "{folder}/followed", "--autoware", "--once"],
    "export URL LAZ": ["export", "{url}", "{folder}/url.laz"],
    "vote URL": ["vote", "{drive}", "--map", "{url}", "--out", "{folder}/ballot_2"],
}


def write_town(file: Path, millions: float, street: Path | None = None) -> int:
    """How many points were written: streets and blocks of houses in a square, with intensity, as one LAZ file; 20 m
    beyond the map of a ``street``, where one is given."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 0.001)
    random, written, block = np.random.default_rng(0), 0, 0
    wide = max(round(np.sqrt(millions * 1e6 / 150_000)), 1)
    known = np.zeros((0, 3)) if street is None else all_points(read_map(street))
    corner = np.zeros(3) if street is None else np.array([known[:, 0].min(), known[:, 1].max() + 20.0, 0.0])
    with laspy.open(file, mode="w", header=header) as stream:
        while written < millions * 1e6:
            row, col = divmod(block, wide)
            points = np.concatenate(list(_block(random))) + np.array([col, row, 0.0]) * (BLOCK_M + STREET_M) + corner
            if block == 0:
                points = np.concatenate([known, points])
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


def measured(verb: list[str], beside: Callable[[], None] = lambda: None) -> tuple[float, float, float, int]:
    """(largest memory in MB, seconds of CPU, seconds on the clock, exit code) of ``mapvote verb``; ``beside`` is called
    as often as memory is looked at."""
    began, most = time.monotonic(), 0.0
    child = subprocess.Popen([sys.executable, "-m", "mapvote", *verb], stdout=subprocess.DEVNULL)
    while True:
        ended, status, used = os.wait4(child.pid, os.WNOHANG)
        if ended:
            break
        most = max(most, memory_mb(child.pid))
        beside()
        time.sleep(0.1)
    child.returncode = os.waitstatus_to_exitcode(status)
    return most, used.ru_utime + used.ru_stime, time.monotonic() - began, child.returncode


class Served:
    """A server that first takes a map into its store: its memory until it listens, and since it was last asked."""

    def __init__(self, verb: list[str]) -> None:
        began, self.most = time.monotonic(), 0.0
        self.process = subprocess.Popen(
            [sys.executable, "-m", "mapvote", *verb], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert self.process.stdout is not None
        while not select.select([self.process.stdout], [], [], 0.1)[0]:
            self.look()
        line = self.process.stdout.readline()
        if not line.startswith("serving "):
            raise RuntimeError("the server did not start")
        self.url, self.clock_s = line.split()[1], time.monotonic() - began

    def look(self) -> None:
        """At its memory."""
        self.most = max(self.most, memory_mb(self.process.pid))

    def cpu_s(self) -> float:
        """Of the process so far."""
        used = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(used[11]) + int(used[12])) / os.sysconf("SC_CLK_TCK")

    def taken(self) -> float:
        """The largest memory since this was last asked, MB."""
        most, self.most = self.most, 0.0
        return most

    def stop(self) -> None:
        """As a user does."""
        self.process.terminate()
        self.process.wait(60)


def rows_of(verbs: list[str], places: dict[str, object]) -> Iterator[dict[str, str]]:
    """One for each verb, and one for the server while a verb asks it."""
    server: Served | None = None
    try:
        for verb in verbs:
            words = [part.format(**places) for part in VERBS[verb]]
            if verb == "serve":
                server = Served(words)
                places["url"] = server.url
                yield told(verb, server.taken(), server.cpu_s(), server.clock_s, 0)
                continue
            if "{url}" in VERBS[verb] and server is not None:
                before = server.cpu_s()
                found = measured(words, server.look)
                yield told(verb, *found)
                yield told(f"{verb}: the server", server.taken(), server.cpu_s() - before, found[2], 0)
            else:
                yield told(verb, *measured(words))
    finally:
        if server is not None:
            server.stop()


def told(verb: str, memory: float, cpu_s: float, clock_s: float, code: int) -> dict[str, str]:
    """As a row of the table."""
    row = {"verb": verb, "memory_mb": f"{memory:.0f}"}
    return row | {"cpu_s": f"{cpu_s:.0f}", "clock_s": f"{clock_s:.0f}", "exit": str(code)}


def main() -> None:
    """Parse and run."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--points", type=float, nargs="+", default=[10.0], metavar="MILLION")
    asked.add_argument("--verbs", default="import,info", help=f"in this order; of {', '.join(VERBS)}")
    asked.add_argument("--drive", type=Path, help="for vote: a drive through the street")
    asked.add_argument("--street", type=Path, help="the street's map: part of the town")
    asked.add_argument("--out", type=Path, help="CSV; rows of the same size and verb replace older ones")
    asked.add_argument("--scratch", type=Path, help="where there is room: 60 bytes a point")
    options = asked.parse_args()
    for millions in options.points:
        with tempfile.TemporaryDirectory(dir=options.scratch) as name:
            folder = Path(name)
            os.environ["XDG_CACHE_HOME"] = name  # planes that clients fetch
            places = {"laz": folder / "town.laz", "map": folder / "map", "folder": folder}
            places |= {"store": folder / "town.db", "drive": options.drive}
            n = write_town(places["laz"], millions, options.street)
            for row in rows_of(options.verbs.split(","), places):
                row = {"million_points": f"{n / 1e6:.1f}"} | row
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
