"""What the doctor says of drives and maps broken on purpose, kind by kind: rightly named, vaguely, wrongly, or sound.

    python benchmarks/doctor.py drives --source NAME=DRIVE ... --out results/doctor_drives.csv
    python benchmarks/doctor.py maps --source NAME=DRIVE+MAP ... --out results/doctor_maps.csv

A source is a sound drive with a prior of its own, for maps with a map of the same street; it is judged as it is first.
DRIVE@START:STOP:STEP takes some of the scans. Verdicts: "right", an error or a warning names the illness (alone or
together with what cannot be told from it); "open", a note says that the drive cannot decide it; "vague", something is
wrong but not what; "wrong", an error names something else; "sound". Of maps that were moved, what the doctor measures
is held against what was done.
"""

from __future__ import annotations

import argparse
import csv
import re
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from broken_drives import Kind, Recording
from drive_kinds import KINDS
from map_kinds import MAP_KINDS, NOWHERE, MapKind, around, moved_poses
from mapvote.core.geometry import inverse, rotation_angle
from mapvote.core.point_map import all_points
from mapvote.core.types import Drive
from mapvote.doctor.diagnosis import diagnose
from mapvote.doctor.finding import Finding
from mapvote.doctor.map_fit import check_on_map
from mapvote.doctor.maps import examine_points
from mapvote.formats import open_drive, read_map
from mapvote.formats.atomic import whole_file
from mapvote.formats.maps.cloud import Cloud

VAGUE = "do not belong together|do not fit|leap|the vehicle drives at|off the scans' motion|fits the scans in|nowhere"
"""Errors that say something is wrong without saying what."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("drives", "maps"))
    parser.add_argument("--source", action="append", required=True, metavar="NAME=DRIVE[@SCANS][+MAP]")
    parser.add_argument("--kinds", default="", help="only those whose name matches this regular expression")
    parser.add_argument("--part", default="1/1", metavar="K/N", help="only the K-th of N equal parts of the list")
    parser.add_argument("--out", type=Path, help="CSV; rows of the same source and kind replace older ones")
    arguments = parser.parse_args()
    rows: list[dict] = []
    part, parts = (int(v) for v in arguments.part.split("/"))
    for source in arguments.source:
        name, _, where = source.partition("=")
        judged = drives(name, where) if arguments.what == "drives" else maps(name, where)
        for number, (kind, judge) in enumerate(judged):
            if number % parts == part - 1 and re.search(arguments.kinds, kind):
                rows.append(judge())
                tell(rows[-1])
                if arguments.out:
                    write(arguments.out, rows)
        print(summary(name, read(arguments.out) if arguments.out else rows))


def opened(where: str) -> Drive:
    folder, _, scans = where.partition("@")
    return open_drive(folder, scans=scans or None)


def drives(source: str, where: str) -> Iterator[tuple[str, object]]:
    sound = recording(opened(where))
    for kind in (Kind("as it is", "^$", grave=False), *KINDS):
        yield kind.name, lambda kind=kind: judge_drive(source, kind, sound)


def recording(drive: Drive) -> Recording:
    """A sound drive in memory, its scans as the files have them."""
    assert drive.T_map_lidar_prior is not None
    read = [drive.read_scan(i) for i in range(len(drive))]
    rows = [
        np.column_stack([s.points, s.intensity if s.intensity is not None else np.zeros(len(s.points))]) for s in read
    ]
    toml = {"prior_sigma_m": drive.prior_sigma_m, "motion_compensated": bool(read[0].time_s is None)}
    return Recording(rows, drive.T_map_lidar_prior, (drive.stamps_ns - drive.stamps_ns[0]) * 1e-9, toml)


def judge_drive(source: str, kind: Kind, sound: Recording) -> dict:
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "drive"
        kind.drive(sound).write(folder)
        kind.files(folder)
        started = time.process_time()
        found = diagnose(folder).findings
        seconds = time.process_time() - started
        shutil.rmtree(folder)
    return row(source, kind.name, kind.grave, kind.right, found, seconds, str(folder))


def maps(source: str, where: str) -> Iterator[tuple[str, object]]:
    """Kinds of broken maps; with a second ``+MAP`` also that one, laid where the first lies."""
    at, *folders = where.split("+")
    drive, point_map = opened(at), read_map(folders[0])
    points = all_points(point_map)
    assert drive.T_map_lidar_prior is not None
    _, T_sound = check_on_map(drive, drive.T_map_lidar_prior, point_map)
    middle = np.round(drive.T_map_lidar_prior[len(drive) // 2, :3, 3]) - [0.0, 0.0, 2.0]
    kinds = [MapKind("as it is", "^$", lambda p: p, np.eye(4), grave=False), *MAP_KINDS]
    if len(folders) > 1:
        other = all_points(read_map(folders[1]))
        other -= np.append(np.median(other[:, :2], axis=0), np.quantile(other[:, 2], 0.3))
        kinds.append(MapKind("the map of another street", NOWHERE, lambda p: other))
    for kind in kinds:
        changed = around(points, middle, kind.change)
        yield kind.name, lambda kind=kind, p=changed: judge_map(source, kind, drive, p, T_sound, middle)


def judge_map(
    source: str, kind: MapKind, drive: Drive, points: np.ndarray, T_sound: np.ndarray, middle: np.ndarray
) -> dict:
    started = time.process_time()
    found, point_map = examine_points("map", Cloud(points))
    T = drive.T_map_lidar_prior
    assert T is not None
    if point_map is not None and not any(f.severity == "error" for f in found):
        more, T = check_on_map(drive, T, point_map)
        found = [*found, *more]
    judged = row(source, kind.name, kind.grave, kind.right, found, time.process_time() - started, "map")
    measured = any(re.search("against the prior|agree to", f.what) for f in found)
    if kind.moved is not None and measured:
        judged |= errors_of(T, moved_poses(T_sound, middle, kind.moved))
    return judged


def errors_of(T: np.ndarray, T_true: np.ndarray) -> dict:
    """By how much poses (n, 4, 4) as the doctor mends them are off: metres, degrees, per cent."""
    k = len(T) // 2
    spread = [np.linalg.norm(one[-1, :3, 3] - one[0, :3, 3]) for one in (T, T_true)]
    return {
        "off_m": f"{np.linalg.norm(T[k, :3, 3] - T_true[k, :3, 3]):.3f}",
        "off_deg": f"{np.degrees(rotation_angle(inverse(T_true[k]) @ T[k])):.2f}",
        "off_percent": f"{100 * abs(spread[0] / spread[1] - 1):.2f}",
    }


def verdict(right: str, found: list[Finding]) -> str:
    told = [f for f in found if f.severity != "note"]
    if any(re.search(right, f.what) for f in told):
        return "right"
    if not told:
        return "open" if right != "^$" and any(re.search(right, f.what) for f in found) else "sound"
    return "wrong" if any(f.severity == "error" and not re.search(VAGUE, f.what) for f in told) else "vague"


def row(source: str, kind: str, grave: bool, right: str, found: list[Finding], cpu_s: float, path: str) -> dict:
    told = [f"{f.severity}: {f.what}".replace(path, "it") for f in found if f.severity != "note"]
    return {
        "source": source,
        "kind": kind,
        "grave": int(grave),
        "verdict": verdict(right, found),
        "errors": sum(f.severity == "error" for f in found),
        "cpu_s": f"{cpu_s:.2f}",
        "off_m": "",
        "off_deg": "",
        "off_percent": "",
        "told": " | ".join(told),
    }


def tell(r: dict) -> None:
    off = f" off {r['off_m']} m {r['off_deg']} deg {r['off_percent']} %" if r["off_m"] else ""
    if r["verdict"] != "right" or off:
        print(f"{r['source']:8} {r['verdict']:6} {r['kind']:40}{off} {r['cpu_s']} s {r['told'][:400]}", flush=True)


def summary(source: str, rows: list[dict]) -> str:
    mine = [r for r in rows if r["source"] == source and r["kind"] != "as it is"]
    count = Counter(r["verdict"] for r in mine)
    grave = sum(r["verdict"] == "sound" and r["grave"] for r in mine)
    shares = ", ".join(
        f"{count[v]} {v} ({count[v] / max(len(mine), 1):.0%})" for v in ("right", "open", "vague", "wrong", "sound")
    )
    return f"{source}: {len(mine)} kinds: {shares}; grave ones called sound: {grave}"


def read(file: Path) -> list[dict]:
    if not file.exists():
        return []
    with file.open(newline="") as stream:
        return [r | {"grave": int(r["grave"])} for r in csv.DictReader(stream)]


def write(file: Path, rows: list[dict]) -> None:
    """What was judged now replaces what was judged before."""
    judged = {(r["source"], r["kind"]) for r in rows}
    old = [r for r in read(file) if (r["source"], r["kind"]) not in judged]
    with whole_file(file) as partial, partial.open("w", newline="") as stream:
        table = csv.DictWriter(stream, fieldnames=list(rows[0]))
        table.writeheader()
        table.writerows([*old, *rows])


if __name__ == "__main__":
    main()
