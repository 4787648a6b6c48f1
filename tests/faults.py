"""Drives and maps broken on purpose: what is done to a sound one, and which words name it."""

from __future__ import annotations

import re
import shutil
import struct
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import tomli_w

from mapvote.core.geometry import exp, from_xyz_rpy, inverse, transform
from mapvote.core.types import F64, I64
from mapvote.doctor import Finding
from mapvote.doctor.prior import CAMERA_TO_LIDAR
from mapvote.formats.drives.scan_folder import write_poses

VAGUE = "do not belong together|do not fit|leap|the vehicle drives at|off the scans' motion|fits the scans in|nowhere"
"""Errors that say something is wrong without saying what."""
MIRROR, UP, TWICE = "left-handed|mirrored", "upside down", "occurs? twice"
TURN = r"turned by|turned against each other|headings are off|backward|turned about z"
SCALE, ORDER = r"too large|too small|in scale|scaled by", "in order of time|reverse order|out of order"
TILT = "tilted|pitched|rolled|lean by"


@dataclass
class Recording:
    """A drive in memory: scans [(n, 4)], poses (m, 4, 4), times (m,) in seconds, what drive.toml says."""

    scans: list[F64]
    T: F64
    times_s: F64
    toml: dict[str, Any] = field(default_factory=dict)

    def write(self, folder: Path) -> None:
        (folder / "velodyne").mkdir(parents=True)
        for i, scan in enumerate(self.scans):
            np.ascontiguousarray(scan, dtype="<f4").tofile(folder / "velodyne" / f"{i:06d}.bin")
        write_poses(folder / "prior.txt", self.T)
        (folder / "times.txt").write_text("".join(f"{t:.9f}\n" for t in self.times_s))
        (folder / "drive.toml").write_text(tomli_w.dumps(self.toml))


Change = Callable[..., Any]
"""Change of one array, float64."""


Span = tuple[float, float]


def sound_street(
    x: Span = (-60, 90),
    y: Span = (-40, 60),
    walls: int = 60,
    beside: Span = (9, 30),
    longest: float = 12,
    slope: float = 0,
) -> F64:
    """Points on a road, and on walls at odd angles beside it, map metres; seeded."""
    rng, n = np.random.default_rng(5), 60_000
    parts = [np.column_stack([rng.uniform(*x, n), rng.uniform(*y, n), rng.normal(0, 0.01, n)])]
    for _ in range(walls):
        x0, y0 = rng.uniform(*x), rng.choice([-1, 1]) * rng.uniform(*beside)
        along, height, heading = rng.uniform(2, longest), rng.uniform(2, 8), rng.uniform(0, np.pi)
        s, z = rng.uniform(0, along, 900), rng.uniform(0, height, 900)
        parts.append(np.column_stack([x0 + s * np.cos(heading), y0 + s * np.sin(heading), z]))
    points = np.concatenate(parts)
    points[:, 2] += slope * points[:, 0]
    return points


def serious(found: Iterable[Finding]) -> list[str]:
    return [f.what for f in found if f.severity != "note"]


Break = Callable[[Recording], Recording]


def points(change: Change) -> Break:
    """Change of a scan's x, y, z (n, 3)."""
    return rows(lambda s: np.column_stack([change(s[:, :3].astype(np.float64)), s[:, 3:]]))


def rows(change: Change) -> Break:
    """Change of a scan's rows (n, 4)."""
    return lambda r: replace(r, scans=[change(s) for s in r.scans])


def one_scan(change: Change) -> Break:
    """Change of one scan's rows, in the middle."""
    return lambda r: replace(r, scans=[change(s) if i == len(r.scans) // 2 + 1 else s for i, s in enumerate(r.scans)])


def poses(change: Change) -> Break:
    return lambda r: replace(r, T=change(r.T.copy()))


def positions(change: Change) -> Break:
    return poses(lambda T: with_(T, change(T[:, :3, 3]), slice(3, 4)))


def rotations(change: Change) -> Break:
    return poses(lambda T: with_(T, change(T[:, :3, :3]), slice(0, 3)))


def with_(T: F64, part: F64, columns: slice) -> F64:
    T[:, :3, columns] = part.reshape(len(T), 3, -1)
    return T


def yaws(rule: Change) -> Break:
    """Poses level, with another yaw."""
    return poses(lambda T: np.array([
        from_xyz_rpy(x, y, z, yaw=float(a))
        for (x, y, z), a in zip(T[:, :3, 3], rule(np.arctan2(T[:, 1, 0], T[:, 0, 0])), strict=True)
    ]))  # fmt: skip


def times(change: Change) -> Break:
    return lambda r: replace(r, times_s=change(r.times_s.copy()))


def order(of: Callable[[int], I64]) -> Break:
    return lambda r: replace(r, scans=[r.scans[i] for i in of(len(r.scans))])


@dataclass(frozen=True)
class Files:
    """Change of the folder of a drive once it is written."""

    edit: Callable[[Path], None]


def lines(name: str, change: Callable[[list[str]], list[str]]) -> Files:
    def edit(folder: Path) -> None:
        (folder / name).write_text("\n".join(change((folder / name).read_text().splitlines())) + "\n")

    return Files(edit)


def cut_in_a_point(folder: Path) -> None:
    files = sorted((folder / "velodyne").iterdir())
    files[len(files) // 2].write_bytes(files[len(files) // 2].read_bytes()[:-7])


def timed(name: str, of: Callable[[F64, float], Any], *, bent: bool = False, **toml: Any) -> Files:
    """The scans as npy files with a field more: ``of`` the times of points after the stamp, as a sensor has them that
    spins clockwise ten times a second, and the stamp, seconds. Nothing but ``toml`` is stated of them. ``bent``: the
    points lie as the sensor saw them at those times."""

    def edit(folder: Path) -> None:
        stamps_s = np.loadtxt(folder / "times.txt")
        T = np.tile(np.eye(4), (len(stamps_s), 1, 1))
        T[:, :3] = np.loadtxt(folder / "prior.txt").reshape(-1, 3, 4)
        step = inverse(T[0]) @ T[1]
        way_mps = step[:3, 3] / (stamps_s[1] - stamps_s[0])
        turn_radps = np.arctan2(step[1, 0], step[0, 0]) / (stamps_s[1] - stamps_s[0])
        (folder / "scans").mkdir()
        for file, stamp_s in zip(sorted((folder / "velodyne").iterdir()), stamps_s.tolist(), strict=True):
            scan = np.fromfile(file, dtype="<f4").reshape(-1, 4)
            time_s = -np.arctan2(scan[:, 1], scan[:, 0]).astype(np.float64) / (20.0 * np.pi)
            values = of(time_s.copy(), stamp_s)
            if bent:
                x, y, z = (scan[:, :3] - time_s[:, None] * way_mps).T
                c, s = np.cos(turn_radps * time_s), np.sin(turn_radps * time_s)
                scan[:, :3] = np.column_stack([c * x + s * y, c * y - s * x, z])
            kinds = [*((column, "<f4") for column in ("x", "y", "z", "intensity")), (name, values.dtype)]
            table = np.zeros(len(scan), dtype=kinds)
            for k, column in enumerate(("x", "y", "z", "intensity")):
                table[column] = scan[:, k]
            table[name] = values
            np.save(folder / "scans" / f"{file.stem}.npy", table)
        shutil.rmtree(folder / "velodyne")
        state(folder, motion_compensated=None, **toml)

    return Files(edit)


def pose_table(header: str, of: Callable[[F64, F64], F64]) -> Files:
    """The prior as a table of times and ``of`` positions (n, 3) and quaternions (n, 4), x first, below a header."""

    def edit(folder: Path) -> None:
        T = np.loadtxt(folder / "prior.txt").reshape(-1, 3, 4)
        turns = scipy.spatial.transform.Rotation.from_matrix(T[:, :, :3]).as_quat()
        rows = np.column_stack([np.loadtxt(folder / "times.txt"), of(T[:, :, 3], turns)])
        lines = [",".join(f"{value:.12g}" for value in row) for row in rows]
        (folder / "prior.txt").write_text("\n".join([*filter(None, [header]), *lines]) + "\n")

    return Files(edit)


def w_first(p: F64, q: F64) -> F64:
    return np.column_stack([p, np.roll(q, 1, axis=1)])


def scan_names(name_of: Callable[[int, int], str]) -> Files:
    """Scans by other names, of their number and how many there are."""

    def edit(folder: Path) -> None:
        files = sorted((folder / "velodyne").iterdir())
        for i, file in enumerate(files):
            file.rename(folder / "velodyne" / f"part-{i}")
        for i in range(len(files)):
            (folder / "velodyne" / f"part-{i}").rename(folder / "velodyne" / f"{name_of(i, len(files))}.bin")

    return Files(edit)


def state(folder: Path, **toml: Any) -> None:
    """Write these keys into drive.toml; None takes one away."""
    file = folder / "drive.toml"
    table = {**tomllib.loads(file.read_text()), **toml}
    file.write_text(tomli_w.dumps({key: value for key, value in table.items() if value is not None}))


def few(values: Any, wrong: float, share: float) -> Any:
    """With the ``wrong`` value in a share of the points."""
    values[rng(6).random(len(values)) < share] = wrong
    return values


def turn(**deg: float) -> F64:
    return from_xyz_rpy(0, 0, 0, **{axis: float(np.radians(v)) for axis, v in deg.items()})


def turned(**deg: float) -> Change:
    return lambda p: transform(turn(**deg), p)


def mounted(r: Recording, rpy_deg: tuple[float, float, float]) -> Recording:
    """The drive as a sensor that is turned so would have recorded it; the prior knows the mount."""
    C = from_xyz_rpy(0, 0, 0, *np.radians(rpy_deg).tolist())
    turned_scans = [np.column_stack([transform(C, s[:, :3]), s[:, 3:]]) for s in r.scans]
    return replace(r, scans=turned_scans, T=r.T @ inverse(C))


def half_turned(r: Recording, whole: bool) -> Recording:
    """Scans in the map's frame, or only in its axes."""
    each = [T if whole else np.block([[T[:3, :3], np.zeros((3, 1))], [np.zeros((1, 3)), 1.0]]) for T in r.T]
    return points_of_each(r, each)


def points_of_each(r: Recording, T: list[F64]) -> Recording:
    moved = [np.column_stack([transform(one, s[:, :3]), s[:, 3]]) for one, s in zip(T, r.scans, strict=True)]
    return replace(r, scans=moved)


def late(T: F64, k: int = 12) -> F64:
    """Every row ``k`` scans early; the last ones go on as the drive ended."""
    step = inverse(T[-2]) @ T[-1]
    return np.concatenate([T[k:], [T[-1] @ np.linalg.matrix_power(step, j + 1) for j in range(k)]])


def degrees(p: F64) -> F64:
    east_m = 111_320.0 * np.cos(np.radians(49.0))
    return np.column_stack([8.4 + p[:, 0] / east_m, 49.0 + p[:, 1] / 111_320.0, p[:, 2]])


def changed(T: F64, rows_: slice, axis: int, by: Any) -> F64:
    T[rows_, axis, 3] += by
    return T


def azimuth(s: F64) -> F64:
    return np.degrees(np.arctan2(s[:, 1], s[:, 0]))


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def as_floats(s: F64, kind: str) -> F64:
    return np.ascontiguousarray(s, dtype=kind).view("<f4").reshape(-1, 4)


def five_columns(s: F64) -> F64:
    """A file of five columns, the fifth a ring, read as four."""
    five = np.column_stack([s, np.arange(len(s)) % 64])
    return five.ravel()[: five.size // 4 * 4].reshape(-1, 4)


def scattered(p: F64) -> F64:
    out: F64 = p * (1 + rng(7).normal(0, 0.4, (len(p), 1)) / np.linalg.norm(p, axis=1, keepdims=True))
    return out


def frozen(T: F64) -> F64:
    T[len(T) // 2 :] = T[len(T) // 2]
    return T


C3 = CAMERA_TO_LIDAR[:3, :3]
# name, what names it rightly, what is done to a Recording (or to the files of its folder)
DRIVES: list[tuple[str, str, Break | Files]] = [
    ("points in the vehicle's left-handed axes", MIRROR, points(lambda p: p * [1, -1, 1])),
    ("points mirrored front to back", MIRROR, points(lambda p: p * [-1, 1, 1])),
    ("points facing backwards", TURN, points(lambda p: p * [-1, -1, 1])),
    ("points upside down, turned over", UP, points(lambda p: p * [1, -1, -1])),
    ("points with z negated", UP, points(lambda p: p * [1, 1, -1])),
    ("points with x and y swapped", "x and y of the scans are swapped", points(lambda p: p[:, [1, 0, 2]])),
    ("points in camera axes", "axis -y points up", points(lambda p: p @ C3)),
    ("points with y up", r"axis \+y points up", points(lambda p: p[:, [0, 2, 1]] * [1, 1, -1])),
    ("points with x up", r"axis \+x points up", points(lambda p: p[:, [2, 1, 0]])),
    *((f"points turned by {a} deg", TURN, points(turned(yaw=a))) for a in (90, -90, 30, 8)),
    *((f"points {how}ed by {a} deg", TILT, points(turned(**{how: a}))) for how, a in (("pitch", 12), ("pitch", 6))),
    ("points rolled by 10 deg", TILT, points(turned(roll=10))),
    ("points in millimetres", "millimetres", points(lambda p: 1000 * p)),
    ("points in centimetres", "centimetres", points(lambda p: 100 * p)),
    ("points in feet", SCALE, points(lambda p: p / 0.3048)),
    ("points taken for feet", SCALE, points(lambda p: p * 0.3048)),
    ("points in kilometres", r"m away in the median|metres", points(lambda p: p / 1000)),
    ("points 6 % too large", SCALE, points(lambda p: 1.06 * p)),
    ("points rounded to whole metres", "rounded to 1 m", points(np.round)),
    ("points rounded to 0.25 m", "rounded to 0.25 m", points(lambda p: np.round(4 * p) / 4)),
    ("ranges that scatter by 0.4 m", "rough|scatter", points(scattered)),
    ("points without height", "z is 0", points(lambda p: p * [1, 1, 0])),
    ("absolute values of y", "y is never negative", points(lambda p: np.where([False, True, False], abs(p), p))),
    ("points in the map's frame", "map's frame already", lambda r: half_turned(r, True)),
    ("points turned into the map's axes", "map's axes already|" + TURN, lambda r: half_turned(r, False)),
    ("intensity in z", "z (lies within|is never)|intensity", rows(lambda s: s[:, [0, 1, 3, 2]])),
    ("intensity in x", "x (lies within|is never)|intensity", rows(lambda s: s[:, [3, 0, 1, 2]])),
    ("five columns named like KITTI's", "column|intensity|not finite|5 %|x, y, z", rows(five_columns)),
    ("half of the azimuth missing", "deg of azimuth", rows(lambda s: s[azimuth(s) > 0])),
    ("the rear quarter and more missing", "deg of azimuth", rows(lambda s: s[abs(azimuth(s)) < 120])),
    ("cut to 10 m", "lie within", rows(lambda s: s[np.linalg.norm(s[:, :3], axis=1) < 10])),
    ("one point in sixty", "few for", rows(lambda s: s[::60])),
    ("without the lower beams", "no road", rows(lambda s: s[s[:, 2] > -1.0])),
    ("with the vehicle's own roof", "own body", rows(lambda s: np.concatenate(
        [s, np.array([1.3, 0.3, -0.4, 0.2]) + 0.1 * rng(1).random((len(s) // 8, 4))]))),
    *((f"a tenth of the points {v}", "not finite", rows(lambda s, v=v: np.where(np.arange(len(s))[:, None] % 10, s, v)))
      for v in (np.nan, np.inf)),
    ("float64 read as float32", "not finite|5 %|not float32", rows(lambda s: as_floats(s, "<f8"))),
    ("big-endian", "not finite|5 %|no usable", rows(lambda s: as_floats(s, ">f4"))),
    ("one scan cut off at a point", "cut off", one_scan(lambda s: s[: len(s) // 3])),
    ("one scan without 100 deg", "lacks|cut off", one_scan(lambda s: s[abs(azimuth(s) - 40) > 50])),
    ("one scan empty", "no usable|empty|holds? no|0 bytes", one_scan(lambda s: s[:0])),
    ("one scan full of NaN", "not finite", one_scan(lambda s: s * np.nan)),
    ("one file cut off in a point", "multiple of|cut off", Files(cut_in_a_point)),
    ("every second scan doubled", "same as the one before", order(lambda n: np.arange(n) // 2 * 2)),
    ("scans shuffled", ORDER, order(lambda n: rng(3).permutation(n))),
    ("scans in reverse order", ORDER, order(lambda n: np.arange(n)[::-1])),
    ("scans sorted as text", ORDER, order(lambda n: np.array(sorted(range(n), key=str)))),
    ("two halves of the drive swapped", f"{ORDER}|do not fit|does not between|belongs? to|between scans",
     order(lambda n: np.roll(np.arange(n), n // 2))),
    ("inverse poses", "inverse poses", poses(lambda T: np.array([inverse(one) for one in T]))),
    ("rotations transposed", "transposed", rotations(lambda R: np.swapaxes(R, 1, 2))),
    ("prior in camera axes", "camera axes|camera poses", poses(lambda T: CAMERA_TO_LIDAR.T @ T @ CAMERA_TO_LIDAR)),
    ("heading as a compass bearing", "compass|" + TURN, yaws(lambda a: np.pi / 2 - a)),
    ("heading from north, counter-clockwise", TURN, yaws(lambda a: a - np.pi / 2)),
    ("headings turned about", TURN, yaws(lambda a: a + np.pi)),
    *((f"headings off by {d} deg", TURN, yaws(lambda a, d=d: a + np.radians(d))) for d in (20, 6)),
    ("headings in degrees taken for radians", "rotations do not belong|" + TURN, yaws(np.degrees)),
    ("headings in radians taken for degrees", "rotations do not belong|" + TURN, yaws(np.radians)),
    ("headings missing", "rotations do not belong|" + TURN, yaws(lambda a: 0 * a)),
    ("poses pitched by 10 deg", TILT, poses(lambda T: T @ turn(pitch=10))),
    ("poses rolled by 12 deg", TILT, poses(lambda T: T @ turn(roll=12))),
    ("positions in millimetres", "millimetres", positions(lambda p: 1000 * p)),
    ("positions in centimetres", "centimetres", positions(lambda p: 100 * p)),
    ("positions in kilometres", "kilometres", positions(lambda p: p / 1000)),
    ("positions in feet", SCALE, positions(lambda p: p / 0.3048)),
    ("positions in Mercator's metres", SCALE, positions(lambda p: p * [1.53, 1.53, 1])),
    ("positions 10 % too large", SCALE, positions(lambda p: 1.1 * p)),
    ("positions 4 % too small", SCALE, positions(lambda p: 0.96 * p)),
    ("positions as longitude, latitude", "longitude, latitude", positions(degrees)),
    ("positions as latitude, longitude", "latitude, longitude", positions(lambda p: degrees(p)[:, [1, 0, 2]])),
    ("x and y of positions swapped", "x and y are swapped|" + TURN, positions(lambda p: p[:, [1, 0, 2]])),
    ("y of positions negated", "y negated|" + TURN, positions(lambda p: p * [1, -1, 1])),
    ("x of positions negated", "negated|reverse|" + TURN, positions(lambda p: p * [-1, 1, 1])),
    ("positions that scatter by 4 m", "scatter|off the scans' motion|do not belong together|jumps",
     positions(lambda p: p + rng(7).normal(0, 4.0, p.shape))),
    ("positions rounded to whole metres", "rounded to", positions(np.round)),
    ("heights that go up and down by 3 m", "off the scans' motion|pitched|do not belong|between scans",
     poses(lambda T: changed(T, slice(None), 2, 3.0 * np.sin(np.arange(len(T)) / 2.0)))),
    ("the prior frozen from the middle", "stands still|fits the scans in|repeat", poses(frozen)),
    *((f"a jump of {m} m", "jumps|between scans|fits the scans in",
       poses(lambda T, m=m: changed(T, slice(len(T) // 2, None), 0, m))) for m in (30.0, 3.0)),
    ("spikes of 25 m", "jumps", poses(lambda T: changed(T, slice(5, None, 12), 1, 25.0))),
    ("the prior does not move", "does not move|stands? still|do not belong|repeat|prior moves 0.0",
     poses(lambda T: np.tile(T[:1], (len(T), 1, 1)))),
    ("rows in reverse order", ORDER, poses(lambda T: T[::-1])),
    ("rows shuffled", "jumps|do not belong|order", poses(lambda T: T[rng(3).permutation(len(T))])),
    ("another drive's trajectory", "do not belong together|trajectory of this drive",
     poses(lambda T: np.array([exp(k * np.array([0.31, 0, 0, 0, 0, 0.06])) for k in range(len(T))]))),
    ("steps instead of poses", "counts from the one before",
     poses(lambda T: np.array([np.eye(4), *(inverse(a) @ b for a, b in pairwise(T))]))),
    ("rows 12 scans late", "late|early|s off|does not between|between scans", poses(late)),
    ("one row missing", "one line a scan|lines for", lines("prior.txt", lambda t: t[:-1])),
    ("one row not a number", "nan|number|finite", lines("prior.txt", lambda t: [*t[:4], "nan " * 12, *t[5:]])),
    ("rotations scaled", "orthonormal|rigid",
     lines("prior.txt", lambda t: [" ".join(str(2 * float(v)) for v in one.split()) for one in t])),
    ("fixes that are all at latitude 0, longitude 0", "none of its .* fixes is valid",
     pose_table("time,longitude,latitude,altitude,yaw", lambda p, q: np.zeros((len(p), 4)))),
    ("latitude and longitude of fixes swapped", "swapped|another place|lies at",
     pose_table("time,latitude,longitude,altitude,yaw", lambda p, q: np.column_stack(
         [np.add([139.0, 35.0], p[:, :2] / 1e5), p[:, 2], 0 * p[:, 0]]))),
    ("fixes in radians", "radians",
     pose_table("time,longitude,latitude,altitude,yaw", lambda p, q: np.column_stack(
         [np.radians(degrees(p)[:, :2]), p[:, 2], 0 * p[:, 0]]))),
    ("a header that names no position", "no known header|name a time, x, y, z",
     pose_table("time,a,b,c,d,e,f,g", lambda p, q: np.column_stack([p, q]))),
    ("quaternions that are none", "no unit quaternion",
     pose_table("time,x,y,z,qx,qy,qz,qw", lambda p, q: np.column_stack([p, 3.0 * q]))),
    ("quaternions in another order than the header says", "do not belong|rotations|" + TURN + "|" + UP,
     pose_table("time,x,y,z,qx,qy,qz,qw", w_first)),
    ("scans whose names count backwards", ORDER, scan_names(lambda i, n: f"{n - i:06d}")),
    ("scans whose names are random", f"{ORDER}|" + VAGUE,
     scan_names(lambda i, n: f"{int(rng(3).permutation(n)[i]):06d}")),
    ("times in milliseconds", "milliseconds", times(lambda t: 1e3 * t)),
    ("times in microseconds", "microseconds", times(lambda t: 1e6 * t)),
    ("times divided by 1000", "divided by 1000", times(lambda t: t / 1000)),
    ("times that run ten times too fast", "m/s|turns at|times", times(lambda t: t / 10)),
    ("times in reverse", "not sorted", times(lambda t: t[::-1])),
    ("times of whole seconds", "not sorted", times(np.floor)),
    ("two times alike", "not sorted", times(lambda t: np.where(np.arange(len(t)) == 9, t[8], t))),
    ("times that jitter by 40 ms", "uneven|not sorted", times(lambda t: t + rng(2).uniform(-0.04, 0.04, len(t)))),
    ("a hole of eight seconds that is none", "holes in the times",
     times(lambda t: np.where(np.arange(len(t)) > len(t) // 2, t + 8.0, t))),
    ("one time missing", "lines for|one line a scan", lines("times.txt", lambda t: t[:-1])),
    ("one time not a number", "not a time", lines("times.txt", lambda t: [*t[:3], "n/a", *t[4:]])),
    ("times of points under an unknown name", "times of points are taken from delta, s since the stamp",
     timed("delta", lambda t, _: t, bent=True)),
    ("nanoseconds of points under an unknown name", "are taken from time_offset_ns, ns since the stamp",
     timed("time_offset_ns", lambda t, _: np.rint(1e9 * t).astype("i4"), bent=True)),
    ("times of points that are a counter", "timestamp holds whole numbers one after the other",
     timed("timestamp", lambda t, _: np.arange(len(t), dtype="u4"))),
    ("times of points that are columns", "t grows by 1024 in a revolution",
     timed("t", lambda t, _: np.rint(10240 * (t + 0.05)).astype("u2"))),
    ("times of points as float32 since 1970", "time holds times since 1970 as float32",
     timed("time", lambda t, s: (1.7e9 + s + t).astype("f4"), start_ns=17 * 10**17)),
    ("times of points that last 0.69 of a revolution", "a revolution takes 0.069 s, but scans come every 0.1 s",
     timed("t", lambda t, _: 0.69 * t)),
    ("a tenth of the times of points wrong", "hold no time of this scan in the field t",
     timed("t", lambda t, _: few(t, 99.0, 0.1))),
    ("a tenth of the times of points not a number", "hold no time of this scan in the field t",
     timed("t", lambda t, _: few(t, np.nan, 0.1))),
    ("scans that are not those of their stamps", "stamps and points belong to different scans",
     timed("t", lambda t, s: 1.7e9 + (2.0 if s > 1.0 else 0.0) + s + t)),
]  # fmt: skip


TIME_MENDS: dict[str, dict[str, Any]] = {
    "times of points under an unknown name": {"time_field": "delta"},
    "nanoseconds of points under an unknown name": {"time_field": "time_offset_ns"},
    "times of points that are a counter": {"time_field": "none"},
    "times of points that are columns": {"time_field": "none"},
    "times of points as float32 since 1970": {"time_field": "none"},
    "times of points that last 0.69 of a revolution": {"time_unit": "s"},
    "a tenth of the times of points wrong": {"time_field": "none"},
    "scans that are not those of their stamps": {"time_field": "none"},
}
"""Lines that the doctor advises for drive.toml, by fault: after it the drive is sound."""


def moved(scale: float = 1.0, **pose: float) -> Change:
    """x, y, z in metres, roll, pitch, yaw in degrees, about the road below the middle of the drive."""
    shift_m = [pose.pop(axis, 0.0) for axis in "xyz"]
    T = from_xyz_rpy(*shift_m, **{axis: np.radians(v) for axis, v in pose.items()})
    T[:3, :3] *= scale
    return lambda p: p @ T[:3, :3].T + T[:3, 3]


def twice(*shift_m: float) -> Change:
    """Half of the points are there again, elsewhere and with an error of their own."""

    def change(p: F64) -> F64:
        again = p[rng(4).random(len(p)) < 0.5]
        return np.concatenate([p, again + shift_m + rng(5).normal(0, 0.03, again.shape)])

    return change


def bent(p: F64) -> F64:
    """Drift of a survey without loops: turned the more, the farther along."""
    c, s = np.cos(np.radians(0.15) * p[:, 0]), np.sin(np.radians(0.15) * p[:, 0])
    return np.column_stack([c * p[:, 0] - s * p[:, 1], s * p[:, 0] + c * p[:, 1], p[:, 2]])


def above_ground(p: F64) -> F64:
    """Without the points near the lowest of their square of 2 m."""
    _, which = np.unique(np.floor(p[:, :2] / 2.0).astype(np.int64), axis=0, return_inverse=True)
    lowest = np.full(which.max() + 1, np.inf)
    np.minimum.at(lowest, which, p[:, 2])
    return p[p[:, 2] - lowest[which] > 0.4]


MAPS: list[tuple[str, str, Change]] = [
    *((f"shifted by {np.linalg.norm(xyz):g} m", "shifted by", moved(x=xyz[0], y=xyz[1], z=xyz[2]))
      for xyz in ((0.4, 0.3, 0), (-1.2, 1.6, 0), (3, 4, 0), (0, 0, 0.8), (0, 0, 30.0), (32.0, -24.0, 0))),
    ("shifted by 300 km", "do not overlap", moved(x=3e5)),
    *((f"turned by {a} deg", TURN, moved(yaw=a)) for a in (2, 10, 90, 180)),
    *((f"pitched by {a} deg", TILT, moved(pitch=a)) for a in (3, 4)),
    *((f"scaled by {s}", SCALE, moved(s)) for s in (1.03, 0.97)),
    ("in feet", SCALE + "|feet", moved(1 / 0.3048)),
    ("in centimetres", "centimetres", moved(100.0)),
    ("in millimetres", "millimetres", moved(1000.0)),
    ("in kilometres", "kilometres", moved(0.001)),
    ("mirrored, y negated", MIRROR, lambda p: p * [1, -1, 1]),
    ("mirrored, x negated", MIRROR, lambda p: p * [-1, 1, 1]),
    ("x and y swapped", MIRROR + "|swapped", lambda p: p[:, [1, 0, 2]]),
    ("upside down, turned over", UP, lambda p: p * [1, -1, -1]),
    ("upside down, z negated", UP, lambda p: p * [1, 1, -1]),
    ("y up", r"axis \+y points up", lambda p: p[:, [0, 2, 1]] * [1, 1, -1]),
    *((f"twice, {np.linalg.norm(xyz):.1f} m apart", TWICE, twice(*xyz))
      for xyz in ((2.0, 1.0, 0), (0.4, -1.1, 0), (0, 0.6, 0), (0.35, 0.49, 0), (0, 0, 0.5))),
    ("half of it missing", "holds nothing around", lambda p: p[p[:, 0] * 0.9 + p[:, 1] * 0.43 > 0]),
    ("without its ground", "ground", above_ground),
    ("points that scatter by 0.25 m", "thick|scatter", lambda p: p + rng(2).normal(0, 0.25, p.shape)),
    ("heights that wave by 1.5 m", "thick|height|bent|only|nowhere|above the map|" + TILT,
     lambda p: p + np.column_stack([0 * p[:, 0], 0 * p[:, 0], 1.5 * np.sin(p[:, 0] / 12.0)])),
    ("bent", "bent|only|nowhere", bent),
    ("rounded to 0.5 m", "rounded to 0.5 m", lambda p: np.round(2 * p) / 2),
    ("one point in a hundred", "apart", lambda p: p[::100]),
    ("with strays", "far off all others", lambda p: np.concatenate([p, rng(3).uniform(-9e4, 9e4, (50, 3))])),
    ("5 % outliers 200 m up", "m above the ground|far off",
     lambda p: p + (rng(3).random(len(p)) < 0.05)[:, None] * [0, 0, 200.0]),
    ("flat", "flat", lambda p: p * [1, 1, 0]),
    ("joined with itself", TWICE, lambda p: np.concatenate([p, p])),
]  # fmt: skip


def counted_as(points: int) -> Callable[[bytes], bytes]:
    """A LAS file whose header counts so many points: 107 (to 1.3), 247 (1.4)."""

    def change(data: bytes) -> bytes:
        out = bytearray(data)
        out[247:255] = struct.pack("<Q", points)
        return bytes(out)

    return change


def in_header(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    return lambda data: data.replace(old, new, 1)


Bytes = Callable[[bytes], bytes]
FEWER, MORE = "counts 3000 points, but data for 1000 more", "cut off|not a whole"
# name, suffix, what names it rightly, what is done to the bytes of a file of 4,000 points, and what the mend does
MAP_FILES: list[tuple[str, str, str, Bytes, Bytes]] = [
    ("LAS header counts too few", ".las", FEWER, counted_as(3000), counted_as(4000)),
    ("LAZ header counts too few", ".laz", FEWER, counted_as(3000), counted_as(4000)),
    ("LAS header counts too many", ".las", MORE, counted_as(5000), counted_as(4000)),
    ("LAZ header counts too many", ".laz", "cut off: 4000 points", counted_as(5000), counted_as(4000)),
    ("PLY header counts too few", ".ply", "data follow the elements that its header counts .3000 vertex",
     in_header(b"vertex 4000", b"vertex 3000"), in_header(b"vertex 3000", b"vertex 4000")),
    ("PCD header counts too few", ".pcd", "says 3000 points, but data for 1000 more follow",
     lambda data: data.replace(b"4000", b"3000", 2), lambda data: data.replace(b"3000", b"4000", 2)),
    ("PCD WIDTH is wrong", ".pcd", ":10: POINTS .* WIDTH 3000 times HEIGHT 1 is not POINTS 4000",
     in_header(b"WIDTH 4000", b"WIDTH 3000"), in_header(b"WIDTH 3000", b"WIDTH 4000")),
    ("PCD has a word too few", ".pcd", ":5: TYPE .* one for each of the 3 FIELDS",
     in_header(b"TYPE F F F", b"TYPE F F"), in_header(b"TYPE F F", b"TYPE F F F")),
    ("PCD without DATA", ".pcd", "no line DATA",
     in_header(b"DATA binary\n", b""), in_header(b"POINTS 4000\n", b"POINTS 4000\nDATA binary\n")),
    ("PCD in an unknown encoding", ".pcd", ":11: DATA .* is no encoding; write ascii",
     in_header(b"binary\n", b"base64\n"), in_header(b"base64\n", b"binary\n")),
]  # fmt: skip
TWO_AT_ONCE = {
    "drives": [
        ("points upside down, turned over", "positions 10 % too large"),
        ("points turned by 30 deg", "positions 10 % too large"),
        ("points in millimetres", "inverse poses"),
        ("headings off by 20 deg", "positions in feet"),
        ("inverse poses", "times in milliseconds"),
        ("one scan empty", "rotations transposed"),
    ],
    "maps": [
        ("twice, 0.6 m apart", "pitched by 3 deg"),
        ("twice, 0.6 m apart", "scaled by 1.03"),
        ("pitched by 3 deg", "scaled by 1.03"),
        ("shifted by 5 m", "turned by 10 deg"),
    ],
}


def both(first: Callable[[Any], Any], second: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda sound: second(first(sound))


def kinds_of(what: str) -> dict[str, tuple[list[str], Any]]:
    """By name (patterns that name each fault, what is done): as it is, one fault, two joined by " + "."""
    table: dict[str, tuple[str, Any]] = {
        name: (right, change) for name, right, change in (DRIVES if what == "drives" else MAPS)
    }
    out: dict[str, tuple[list[str], Any]] = {"as it is": ([], lambda sound: sound)}
    out |= {name: ([right], change) for name, (right, change) in table.items()}
    for a, b in TWO_AT_ONCE[what]:
        out[f"{a} + {b}"] = [table[a][0], table[b][0]], both(table[a][1], table[b][1])
    return out


def broken(sound: Recording, change: Break | Files, folder: Path) -> Path:
    """The drive folder, written with what is wrong with it."""
    (sound if isinstance(change, Files) else change(sound)).write(folder)
    if isinstance(change, Files):
        change.edit(folder)
    return folder


def verdict(rights: list[str], found: Iterable[Finding]) -> str:
    """Verdict on faults that the patterns ``rights`` name. "right": an error or a warning names each; "open": a note
    says that it cannot be decided; "part": one of two is named; "vague": something is wrong but not what; "wrong": an
    error names something else; "sound"."""
    found = list(found)
    named = [any(re.search(right, what) for what in serious(found)) for right in rights]
    if named and all(named):
        return "right"
    if any(named):
        return "part"
    if not serious(found):
        return "open" if any(re.search(right, f.what) for right in rights for f in found) else "sound"
    errors = [f.what for f in found if f.severity == "error"]
    return "wrong" if any(not re.search(VAGUE, what) for what in errors) else "vague"
