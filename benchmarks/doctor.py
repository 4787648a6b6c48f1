"""Findings of the doctor on drives and maps that were broken on purpose, kind by kind: rightly named, vaguely, wrongly,
or sound.

    python benchmarks/doctor.py drives --source NAME=DRIVE ... --out results/doctor_drives.csv
    python benchmarks/doctor.py maps --source NAME=DRIVE+MAP ... --out results/doctor_maps.csv
    python benchmarks/doctor.py files --source NAME=MAP ...                       # broken files, and each one mended
    python benchmarks/doctor.py obey --source NAME=DRIVE+MAP --out results/doctor_obeyed.csv    # mends, applied
    python benchmarks/doctor.py mounts --source NAME=DRIVE+MAP --out results/doctor_mounts.csv  # sound, however turned
    python benchmarks/doctor.py healthy --source NAME=DRIVE[+MAP] ...             # unseen drives: no alarm is right

A source is a sound drive with a prior of its own, for maps with a map of the same street. DRIVE@START:STOP:STEP takes
some of the scans. tests/faults.py lists the faults, and says what each verdict means.
"""

from __future__ import annotations

import argparse
import csv
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from command_line import typed
from faults import MAP_FILES, Bytes, Files, Recording, broken, kinds_of, mounted, verdict
from mapvote.codec.ballot import decode
from mapvote.config import Settings
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.point_map import all_points
from mapvote.core.types import Drive, MapvoteError
from mapvote.doctor import Finding
from mapvote.doctor.diagnosis import diagnose
from mapvote.doctor.map_fit import check_on_map
from mapvote.doctor.maps import examine_map, examine_points
from mapvote.formats import open_drive, read_map
from mapvote.formats.maps.cloud import Cloud, CloudPieces
from mapvote.formats.registry import WRITERS
from mapvote.fusion.fuse import update_map
from obey import obeyed

Case = tuple[str, list[str], Callable[[], list[Finding]]]
"""A kind, the patterns that name its faults, and what gives the findings."""


def opened(where: str) -> Drive:
    folder, _, scans = where.partition("@")
    return open_drive(folder, scans=scans or None)


def drives(where: str) -> Iterator[Case]:
    drive = opened(where)
    sound = recorded(drive)

    def findings(change: object) -> list[Finding]:
        with tempfile.TemporaryDirectory() as scratch:
            return diagnose(broken(sound, change, Path(scratch) / "drive")).findings

    for kind, (rights, change) in kinds_of("drives").items():
        yield kind, rights, lambda change=change: findings(change)


def maps(where: str) -> Iterator[Case]:
    at, folder = where.split("+")
    drive, points_map = opened(at), all_points(read_map(folder))
    T = drive.T_map_lidar_prior
    assert T is not None
    middle = np.round(T[len(drive) // 2, :3, 3]) - [0.0, 0.0, 2.0]

    def findings(change: Callable[[np.ndarray], np.ndarray]) -> list[Finding]:
        found, point_map = examine_points("map", Cloud(change(points_map - middle) + middle))
        return found if point_map is None else [*found, *check_on_map(drive, T, point_map)[0]]

    for kind, (rights, change) in kinds_of("maps").items():
        yield kind, rights, lambda change=change: findings(change)


def files(where: str) -> Iterator[Case]:
    """4,000 points around the middle of a map as files, broken, and mended as the doctor advises (then "sound")."""
    points = all_points(read_map(where))
    away = np.abs(points - np.median(points, axis=0)).max(axis=1)
    cloud = Cloud(points[np.sort(np.argsort(away)[:4000])])

    def findings(suffix: str, *changes: Bytes) -> list[Finding]:
        with tempfile.TemporaryDirectory() as scratch:
            file = Path(scratch) / f"map{suffix}"
            WRITERS[suffix].write(file, CloudPieces.of(cloud))
            for change in changes:
                file.write_bytes(change(file.read_bytes()))
            return [finding for finding in examine_map(file)[0] if finding.severity == "error"]

    for kind, suffix, right, change, mend in MAP_FILES:
        yield kind, [right], lambda suffix=suffix, change=change: findings(suffix, change)
        yield f"{kind}, mended", [], lambda suffix=suffix, change=change, mend=mend: findings(suffix, change, mend)


def recorded(drive: Drive) -> Recording:
    """The drive as KITTI's files have it: rows of x, y, z, intensity."""
    assert drive.T_map_lidar_prior is not None
    read = list(drive)
    scans = [np.column_stack([s.points, s.fields.get("intensity", 0 * s.points[:, 0])]) for s in read]
    toml = {"prior_sigma_m": drive.prior_sigma_m, "motion_compensated": bool(read[0].time_s is None)}
    return Recording(scans, drive.T_map_lidar_prior, (drive.stamps_ns - drive.stamps_ns[0]) * 1e-9, toml)


def with_times(drive: Drive) -> Recording:
    """The same with the times of points as a fifth column: they stay true however the points are turned."""
    r = recorded(drive)
    times_s = [scan.time_s if scan.time_s is not None else np.zeros(len(scan.points)) for scan in drive]
    scans = [np.column_stack([s, t]) for s, t in zip(r.scans, times_s, strict=True)]
    return replace(r, scans=scans, toml={"prior_sigma_m": drive.prior_sigma_m, "columns": "x,y,z,intensity,time"})


def counted(r: Recording, point_map: Path) -> str:
    """Points added and deleted by one ballot of the drive alone, as `mapvote vote` writes it with its checks; or why
    there is none."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        r.write(folder / "drive")
        try:
            typed("vote", folder / "drive", "--map", point_map, "--out", folder / "a.ballot")
        except MapvoteError as error:
            return f"no ballot: {str(error).replace(scratch, '')}"
        ballot = decode((folder / "a.ballot").read_bytes())
    fuse = Settings().fuse.model_copy(update={"min_votes": 1})
    decisions = update_map(read_map(point_map), [ballot], fuse)[1].values()
    return f"{sum(d.added for d in decisions)}, {sum(d.deleted for d in decisions)}"


def obey(where: str, kinds: str) -> Iterator[dict[str, object]]:
    """By kind: is it named, what remains once the doctor's advice is followed, and how the drive then votes."""
    at, folder = where.split("+")
    sound, point_map = recorded(opened(at)), read_map(folder)
    yield {"kind": "as it is", "verdict": "sound", "mends": 0, "left": "", "votes": counted(sound, Path(folder))}

    def look(r: Recording) -> list[Finding]:
        with tempfile.TemporaryDirectory() as scratch:
            r.write(Path(scratch) / "drive")
            return diagnose(Path(scratch) / "drive", None, point_map).findings

    for kind, (rights, change) in kinds_of("drives").items():
        if isinstance(change, Files) or kind == "as it is" or not re.search(kinds, kind):
            continue
        r = change(sound)
        said = verdict(rights, look(r))
        r, found, done = obeyed(r, look)
        left = " | ".join(f"{f.severity}: {f.what}" for f in found if f.severity != "note")
        yield {"kind": kind, "verdict": said, "mends": done, "left": left, "votes": counted(r, Path(folder))}


def mounts(where: str, kinds: str) -> Iterator[dict[str, object]]:
    """By mount in steps of 45 deg: what is wrongly found, without a map and with it, and how the drive votes."""
    at, folder = where.split("+")
    sound, point_map = with_times(opened(at)), read_map(folder)
    done: list[np.ndarray] = []
    for rpy_deg in product(range(0, 360, 45), range(0, 360, 45), range(0, 360, 45)):
        R = from_xyz_rpy(0, 0, 0, *np.radians(rpy_deg).tolist())
        if any(np.allclose(R, other) for other in done) or not re.search(kinds, str(rpy_deg)):
            continue
        done.append(R)
        r = mounted(sound, rpy_deg)
        with tempfile.TemporaryDirectory() as scratch:
            r.write(Path(scratch) / "drive")
            found = diagnose(Path(scratch) / "drive", None, point_map).findings
        told = " | ".join(f"{f.severity}: {f.what}" for f in found if f.severity != "note")
        yield {"mount": " ".join(map(str, rpy_deg)), "told": told, "votes": counted(r, Path(folder))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("drives", "maps", "files", "obey", "mounts", "healthy"))
    parser.add_argument("--source", action="append", required=True, metavar="NAME=DRIVE[@SCANS][+MAP]")
    parser.add_argument("--kinds", default="", help="only those whose name matches this regular expression")
    parser.add_argument("--out", type=Path, help="CSV, written anew")
    asked = parser.parse_args()
    table: list[dict[str, object]] = []
    for source in asked.source:
        name, _, where = source.partition("=")
        if asked.what in ("obey", "mounts"):
            for row in (obey if asked.what == "obey" else mounts)(where, asked.kinds):
                table.append({"source": name, **row})
                print(*table[-1].values(), sep="  ", flush=True)
            continue
        if asked.what == "healthy":
            folder, *point_map = where.split("+")
            found = diagnose(Path(folder), None, read_map(point_map[0]) if point_map else None).findings
            print(name, [f"{f.severity}: {f.what}" for f in found if f.severity != "note"] or "sound", flush=True)
            continue
        counts: dict[bool, Counter[str]] = {False: Counter(), True: Counter()}
        for kind, rights, judge in {"drives": drives, "maps": maps, "files": files}[asked.what](where):
            if not re.search(asked.kinds, kind):
                continue
            started = time.process_time()
            found = judge()
            told = " | ".join(f"{f.severity}: {f.what}" for f in found if f.severity != "note")
            cpu_s = f"{time.process_time() - started:.2f}"
            said = verdict(rights, found)
            counts[len(rights) > 1][said] += 1
            table.append({"source": name, "kind": kind, "verdict": said, "cpu_s": cpu_s, "told": told})
            if said != "right":
                print(name, said, kind, told, sep="  ", flush=True)
        for two, said in counts.items():
            print(f"{name}, {'two faults' if two else 'one fault, and as it is'}: {dict(said)}")
    if asked.out and table:
        with asked.out.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, list(table[0]))
            writer.writeheader()
            writer.writerows(table)


if __name__ == "__main__":
    main()
