"""What the doctor says of drives broken on purpose, kind by kind: rightly named, vaguely, wrongly, or called sound.

    python benchmarks/doctor.py drives --source NAME=FOLDER[:SCANS] ... --out results/doctor_drives.csv

Every source is a sound drive with a prior of its own; it is judged as it is first. Verdicts: "right", an error or a
warning names the illness (alone or together with what the drive cannot tell from it); "vague", something is wrong but
not what; "wrong", an error names something else; "sound".
"""

from __future__ import annotations

import argparse
import csv
import re
import shutil
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from broken_drives import Kind, Recording
from drive_kinds import KINDS
from mapvote.doctor.drives import examine_drive
from mapvote.doctor.finding import Finding
from mapvote.formats import open_drive
from mapvote.formats.atomic import whole_file

VAGUE = "do not belong together|do not fit|leap|the vehicle drives at|off the scans' motion|fits the scans in"
"""Errors that say something is wrong without saying what."""


def recording(folder: Path, scans: str | None) -> Recording:
    """A sound drive in memory, its scans as the files have them."""
    drive = open_drive(folder, scans=scans)
    assert drive.T_map_lidar_prior is not None
    read = [drive.read_scan(i) for i in range(len(drive))]
    rows = [
        np.column_stack([s.points, s.intensity if s.intensity is not None else np.zeros(len(s.points))]) for s in read
    ]
    toml = {"prior_sigma_m": drive.prior_sigma_m, "motion_compensated": bool(read[0].time_s is None)}
    return Recording(rows, drive.T_map_lidar_prior, (drive.stamps_ns - drive.stamps_ns[0]) * 1e-9, toml)


def verdict(kind: Kind, found: list[Finding]) -> str:
    told = [f for f in found if f.severity != "note"]
    if any(re.search(kind.right, f.what) for f in told):
        return "right"
    if not told:
        return "sound"
    return "wrong" if any(f.severity == "error" and not re.search(VAGUE, f.what) for f in told) else "vague"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", action="append", required=True, metavar="NAME=FOLDER[:SCANS]")
    parser.add_argument("--kinds", default="", help="only those whose name matches this regular expression")
    parser.add_argument("--out", type=Path, help="CSV to add the rows of these sources to")
    arguments = parser.parse_args()
    rows: list[dict] = []
    for source in arguments.source:
        name, _, where = source.partition("=")
        folder, _, scans = where.partition("@")
        sound = recording(Path(folder), scans or None)
        kinds = [k for k in (Kind("as it is", "^$", grave=False), *KINDS) if re.search(arguments.kinds, k.name)]
        for kind in kinds:
            rows.append(judge(name, kind, sound))
        print(summary(name, rows))
    if arguments.out:
        write(arguments.out, rows)


def judge(source: str, kind: Kind, sound: Recording) -> dict:
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "drive"
        kind.drive(sound).write(folder)
        kind.files(folder)
        started = time.process_time()
        found, _, _ = examine_drive(folder)
        seconds = time.process_time() - started
        told = [f"{f.severity}: {f.what}".replace(str(folder), "drive") for f in found if f.severity != "note"]
        shutil.rmtree(folder)
    row = {"source": source, "kind": kind.name, "grave": int(kind.grave), "verdict": verdict(kind, found)}
    row |= {"errors": sum(f.severity == "error" for f in found), "cpu_s": f"{seconds:.2f}", "told": " | ".join(told)}
    if row["verdict"] != "right":
        print(f"{source:14} {row['verdict']:6} {kind.name:45} {' | '.join(told)[:400]}", flush=True)
    return row


def summary(source: str, rows: list[dict]) -> str:
    mine = [r for r in rows if r["source"] == source and r["kind"] != "as it is"]
    count = Counter(r["verdict"] for r in mine)
    grave = sum(r["verdict"] == "sound" and r["grave"] for r in mine)
    shares = ", ".join(
        f"{count[v]} {v} ({count[v] / max(len(mine), 1):.0%})" for v in ("right", "vague", "wrong", "sound")
    )
    return f"{source}: {len(mine)} kinds: {shares}; grave ones called sound: {grave}"


def write(file: Path, rows: list[dict]) -> None:
    """Rows of sources judged now replace older ones of theirs."""
    old = []
    if file.exists():
        with file.open(newline="") as stream:
            old = [r for r in csv.DictReader(stream) if r["source"] not in {row["source"] for row in rows}]
    with whole_file(file) as partial, partial.open("w", newline="") as stream:
        table = csv.DictWriter(stream, fieldnames=list(rows[0]))
        table.writeheader()
        table.writerows([*old, *rows])


if __name__ == "__main__":
    main()
