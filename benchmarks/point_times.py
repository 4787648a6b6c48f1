"""Votes of one simulated drive whose points carry their times in every way that people write them, right and wrong.

    mapvote simulate corner corner --seed 90
    mapvote build corner/survey_1 corner/survey_2 --out corner_map
    python benchmarks/point_times.py corner corner_map                 # one ballot alone; --vehicles 3: a quorum

A row is a case: the points that an update adds and deletes, and the scans localised; or the error that stops the vote.
Each drive is written anew in another format, with other fields. The first row is the drive as the simulator wrote it.
"""

from __future__ import annotations

import argparse
import logging
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from drive_formats import with_times, write_drive
from mapvote.codec.ballot import Ballot
from mapvote.config import Settings
from mapvote.core.geometry import inverse
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Drive, MapvoteError
from mapvote.doctor import usable
from mapvote.doctor.bent_scans import check_bent, window_for
from mapvote.doctor.scans import looked_at
from mapvote.formats import open_drive, read_map
from mapvote.fusion.fuse import update_map
from mapvote.vehicle import vote_drive

Of = Callable[[F64, int], Any]
"""The values of a field, of times after the stamp (n,), seconds, and the stamp, nanoseconds."""


@dataclass(frozen=True)
class Case:
    """A way to write times."""

    name: str
    suffix: str
    field: str
    of: Of
    toml: dict[str, Any]


def wrong(of: Of, value: float, share: float = 0.0) -> Of:
    """With a wrong value in a share of the points, in one at least."""

    def values(t: F64, stamp_ns: int) -> Any:
        out = np.array(of(t, stamp_ns))
        out[np.random.default_rng(0).choice(len(out), max(1, int(share * len(out))), replace=False)] = value
        return out

    return values


def seconds(t: F64, _: int) -> Any:
    return t.astype("f4")


def since_1970(t: F64, stamp_ns: int) -> Any:
    return stamp_ns * 1e-9 + t


def whole_ns(t: F64, stamp_ns: int) -> Any:
    return stamp_ns + np.rint(1e9 * t).astype("i8")


def column(columns: int) -> Of:
    return lambda t, _: np.floor((t + 0.05) * 10 * columns).astype("u2")


def cases() -> Iterator[Case]:
    for suffix in (".pcd", ".ply", ".las", ".npy", ".bin", "bag"):
        yield Case(f"seconds, {suffix}", suffix, "t", seconds, {})
        yield Case(
            f"none, not compensated, {suffix}", suffix, "quality", lambda t, _: 0 * t, {"motion_compensated": False}
        )
    kinds: list[tuple[str, str, Of]] = [
        ("int32 ns, unknown name", "time_offset_ns", lambda t, _: np.rint(1e9 * t).astype("i4")),
        ("float32 s, unknown name", "relative_timestamp", seconds),
        ("float64 us, no name", "a", lambda t, _: 1e6 * t),
        ("float32 ms", "t", lambda t, _: (1e3 * t).astype("f4")),
        ("int32 us", "t", lambda t, _: np.rint(1e6 * t).astype("i4")),
        ("int16 ms", "t", lambda t, _: np.rint(1e3 * t).astype("i2")),
        ("float64 s since 1970", "timestamp", since_1970),
        ("float64 ns since 1970", "timestamp", lambda t, s: s + 1e9 * t),
        ("uint64 ns since 1970", "timestamp", lambda t, s: whole_ns(t, s).astype("u8")),
        ("uint32 ns since 1970, wrapped", "timestamp", lambda t, s: (whole_ns(t, s) % 2**32).astype("u4")),
        ("uint32 ns, negative ones wrapped", "t", lambda t, _: (whole_ns(t, 0) % 2**32).astype("u4")),
        ("s since 1970, one 0", "timestamp", wrong(since_1970, 0.0)),
        ("s since 1970, 4 % zeros", "timestamp", wrong(since_1970, 0.0, 0.04)),
        ("s since 1970, 10 % zeros", "timestamp", wrong(since_1970, 0.0, 0.1)),
        ("s, one 50", "t", wrong(seconds, 50.0)),
        ("s, one 2.2 million", "t", wrong(seconds, 2.2e6)),
        ("s, 3 % not a number", "t", wrong(seconds, np.nan, 0.03)),
        ("s, 10 % zeros", "t", wrong(seconds, 0.0, 0.1)),
        ("a counter of points", "timestamp", lambda t, _: np.arange(len(t)).astype("u4")),
        ("a column of 1024", "t", column(1024)),
        ("a packet of 180", "t", column(180)),
        ("s since 1970, float32", "t", lambda t, s: since_1970(t, s).astype("f4")),
        ("s of another clock", "timestamp", lambda t, s: since_1970(t, s) - 1.7e9),
        ("s since the start of the scan", "t", lambda t, _: t + 0.05),
        ("s, all 0", "t", lambda t, _: 0.0 * t),
        ("s before the end, counted backwards", "t", lambda t, _: -t),
    ]
    yield from (Case(name, ".npy", field, of, {}) for name, field, of in kinds)


def written(case: Case, drive: Drive, folder: Path) -> Path:
    """The drive with its times as the case has them."""
    T = drive.T_map_lidar_prior
    assert T is not None
    stamped = zip(drive, drive.stamps_ns.tolist(), strict=True)
    tables = [with_times(scan, case.field, lambda t, ns=ns: case.of(t, ns)) for scan, ns in stamped]
    toml = {
        "sensor": drive.sensor.name,
        "rate_hz": drive.sensor.rate_hz,
        "vehicle": drive.vehicle,
        "prior_sigma_m": drive.prior_sigma_m,
        "prior_sigma_deg": drive.prior_sigma_deg,
        "T_base_lidar": drive.T_base_lidar[:3].ravel().tolist(),
    }
    poses = T @ inverse(drive.T_base_lidar) if case.suffix == "bag" else T
    return write_drive(folder, case.suffix, tables, drive.stamps_ns, poses, **toml, **case.toml)


def voted(path: Path, point_map: PointMap) -> Ballot:
    """The ballot of a drive that the checks of `mapvote vote` pass."""
    looking = looked_at(open_drive(path))
    ballot, report = vote_drive(looking.drive, point_map, Settings())
    looking.warnings()
    usable("", list(check_bent(looking.drive, report.T_map_lidar, window_for(point_map, True))))
    return ballot


def told(paths: list[Path], point_map: PointMap) -> str:
    """Effect of an update with the ballots of these drives, or why there is none."""
    try:
        ballots = [voted(path, point_map) for path in paths]
    except MapvoteError as error:
        why = str(error).replace(str(paths[0]), "").removeprefix(": ")
        return f"error: {re.sub(r'.*: the field', 'the field', why)[:110]}"
    fuse = Settings().fuse
    policy = fuse.model_copy(update={"min_votes": 1}) if len(ballots) == 1 else fuse
    decisions = update_map(point_map, ballots, policy)[1].values()
    localised = f"{sum(b.scans_localised for b in ballots)} of {sum(b.scans for b in ballots)}"
    return f"{sum(d.added for d in decisions)} | {sum(d.deleted for d in decisions)} | {localised}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("corner", type=Path)
    parser.add_argument("map", type=Path)
    parser.add_argument("--vehicles", type=int, default=1, choices=(1, 2, 3))
    parser.add_argument("--cases", default="", help="only those whose name matches this regular expression")
    asked = parser.parse_args()
    logging.disable(logging.WARNING)
    point_map = read_map(asked.map)
    folders = [asked.corner / f"v{k + 1}" for k in range(asked.vehicles)]
    drives = [open_drive(folder) for folder in folders]
    print(f"as simulated | {told(folders, point_map)}", flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        for number, case in enumerate(cases()):
            if re.search(asked.cases, case.name):
                paths = [written(case, d, Path(scratch) / f"{number}_{d.vehicle}") for d in drives]
                print(f"{case.name} | {told(paths, point_map)}", flush=True)


if __name__ == "__main__":
    main()
