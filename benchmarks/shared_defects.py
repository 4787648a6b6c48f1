"""The false changes that three vehicles make which share one defect of reading, under the default policy.

    mapvote simulate corner corner --seed 90
    mapvote build corner/survey_1 corner/survey_2 --out corner_map
    python benchmarks/shared_defects.py corner corner_map --out results/shared_defects.csv

Each vehicle's drive is written anew with the defect, and votes as `mapvote vote` votes, with all its checks. The same
error of three vehicles passes any quorum, so only reading it right, or no ballot, helps. What the update of the drives
as they were simulated makes of the map is right here: a point is added falsely if no point lies within 0.3 m of it
there, and deleted falsely if it stays there.
"""

from __future__ import annotations

import argparse
import csv
import logging
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from command_line import typed
from drive_formats import with_times, write_drive
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.point_map import all_points
from mapvote.core.types import F64, I64, Drive, MapvoteError, Scan
from mapvote.formats import open_drive, read_map

VOXEL_M = 0.3
NO_TIME = "quality"
Of = Callable[[F64, int], Any]
"""The values of a field, of times after the stamp (n,), seconds, and the stamp, nanoseconds."""


@dataclass(frozen=True)
class Defect:
    """How a drive is written that somebody reads wrongly."""

    name: str
    suffix: str = ".npy"
    field_name: str = "t"
    of: Of = lambda t, _: t.astype("f4")
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """How the sensor is mounted; points and prior know it."""
    files: Callable[[Path, I64, F64], None] = lambda folder, stamps_ns, T: None
    """What is done to the files, with stamps (n,) and poses (n, 4, 4)."""
    toml: dict[str, Any] = field(default_factory=dict)


def _one_wrong(of: Of, value: float) -> Of:
    def values(t: F64, stamp_ns: int) -> Any:
        out = np.array(of(t, stamp_ns))
        out[len(out) // 3] = value
        return out

    return values


def _since_1970(t: F64, stamp_ns: int) -> Any:
    return stamp_ns * 1e-9 + t


def _named(name_of: Callable[[int, int], str]) -> Callable[[Path, I64, F64], None]:
    """Scan files by other names, of their number and stamp."""

    def rename(folder: Path, stamps_ns: I64, _: F64) -> None:
        for i, (file, ns) in enumerate(zip(sorted(folder.glob("0*.*")), stamps_ns.tolist(), strict=True)):
            file.rename(folder / f"{name_of(i, ns)}{file.suffix}")

    return rename


def _reordered(order: Callable[[int], I64]) -> Callable[[Path, I64, F64], None]:
    def reorder(folder: Path, stamps_ns: I64, _: F64) -> None:
        files = sorted(folder.glob("0*.*"))
        data = [file.read_bytes() for file in files]
        for file, k in zip(files, order(len(files)).tolist(), strict=True):
            file.write_bytes(data[k])

    return reorder


def _quaternions(header: str, of: Callable[[F64], F64]) -> Callable[[Path, I64, F64], None]:
    """A prior of positions and quaternions (n, 4), x first, written in another order."""

    def rewrite(folder: Path, stamps_ns: I64, T: F64) -> None:
        turns = of(scipy.spatial.transform.Rotation.from_matrix(T[:, :3, :3]).as_quat())
        rows = np.column_stack([T[:, :3, 3], turns])
        lines = [f"{ns / 1e9:.9f} {' '.join(map(str, row))}" for ns, row in zip(stamps_ns.tolist(), rows, strict=True)]
        (folder / "prior.txt").write_text("\n".join([*filter(None, [header]), *lines]) + "\n")

    return rewrite


def _w_first(turns: F64) -> F64:
    return np.roll(turns, 1, axis=1)


def _no_time(t: F64, _: int) -> Any:
    return np.zeros(len(t), dtype="f4")


def _unpadded(_: int, ns: int) -> str:
    return f"{ns // 10**9}.{ns % 10**9}"


def defects() -> Iterator[Defect]:
    yield Defect("as simulated, written anew")
    # Mounts.
    for name, rpy_deg in (
        ("upside down", (180.0, 0.0, 0.0)),
        ("rolled by 90 deg", (90.0, 0.0, 0.0)),
        ("pitched by 45 deg", (0.0, 45.0, 0.0)),
        ("turned by 135 deg", (0.0, 0.0, 135.0)),
    ):
        yield Defect(f"mounted {name}", rpy_deg=rpy_deg)
    # Compensated or not.
    for suffix in (".pcd", "bag"):
        yield Defect(
            f"not compensated by drive.toml, {suffix}", suffix, NO_TIME, _no_time, toml={"motion_compensated": False}
        )
    yield Defect("called compensated, and is not", ".npy", NO_TIME, _no_time, toml={"motion_compensated": True})
    yield Defect("times of points all 0", of=_no_time)
    yield Defect("times of points backwards", of=lambda t, _: (-t).astype("f4"))
    # Names and values of times.
    yield Defect("ns in time_offset_ns", field_name="time_offset_ns", of=lambda t, _: np.rint(1e9 * t).astype("i4"))
    yield Defect("s in relative_timestamp, .ply", ".ply", "relative_timestamp")
    yield Defect("s since 1970, one 0", field_name="timestamp", of=_one_wrong(_since_1970, 0.0))
    yield Defect("s, one 2.2 million", of=_one_wrong(lambda t, _: t, 2.2e6))
    # The order of scans.
    yield Defect("names with nanoseconds that are not padded", ".pcd", files=_named(_unpadded))
    yield Defect("names such as scan_10_hdl32", ".pcd", files=_named(lambda i, _: f"scan_{i}_hdl32"))
    yield Defect("scans shuffled", files=_reordered(lambda n: np.random.default_rng(3).permutation(n)))
    yield Defect("scans in reverse order", files=_reordered(lambda n: np.arange(n)[::-1]))
    yield Defect("scans sorted as text", files=_reordered(lambda n: np.array(sorted(range(n), key=str))))
    yield Defect("two halves swapped", files=_reordered(lambda n: np.roll(np.arange(n), n // 2)))
    # The order of quaternions.
    yield Defect("quaternions w first, a header says so", files=_quaternions("# time x y z qw qx qy qz", _w_first))
    yield Defect("quaternions w first, EuRoC's header", files=_euroc)
    yield Defect("quaternions w first, no header", files=_quaternions("", _w_first))
    yield Defect("quaternions inverse, no header", files=_quaternions("", lambda q: q * [-1.0, -1.0, -1.0, 1.0]))


def _euroc(folder: Path, stamps_ns: I64, T: F64) -> None:
    columns = "#timestamp [ns], p_x [m], p_y [m], p_z [m], q_w [], q_x [], q_y [], q_z []"
    turns = _w_first(scipy.spatial.transform.Rotation.from_matrix(T[:, :3, :3]).as_quat())
    rows = np.column_stack([T[:, :3, 3], turns])
    lines = [f"{ns},{','.join(map(str, row))}" for ns, row in zip(stamps_ns.tolist(), rows, strict=True)]
    (folder / "prior.txt").write_text("\n".join([columns, *lines]) + "\n")


def mounted(scan: Scan, C: F64) -> Scan:
    return replace(scan, points=transform(C, scan.points.astype(np.float64)).astype(np.float32))


def written(defect: Defect, drive: Drive, folder: Path) -> Path:
    """The drive with the defect."""
    T = drive.T_map_lidar_prior
    assert T is not None
    C = from_xyz_rpy(0, 0, 0, *np.radians(defect.rpy_deg).tolist())
    stamps = drive.stamps_ns.tolist()
    tables = [
        with_times(mounted(scan, C), defect.field_name, lambda t, ns=ns: defect.of(t, ns))
        for scan, ns in zip(drive, stamps, strict=True)
    ]
    toml = {
        "rate_hz": drive.sensor.rate_hz,
        "prior_sigma_m": drive.prior_sigma_m,
        "prior_sigma_deg": drive.prior_sigma_deg,
        "T_base_lidar": (drive.T_base_lidar @ inverse(C))[:3].ravel().tolist(),
    }
    T_map_lidar = T @ inverse(C)
    poses = T_map_lidar @ inverse(drive.T_base_lidar) if defect.suffix == "bag" else T_map_lidar
    write_drive(folder, defect.suffix, tables, drive.stamps_ns, poses, **toml, **defect.toml)
    defect.files(folder, drive.stamps_ns, T_map_lidar)
    return folder


def updated(folders: list[Path], point_map: Path, scratch: Path) -> F64:
    """Points (n, 3) of the map after the votes of these drives; MapvoteError if one has no ballot."""
    ballots = [scratch / f"{k}.ballot" for k in range(len(folders))]
    for k, (folder, ballot) in enumerate(zip(folders, ballots, strict=True)):
        typed("vote", folder, "--map", point_map, "--vehicle", f"car_{k}", "--out", ballot)
    typed("update", point_map, *ballots, "--out", scratch / "updated")
    return all_points(read_map(scratch / "updated"))


def false_changes(before: F64, right: F64, after: F64) -> tuple[int, int]:
    """(points added, points deleted) falsely, of maps as points (n, 3)."""
    came = after[scipy.spatial.KDTree(before).query(after)[0] > 1e-6]
    added = scipy.spatial.KDTree(right).query(came)[0] > VOXEL_M if len(came) else np.zeros(0)
    stays = before[scipy.spatial.KDTree(right).query(before)[0] < 1e-6]
    deleted = scipy.spatial.KDTree(after).query(stays)[0] > 1e-6
    return int(added.sum()), int(deleted.sum())


def row_of(defect: Defect, drives: list[Drive], map_path: Path, before: F64, right: F64) -> dict[str, object]:
    with tempfile.TemporaryDirectory() as scratch:
        folders = [written(defect, drive, Path(scratch) / drive.vehicle) for drive in drives]
        try:
            after = updated(folders, map_path, Path(scratch))
        except MapvoteError as error:
            why = str(error).replace(scratch, "")
            return {"defect": defect.name, "added": 0, "deleted": 0, "no ballot": why}
    added, deleted = false_changes(before, right, after)
    return {"defect": defect.name, "added": added, "deleted": deleted, "no ballot": ""}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("corner", type=Path)
    parser.add_argument("map", type=Path)
    parser.add_argument("--defects", default="", help="only those whose name matches this regular expression")
    parser.add_argument("--out", type=Path, help="CSV, written anew")
    asked = parser.parse_args()
    logging.disable(logging.WARNING)
    folders = [asked.corner / f"v{k}" for k in (1, 2, 3)]
    drives = [open_drive(folder) for folder in folders]
    before = all_points(read_map(asked.map))
    with tempfile.TemporaryDirectory() as scratch:
        right = updated(folders, asked.map, Path(scratch))
    rows = []
    for defect in defects():
        if re.search(asked.defects, defect.name):
            rows.append(row_of(defect, drives, asked.map, before, right))
            print(*rows[-1].values(), sep=" | ", flush=True)
    if asked.out and rows:
        with asked.out.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
