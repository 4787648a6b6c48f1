"""Hashes of what the program computes: maps, ballots, updated maps and tables of `corner`, `street` and the KITTI runs.

    python benchmarks/outputs.py OUT [--source OTHER/src] [--kitti ../shared/data/kitti]

A change that only moves code leaves every line as it was: run it with ``--source`` of both checkouts and compare the
two ``OUT/hashes.txt``. Everything goes through the command line, so that the inside may change between the two.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

BLOCKS = "0:12,24:36", "12:24,36:50"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--source", type=Path, default=Path(__file__).parent.parent / "src")
    parser.add_argument("--kitti", type=Path, default=Path("../shared/data/kitti"))
    parser.add_argument("--quick", action="store_true", help="corner only")
    arguments = parser.parse_args()
    out, source = arguments.out.resolve(), arguments.source.resolve()
    out.mkdir(parents=True)

    def mapvote(*words: str | Path) -> None:
        environment = {**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "mapvote", *map(str, words)]
        subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)

    lines: list[str] = []

    def note(path: Path) -> None:
        files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        for file in files:
            lines.append(f"{_sha(file)}  {file.relative_to(out)}")
        (out / "hashes.txt").write_text("\n".join(lines) + "\n")

    for scenario, cases in (("corner", "all"), ("street", "1,5,surfaces"))[: 1 if arguments.quick else 2]:
        result = out / f"{scenario}.json"
        mapvote("evaluate", scenario, "--seed", "2", "--case", cases, "--json", result, "--cache", out / "cache")
        note(result)
    streets = out / "corner"
    mapvote("simulate", "corner", streets, "--seed", "3")
    _round(
        mapvote,
        note,
        out / "corner_3",
        sorted(streets.glob("survey_*")),
        [(d, ()) for d in sorted(streets.glob("v[0-9]"))],
    )
    for drive in sorted(arguments.kitti.glob("*"))[: 0 if arguments.quick else 2]:
        _round(
            mapvote,
            note,
            out / drive.name,
            [drive],
            [(drive, ("--scans", BLOCKS[1], "--vehicle", "a")), (drive, ("--scans", BLOCKS[0], "--vehicle", "b"))],
            ("--scans", BLOCKS[0]),
        )
    print((out / "hashes.txt").read_text())


def _round(mapvote, note, out: Path, surveys, drives, cut=()) -> None:  # type: ignore[no-untyped-def]
    """Build, vote by two rules, update; every file's hash."""
    out.mkdir()
    mapvote("build", *surveys, "--out", out / "map", *cut)
    note(out / "map")
    for case in ("surfaces", "1", "5"):
        ballots = []
        for drive, options in drives:
            ballots.append(out / f"{len(ballots)}_{case}.ballot")
            mapvote("vote", drive, "--map", out / "map", "--out", ballots[-1], "--case", case, *options)
            note(ballots[-1])
        mapvote("update", out / "map", *ballots, "--out", out / f"updated_{case}", "--cells", out / f"cells_{case}.npz")
        note(out / f"updated_{case}")
        note(out / f"cells_{case}.npz")


def _sha(file: Path) -> str:
    data = file.read_bytes()
    if file.suffix == ".json":  # what depends on the clock or on the path is no result
        value = json.loads(data)
        if isinstance(value, dict):
            for key in ("created", "seconds", "time", "timings", "stage_ms", "map_id"):
                value.pop(key, None)
        data = json.dumps(value, sort_keys=True).encode()
    return hashlib.sha256(data).hexdigest()[:16]


if __name__ == "__main__":
    main()
