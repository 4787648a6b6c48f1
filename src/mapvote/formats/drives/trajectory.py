"""Trajectories in text: KITTI's rows of 12 numbers (Geiger et al. 2013), its camera poses with calib.txt; TUM; CSV with
a header, also of latitudes and longitudes. Those with times of their own are brought to the scans' stamps; of
the others each line belongs to a scan. So a drive gets its prior.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from mapvote.core import geometry
from mapvote.core.record import record
from mapvote.core.types import F64, I64, Bool, MapvoteError
from mapvote.formats.drives.fixes import FIX_RULES, Fixes, fixes_of, priors_at
from mapvote.formats.drives.options import DriveOptions, beside, map_frame, mount_of
from mapvote.formats.drives.point_fields import log
from mapvote.formats.drives.pose_header import Column, find_header, is_number, number_in, split_row
from mapvote.formats.drives.scan_names import numbers_of
from mapvote.formats.geo.frame import MapFrame, poses_from_gnss, sound_fixes, yaw_from_track
from mapvote.formats.listing import entry, file_if_any
from mapvote.formats.reading import read_text


@record()
@dataclass(frozen=True, slots=True)
class TrajectoryRule:
    """How files of poses are read, and how far between them."""

    faces_z: float = 0.9
    """Cosine between the axis of a camera and the z axis of its own world, somewhere on a drive."""
    beyond_ns: int = 500_000_000
    """A pose is not extrapolated farther than this beyond the ends, nanoseconds."""
    hole_ns: int = 2_000_000_000
    """A pose is not interpolated over a longer hole, nanoseconds."""
    steady: float = 0.97
    """Least length of the mean direction of travel, in the axes of poses that are read right."""
    one_time_m: float = 1.0
    """Greatest distance of two poses of one time, metres."""
    unsteady: float = 0.9
    """Greatest such length where quaternions are read in the wrong order."""


TRAJECTORY_RULE = TrajectoryRule()


def read_numbers(file: Path, columns: int) -> F64:
    """(n, columns) float64 of a text file of numbers; MapvoteError names the line that is not one, or is cut off."""
    lines = read_text(file).splitlines()
    rows = [(number, split_row(line)) for number, line in enumerate(lines, 1) if _holds(line)]
    out = np.empty((len(rows), columns))
    for i, (number, words) in enumerate(rows):
        values = [number_in(word) for word in words]
        wrong = next((word for word, value in zip(words, values, strict=True) if not np.isfinite(value)), None)
        if wrong is not None:
            raise MapvoteError(f"{file}:{number}: not a number: {wrong[:40]!r}; correct the line, or leave it out")
        if len(words) != columns:
            mend = "copy it again" if i else _other_rows(len(words))
            raise MapvoteError(f"{file}:{number}: {len(words)} numbers, but a row has {columns}; {mend}")
        out[i] = values
    return out


def _other_rows(numbers: int) -> str:
    """The mend of a table whose first row has so many numbers."""
    if numbers == 13:
        return "is the first an index or a time? Leave it out, or write TUM (seconds x y z qx qy qz qw)"
    if numbers in (4, 3):
        return "write the matrix of a pose in one line"
    return "name the columns in a first line (time,x,y,z,qx,qy,qz,qw or roll,pitch,yaw), or write rows of 3 x 4"


def _holds(line: str) -> bool:
    """Whether a line is neither empty nor a comment."""
    return bool(line.strip()) and not line.lstrip().startswith("#")


def read_poses(file: Path) -> F64:
    """(n, 4, 4) from rows of 12 numbers (3 x 4) or 16 (4 x 4), as they stand in the file. MapvoteError if not rigid."""
    first = next((line for line in read_text(file).splitlines() if line.strip()), "")
    columns = 16 if len(split_row(first)) == 16 else 12
    rows = read_numbers(file, columns)
    wrong = np.flatnonzero((np.abs(rows[:, 12:] - np.eye(4)[3, : columns - 12]) > 1e-6).any(axis=1))
    if len(wrong):
        problem = f"{file}: pose {wrong[0]} does not end in 0 0 0 1"
        raise MapvoteError(f"{problem}: is each matrix written column by column? Write it row by row")
    return rigid_motions(rows[:, :12], str(file))


def rigid_motions(rows: F64, source: str) -> F64:
    """(n, 4, 4) of rows of 12 numbers, 3 x 4 matrices row by row. MapvoteError names the first that is not rigid."""
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = rows.reshape(-1, 3, 4)
    check_rigid(T, source)
    return T


def motions_of_rpy(rows: F64) -> F64:
    """(n, 4, 4) of rows x, y, z (metres), roll, pitch, yaw (radians): R = Rz(yaw) Ry(pitch) Rx(roll)."""
    rotations = scipy.spatial.transform.Rotation.from_euler("ZYX", rows[:, [5, 4, 3]])
    return geometry.poses_at(rows[:, :3], rotations.as_matrix())


def check_rigid(T: F64, source: str) -> None:
    """MapvoteError naming the first of the poses (n, 4, 4) that is not a right-handed rigid motion, and its defect."""
    for i, T_i in enumerate(T):
        if geometry.is_rigid(T_i):
            continue
        R = T_i[:3, :3]
        if not np.isfinite(T_i).all():
            defect = "holds a value that is not a number"
        elif np.allclose(R @ R.T, np.eye(3), atol=1e-3):
            defect = "is left-handed (determinant -1): one axis points the wrong way; flip it in all poses"
        else:
            scale = float(np.cbrt(abs(np.linalg.det(R))))
            defect = f"has a rotation that is not orthonormal (scale {scale:.3f}); each row is a 3 x 4 T_map_lidar"
        raise MapvoteError(f"{source}: pose {i} {defect}")


def read_calib(file: Path) -> dict[str, F64]:
    """The lines "name: numbers" of a KITTI calibration file; names without numbers are left out."""
    out = {}
    for line in read_text(file).splitlines():
        name, colon, numbers = line.partition(":")
        try:
            out[name.strip()] = np.array([float(word) for word in numbers.split()])
        except ValueError:
            continue  # calib_time: 09-Jan-2012 13:57:47
        if not colon:
            raise MapvoteError(f"{file}: not a KITTI calibration: {line!r} has no colon")
    return out


def _read_T_camera_lidar(file: Path) -> F64:
    """(4, 4) from the line Tr (or Tr_velo_cam, Tr_velo_to_cam) of KITTI odometry's calib.txt."""
    calib = read_calib(file)
    for name in ("Tr", "Tr_velo_cam", "Tr_velo_to_cam"):
        if name in calib and calib[name].size == 12:
            return rigid_motions(calib[name], f"{file} ({name})")[0]
    raise MapvoteError(f"{file}: no line 'Tr:' with 12 numbers, the motion from LiDAR to camera")


def _travels_along(T: F64) -> str:
    """The local axis, "+x" ... "-z", along which the vehicle moves by most of its way; "" if it hardly moves (1 m)."""
    steps = np.einsum("nji,nj->ni", T[:-1, :3, :3], np.diff(T[:, :3, 3], axis=0))
    total = steps.sum(axis=0) if len(steps) else np.zeros(3)
    axis = int(np.argmax(np.abs(total)))
    if np.abs(total[axis]) < max(1.0, 0.7 * float(np.linalg.norm(steps, axis=1).sum())):
        return ""
    return f"{'+' if total[axis] > 0 else '-'}{'xyz'[axis]}"


def read_T_map_lidar(file: Path, folder: Path) -> F64:
    """Poses (n, 4, 4) of a file of rows as T_map_lidar. Camera poses are recognised by their motion along z.

    With ``folder``/calib.txt (KITTI odometry) they are converted, the map being the first LiDAR frame; without it
    they are a MapvoteError.
    """
    poses = read_poses(file)
    calib = entry(folder, "calib.txt")
    axis = _travels_along(poses)
    # A sensor that is mounted with its z axis ahead moves along z, too, but its z axis is level in the map.
    camera = axis == "+z" and bool(np.abs(poses[:, 2, 2]).max() > TRAJECTORY_RULE.faces_z)
    if camera or (calib.is_file() and axis == "" and file.name.lower() != "prior.txt"):
        if not calib.is_file():
            raise MapvoteError(
                f"{file}: these are camera poses (the vehicle moves along z, not x); put KITTI's calib.txt into "
                f"{folder} to have them converted, or write T_map_lidar rows"
            )
        T_camera_lidar = _read_T_camera_lidar(calib)
        return geometry.inverse(T_camera_lidar) @ poses @ T_camera_lidar
    return poses


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses with their times."""

    times_ns: I64
    """(n,) ascending."""
    T_map: F64
    """(n, 4, 4) T_map_lidar, or T_map_base where the file describes the vehicle (``of_vehicle``)."""
    of_vehicle: bool
    frame: MapFrame
    """Where its map lies; local unless it came from latitudes and longitudes."""
    fixes: Fixes | None = None
    """The fixes that the poses were made of, where they came from a satellite receiver."""

    def at(self, stamps_ns: I64, source: str, rule: TrajectoryRule = TRAJECTORY_RULE) -> F64:
        """(m, 4, 4) at constant twist between two poses. MapvoteError if it does not cover the stamps without holes."""
        t = self.times_ns
        after = np.clip(np.searchsorted(t, stamps_ns), 1, max(len(t) - 1, 1))
        beyond = len(t) < 2 or stamps_ns[0] < t[0] - rule.beyond_ns or stamps_ns[-1] > t[-1] + rule.beyond_ns
        gap = np.ones(1) if beyond else np.maximum(t[after] - t[after - 1], 1)
        if beyond or gap.max() > rule.hole_ns:
            span = f"{t[0] / 1e9:.3f} to {t[-1] / 1e9:.3f} s" if len(t) else "none"
            raise MapvoteError(
                f"{source}: {len(t)} poses ({span}) do not cover the scans ({stamps_ns[0] / 1e9:.3f} to "
                f"{stamps_ns[-1] / 1e9:.3f} s) without holes of {rule.hole_ns / 1e9:g} s; choose scans that they "
                f"cover, or --prior none"
            )
        share = np.clip((stamps_ns - t[after - 1]) / gap, -0.5, 1.5)
        pairs = zip(after, share, strict=True)
        return np.stack([geometry.interpolate(self.T_map[a - 1], self.T_map[a], float(s)) for a, s in pairs])


def sorted_trajectory(times_ns: I64, T_map: F64, *, of_vehicle: bool, frame: MapFrame) -> Trajectory:
    """A trajectory in the order of its times, of equal times the first."""
    _, first = np.unique(times_ns, return_index=True)
    return Trajectory(times_ns[first], T_map[first], of_vehicle, frame)


def check_equal_times(file: Path, times_ns: I64, T_map: F64) -> None:
    """MapvoteError if poses of one time lie farther apart than one vehicle can be: which of them counts?"""
    _, first, which = np.unique(times_ns, return_index=True, return_inverse=True)
    apart_m = np.linalg.norm(T_map[:, :3, 3] - T_map[first[which], :3, 3], axis=1)
    row = int(np.argmax(np.nan_to_num(apart_m)))
    if apart_m[row] > TRAJECTORY_RULE.one_time_m:
        problem = (
            f"{file}: row {row + 1} lies {apart_m[row]:.1f} m off row {int(first[which[row]]) + 1}, which has its time"
        )
        raise MapvoteError(f"{problem}: two tracks in one file, or a clock that stood? Leave one of them out")


def has_times(file: Path) -> bool:
    """Whether a text file of poses carries times: TUM's eight numbers a row, or a header of names."""
    lines = read_text(file).splitlines()
    words = split_row(next((line for line in lines if _holds(line)), ""))
    return len(words) == 8 or (bool(words) and not is_number(words[0])) or find_header(lines) is not None


def read_trajectory(file: Path, frame: MapFrame | None = None) -> Trajectory:
    """TUM (seconds, x, y, z, qx, qy, qz, qw), or a table whose header names its columns, in whatever order.

    ``frame``: the frame of the map, into which latitudes and longitudes go; without one a plane at the first of them.
    MapvoteError names the line or the column that is wrong.
    """
    lines = read_text(file).splitlines()
    if find_header(lines) is None:
        first = next((line for line in lines if _holds(line)), "")
        if first and not is_number(split_row(first)[0]):
            raise MapvoteError(
                f"{file}:{lines.index(first) + 1}: no known header: {first.strip()[:80]!r}; name a time, x, y, z and "
                "qx, qy, qz, qw (or roll, pitch, yaw), or latitude, longitude"
            )
        rows = read_numbers(file, 8)
        T = _motions_of_quaternions(file, _in_tum_order(file, rows[:, 1:]))
        times_ns = _ns(file, rows[:, 0])
        check_equal_times(file, times_ns, T)
        return sorted_trajectory(times_ns, T, of_vehicle=False, frame=MapFrame())
    times_ns, columns = read_columns(file)
    zero = np.zeros(len(times_ns))
    yaw = columns.get("yaw", np.pi / 2 - columns.get("heading", zero))
    rpy = np.column_stack([columns.get("roll", zero), columns.get("pitch", zero), yaw])
    if {"latitude", "longitude"} <= set(columns):
        place = np.column_stack([columns["longitude"], columns["latitude"], columns.get("z", zero)])
        keep, place = sound_fixes(str(file), place, columns.get("status"))
        if {"qx", "qy", "qz", "qw"} <= set(columns):
            rpy = _rpy_of_quaternions(needed(file, columns, "qx", "qy", "qz", "qw"))
        T, frame = poses_from_gnss(place, rpy[keep], frame)
        has_heading = bool({"yaw", "heading", "qw"} & set(columns))
        T = T if has_heading else yaw_from_track(T)
        check_equal_times(file, times_ns[keep], T)
        trajectory = sorted_trajectory(times_ns[keep], T, of_vehicle=True, frame=frame)
        # A whole pose without a standard deviation of its own is taken as it is.
        if has_heading and "sigma" not in columns:
            return trajectory
        heading = rpy[keep, 2] if has_heading else None
        return replace(trajectory, fixes=_fixes_of_table(times_ns[keep], place, columns, keep, heading, frame))
    position = needed(file, columns, "x", "y", "z")
    if {"qx", "qy", "qz", "qw"} <= set(columns):
        quaternions = needed(file, columns, "qx", "qy", "qz", "qw")
        T = _motions_of_quaternions(file, np.column_stack([position, quaternions]))
    elif {"yaw", "heading"} & set(columns):
        T = motions_of_rpy(np.column_stack([position, rpy]))
    else:
        raise MapvoteError(f"{file}: no orientation: name columns qx, qy, qz, qw, or roll, pitch, yaw")
    check_equal_times(file, times_ns, T)
    return sorted_trajectory(times_ns, T, of_vehicle=False, frame=MapFrame())


def _fixes_of_table(
    times_ns: I64, place: F64, columns: Mapping[str, F64], keep: Bool, yaw: F64 | None, frame: MapFrame
) -> Fixes:
    """The fixes of a table, with the standard deviations and headings that its columns state."""
    order = np.unique(times_ns, return_index=True)[1]
    covariances = np.full((len(order), 9), np.nan)
    if "sigma" in columns:
        covariances[:] = np.eye(3).ravel() * columns["sigma"][keep][order, None] ** 2
    fixes = fixes_of(times_ns[order], place[order], covariances, frame)
    if yaw is None:
        return fixes
    sigmas = np.full(len(order), FIX_RULES.unstated_heading_rad)
    return fixes.with_headings(times_ns[order].tolist(), yaw[order].tolist(), sigmas.tolist())


def _rpy_of_quaternions(rows: F64) -> F64:
    """(n, 3) roll, pitch and yaw, radians, of rows qx, qy, qz, qw; zeros, which receivers write before they know their
    attitude, have none."""
    rows = np.where(np.linalg.norm(rows, axis=1, keepdims=True) > 0.5, rows, [0.0, 0.0, 0.0, 1.0])
    return np.asarray(scipy.spatial.transform.Rotation.from_quat(rows).as_euler("ZYX")[:, ::-1])


def _motions_of_quaternions(file: Path, rows: F64) -> F64:
    """(n, 4, 4) of rows x, y, z, qx, qy, qz, qw."""
    off = np.abs(np.linalg.norm(rows[:, 3:], axis=1) - 1.0)
    if not (off < 0.05).all():
        raise MapvoteError(
            f"{file}: row {int(np.argmax(~(off < 0.05))) + 1} has no unit quaternion; a header names the columns "
            "(timestamp,x,y,z,qx,qy,qz,qw)"
        )
    return geometry.poses_at(rows[:, :3], geometry.rotations_of(rows[:, 3:]))


def _in_tum_order(file: Path, rows: F64) -> F64:
    """Rows x, y, z, qx, qy, qz, qw of rows without a header, whose quaternions may have w first: only then a vehicle
    always drives to the same side of itself, and the order is told."""
    w_first = rows[:, [0, 1, 2, 4, 5, 6, 3]]
    rule = TRAJECTORY_RULE
    if len(rows) < 3 or _of_quaternions(rows) > rule.unsteady or _of_quaternions(w_first) < rule.steady:
        return rows
    log.warning("%s: no header; read as time, x, y, z, qw, qx, qy, qz: so the vehicle drives straight ahead", file)
    return w_first


def _of_quaternions(rows: F64) -> float:
    """How steady rows x, y, z, qx, qy, qz, qw are; 1 if a quaternion is none."""
    lengths = np.linalg.norm(rows[:, 3:], axis=1)
    if not (np.abs(lengths - 1.0) < 0.05).all():
        return 1.0
    return _steadiness(geometry.poses_at(rows[:, :3], geometry.rotations_of(rows[:, 3:])))


def _steadiness(T: F64) -> float:
    """How steady up and the way driven are in the axes of poses (n, 4, 4): 1 if always the same; 1 of a vehicle that
    stands."""
    R = T[:, :3, :3]
    steps = np.diff(T[:, :3, 3], axis=0)
    way_m = np.linalg.norm(steps, axis=1)
    if way_m.sum() < 1.0:
        return 1.0
    ahead = np.einsum("nji,nj->i", R[:-1], steps) / way_m.sum()
    return float(min(np.linalg.norm(ahead), np.linalg.norm(R[:, 2].mean(axis=0))))


def read_columns(file: Path) -> tuple[I64, dict[str, F64]]:
    """(times (n,) in nanoseconds, columns (n,) by the roles of :mod:`mapvote.formats.drives.pose_header`, in metres,
    radians and degrees of latitude, NaN where a value is no number) of a table with names in its header.

    Angles without a unit are degrees if any is beyond two turns of radians. MapvoteError if the names are missing,
    there is no column of times, or a row is cut off.
    """
    lines = read_text(file).splitlines()
    header = find_header(lines)
    if header is None:
        raise MapvoteError(f"{file}: its first line names no columns; copy it again")
    rows = []
    for number, line in enumerate(lines[header.line :], header.line + 1):
        if not _holds(line):
            continue
        rows.append(split_row(line))
        if len(rows[-1]) < len(header.names):
            raise MapvoteError(f"{file}:{number}: {len(rows[-1])} values, but the header names {len(header.names)}")
    if not rows:
        raise MapvoteError(f"{file}: a header, but no poses")
    time = header.columns.get("time")
    if time is None:
        raise MapvoteError(f"{file}: no column of times among {', '.join(header.names)}; name one timestamp, time or t")
    times_ns = exact_ns(file, [row[time.index] for row in rows], time.scale)
    values = {role: np.array([number_in(row[column.index]) for row in rows]) for role, column in header.columns.items()}
    columns = {role: values[role] * _scale(role, column) for role, column in header.columns.items()}
    unstated = [role for role in _ANGLES if role in columns and header.columns[role].scale is None]
    if _in_degrees(file, columns, unstated):
        columns |= {role: np.radians(columns[role]) for role in unstated}
    if "nanoseconds" in columns:
        times_ns += needed(file, columns, "nanoseconds")[:, 0].astype(np.int64)
    return times_ns, columns


_ANGLES = ("roll", "pitch", "yaw", "heading")


def _scale(role: str, column: Column) -> float:
    """Metres, or radians, in one of a column; 1 of what has no unit, or none that its header names."""
    return column.scale or 1.0 if role in ("x", "y", "z", "down", "sigma", *_ANGLES) else 1.0


def _in_degrees(file: Path, columns: Mapping[str, F64], unstated: Sequence[str]) -> bool:
    """Whether the angles without a unit are degrees: one is beyond two turns of radians, or only so the vehicle drives
    straight ahead. One file has one unit."""
    if any(float(np.nanmax(np.abs(columns[role]), initial=0.0)) > 2.0 * np.pi + 0.01 for role in unstated):
        return True
    if not unstated or not {"x", "y"} <= set(columns):
        return False
    zero = np.zeros(len(columns["x"]))
    rpy = {role: columns.get(role, zero) for role in ("roll", "pitch")}
    steady = []
    for radians in (1.0, np.pi / 180.0):
        turned = {role: values * radians if role in unstated else values for role, values in columns.items()}
        yaw = turned.get("yaw", np.pi / 2 - turned.get("heading", zero))
        angles = [turned.get(role, values) for role, values in rpy.items()]
        rows = np.column_stack([columns["x"], columns["y"], columns.get("z", zero), *angles, yaw])
        steady.append(_steadiness(motions_of_rpy(rows)) if np.isfinite(rows).all() else 1.0)
    unsteady = 1.0 - np.array(steady)
    degrees = bool(unsteady[0] > 1.0 - TRAJECTORY_RULE.steady and unsteady[1] < 0.2 * unsteady[0])
    if degrees:
        log.warning("%s: angles without a unit; read as degrees: so the vehicle drives straight ahead", file)
    return degrees


def needed(file: Path, columns: Mapping[str, F64], *names: str) -> F64:
    """(n, len(names)) columns of :func:`read_columns`; MapvoteError names one that is missing or holds no number."""
    missing = [name for name in names if name not in columns]
    if missing:
        raise MapvoteError(f"{file}: no column {', '.join(missing)}; the columns are {', '.join(columns)}")
    table = np.column_stack([columns[name] for name in names])
    bad = np.argwhere(~np.isfinite(table))
    if len(bad):
        raise MapvoteError(f"{file}: row {bad[0, 0] + 1} has no number in column {names[bad[0, 1]]}; leave it out")
    return table


def date_ns(text: str, source: str) -> int:
    """Nanoseconds since 1970 of a date and time such as KITTI's "2011-09-26 13:02:25.964389445", in UTC where it names
    no other zone. MapvoteError if it is none."""
    date = r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)(?:[.,](\d+))?\s*(Z|[-+]\d\d:?\d\d)?"
    parts = re.fullmatch(date, text.strip())
    try:
        if parts is None:
            raise ValueError
        zone = (parts[3] or "Z").replace("Z", "+00:00")
        moment = datetime.fromisoformat(parts[1] + (zone if ":" in zone else f"{zone[:3]}:{zone[3:]}"))
    except ValueError as error:
        raise MapvoteError(f"{source}: not a date and time: {text!r}; write seconds, or 2025-10-01 13:00:00") from error
    return round(moment.timestamp()) * 10**9 + int((parts[2] or "0").ljust(9, "0")[:9])


def exact_ns(file: Path, texts: Sequence[str], unit_ns: float | None = None) -> I64:
    """(n,) nanoseconds of times written as seconds, as whole milli-, micro- or nanoseconds since 1970, or as date and
    time. Whole numbers are exact: float64 holds no nanoseconds since 1970. ``unit_ns``: the unit, where it is known."""
    if texts and all(":" in text for text in texts):
        return np.array([date_ns(text, str(file)) for text in texts], dtype=np.int64)
    if unit_ns is not None and all(is_number(text) for text in texts):
        return np.array([round(Fraction(text) * int(unit_ns)) for text in texts], dtype=np.int64)
    if not all(text.strip().lstrip("-").isdigit() for text in texts):
        return _ns(file, np.array([number_in(text) for text in texts]))
    whole = [int(text) for text in texts]
    unit = _unit(float(max(map(abs, whole), default=0)))
    try:
        return np.array([value * unit for value in whole], dtype=np.int64)
    except OverflowError as error:
        raise MapvoteError(f"{file}: {max(whole, key=abs)} is no time since 1970") from error


def _unit(largest: float) -> int:
    """Nanoseconds in one: seconds, milli-, micro- or nanoseconds since 1970, by size."""
    return next((10**power for limit, power in ((1e11, 9), (1e14, 6), (1e17, 3)) if largest < limit), 1)


def _ns(file: Path, seconds: F64) -> I64:
    if not np.isfinite(seconds).all():
        raise MapvoteError(f"{file}: row {int(np.argmax(~np.isfinite(seconds))) + 1} has no time")
    unit = _unit(float(np.abs(seconds).max(initial=0.0)))
    whole = np.floor(seconds)
    ns: I64 = whole.astype(np.int64) * unit + np.round((seconds - whole) * unit).astype(np.int64)
    return ns


def of_scans(lines: NDArray[Any], files: list[Path], table: Path) -> NDArray[Any]:
    """One of the lines (m, ..) of ``table`` for each scan: in order, or by the number in the scan's name.

    KITTI's recordings lack some scans but no line. MapvoteError if the counts cannot be matched.
    """
    n = len(lines)
    if n == len(files):
        return lines
    numbers = numbers_of(files)
    if n > len(files) and len(set(numbers.tolist())) == len(files) and numbers.min() >= 0 and numbers.max() < n:
        return lines[numbers]
    raise MapvoteError(
        f"{table}: {n} lines for {len(files)} scans ({files[0].name} to {files[-1].name}); it must have one line "
        f"a scan, in order"
    )


class Prior(NamedTuple):
    """The prior of a recorded drive."""

    T_map_lidar: F64 | None = None
    """(n, 4, 4) of every scan; None: there is none."""
    frame: MapFrame = MapFrame()
    """The frame that it is in."""
    sigmas: F64 | None = None
    """(n, 2) as :class:`mapvote.core.types.Drive` has it."""


def prior_of(
    path: Path,
    options: DriveOptions,
    files: list[Path],
    stamps_ns: I64,
    own: Callable[[], Trajectory | F64 | None],
    own_name: str | None = None,
    T_base_lidar: F64 | None = None,
) -> Prior:
    """The prior of every scan: by the file that the options name, else prior.txt, else the layout's own. ``files``: of
    the scans, which lines of a file are matched with by number."""
    said = options.prior
    if said is not None and said.lower() == "none":
        return Prior()
    home = beside(path)
    if said is None:
        file = file_if_any(home, "prior.txt")
    else:
        places = () if said == own_name else (Path(said), home / said)
        file = next((place for place in places if place.is_file()), None)
    if file is None and said not in (None, own_name):
        raise MapvoteError(f"{said}: no such prior, neither here nor in {path}; give a file of 3 x 4 rows, or none")
    if file is not None and not has_times(file):
        return Prior(of_scans(read_T_map_lidar(file, path), files, file))
    poses = own() if file is None else read_trajectory(file, map_frame(options))
    if poses is None:
        return Prior()
    if not isinstance(poses, Trajectory):
        return Prior(of_scans(poses, files, path))
    mount = mount_of(options, T_base_lidar, str(path))
    # A vehicle on the road knows the fixes up to each scan alone; where the map lies on Earth, so does its recording.
    if options.as_live and poses.fixes is not None and map_frame(options) is not None:
        priors = priors_at(poses.fixes, stamps_ns, mount)
        if priors is None:
            raise MapvoteError(f"{file or path}: no fix comes within {FIX_RULES.old_s:g} s before any scan")
        return Prior(priors[0], poses.frame, priors[1])
    T = poses.at(stamps_ns, str(file or path))
    return Prior(T @ mount if poses.of_vehicle else T, poses.frame)
