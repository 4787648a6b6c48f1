"""What times and prior show by themselves, and the ways in which poses or axes of a drive get read wrongly.

By themselves: units, holes, jumps, rows that stand still, tilts. A reading is a rule that turns the prior's poses
T_map_lidar (n, 4, 4) into poses whose motions, from scan to scan, are the ones that the scans show if that is what is
wrong. Whatever frame the poses stand in cancels out; so do scans that were turned or mirrored by C, whose motions are
C M C^-1: T C^-1 moves so.

Numbers that make prior and scans agree are a scale, a turn between them, a shift in time, each with its error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from mapvote.core import geometry
from mapvote.core.types import F64, I64, Bool, Drive
from mapvote.doctor.finding import Finding
from mapvote.doctor.motion import Run

_FASTEST_MPS = 70.0
NO_PRIOR = Finding(
    "warning",
    "no prior: the vehicle must find itself in the map",
    "write prior.txt (3 x 4 rows T_map_lidar), or be ready to give the first pose",
)
CAMERA_TO_LIDAR = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From x right, y down, z forward to x forward, y left, z up."""
_DEGREE_M = 111_320.0


def check_times(drive: Drive) -> list[Finding]:
    if len(drive) < 3:
        return [Finding("warning", f"only {len(drive)} scans", "a vote needs many scans of a place")]
    step_s = np.diff(drive.stamps_ns) * 1e-9
    median_s = float(np.median(step_s))
    for factor, unit in ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")):
        if median_s > 5.0 and 0.02 <= median_s / factor <= 2.0:
            what = f"scans are {median_s:g} s apart: the times are {unit}, not seconds"
            return [Finding("error", what, "convert times.txt")]
        if median_s < 0.01 and 0.02 <= median_s * factor <= 2.0:
            what = f"scans are {median_s:g} s apart: the times were divided by {factor:g}"
            return [Finding("error", what, "convert times.txt")]
    found = []
    expected_s = 1.0 / drive.sensor.rate_hz
    if not 0.8 < median_s / expected_s < 1.25:
        what = f"scans are {median_s:.3f} s apart, but a {drive.sensor.name} turns at {drive.sensor.rate_hz:g} Hz"
        mend = "if scans were left out, all is well; else times or rate_hz (drive.toml) are wrong"
        found.append(Finding("warning", what, mend))
    holes = int((step_s > 1.8 * median_s).sum())
    if holes:
        at = int(np.argmax(step_s))
        what = f"{holes} holes in the times, the longest {step_s[at]:.2f} s after scan {at}"
        grave = step_s[at] > 5.0 * median_s
        found.append(Finding("warning" if grave else "note", what, "chosen with --scans, or lost while recording?"))
    uneven = float(np.median(np.abs(step_s - median_s))) / median_s
    if uneven > 0.1:
        what = f"the times are uneven: half of the steps are more than {uneven:.0%} off {median_s:.3f} s"
        found.append(Finding("warning", what, "are they times of arrival? Take the sensor's own stamps"))
    return found


def check_prior(drive: Drive) -> list[Finding]:
    T = drive.T_map_lidar_prior
    if T is None:
        return [NO_PRIOR]
    if len(T) < 2:
        return []
    steps_m = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    return _motion(drive, T, steps_m) + _attitude(T)


def _motion(drive: Drive, T: F64, steps_m: F64) -> list[Finding]:
    found = []
    if steps_m.sum() < 0.5:
        what = f"the prior does not move ({steps_m.sum():.2f} m in {len(T)} scans)"
        return [Finding("warning", what, "if the vehicle did, the file is not its trajectory; else all is well")]
    speed = steps_m / (np.diff(drive.stamps_ns) * 1e-9)
    usual = float(np.median(steps_m))
    if np.median(speed) > _FASTEST_MPS:
        what = f"the prior moves at {np.median(speed):.0f} m/s"
        found.append(Finding("error", what, "check the unit of its positions (metres) and of the times (seconds)"))
    jumps = np.flatnonzero(steps_m > 5 * usual + 1.0)
    if len(jumps) and len(jumps) < 0.2 * len(steps_m) and usual > 0:
        what = f"the prior jumps {len(jumps)} times, most at scan {int(np.argmax(steps_m)) + 1} ({steps_m.max():.1f} m)"
        # No error: a map fits all its priors, and a vehicle localises in the map; both reject outliers.
        found.append(Finding("warning", what, "GNSS outliers: smooth them, or give prior_sigma_m in drive.toml"))
    stuck = steps_m < 1e-6
    if 3 <= stuck.sum() < len(steps_m) and usual > 0.05:
        longest = _longest(stuck)
        what = f"the prior stands still for {longest} rows, at full speed before or after"
        found.append(Finding("warning", what, "was it held while GNSS or the filter was away? Leave those rows out"))
    elif usual <= 1e-6 < steps_m.sum() and stuck.sum() > 0.4 * len(stuck):
        what = f"{stuck.mean():.0%} of the prior's rows repeat the one before"
        found.append(Finding("warning", what, "it is slower than the scans, or was held: interpolate it"))
    values = np.abs(T[:, :2, 3] - T[0, :2, 3])
    for quantum in (1.0, 0.5, 0.25, 0.1):
        whole = np.abs(values / quantum - np.round(values / quantum)) < 1e-3
        if steps_m.sum() > 5.0 and whole.mean() > 0.95:
            what = f"the prior's positions are rounded to {quantum:g} m"
            found.append(Finding("warning", what, "float32 of large coordinates? Write double"))
            break
    return found


def _longest(flags: Bool) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return int((edges[1::2] - edges[::2]).max()) + 1


def _attitude(T: F64) -> list[Finding]:
    found = []
    tilt_deg = float(np.median(np.rad2deg(np.arccos(np.clip(T[:, 2, 2], -1, 1)))))
    if tilt_deg > 30:
        what = f"the prior tilts the sensor by {tilt_deg:.0f} deg"
        found.append(Finding("warning", what, "fine for a sensor mounted so; else its axes are not x forward, z up"))
    return found


def drift_angle_deg(T: F64) -> float:
    """By how much the headings told differ from the course of the positions, median, degrees counter-clockwise."""
    apart = heading(T) - course(T)
    return float(np.degrees(np.arctan2(np.median(np.sin(apart)), np.median(np.cos(apart)))))


@dataclass(frozen=True, slots=True)
class Reading:
    """What may be wrong, and how to mend it."""

    name: str
    mend: str
    poses: Callable[[F64], F64]
    told_by: str = "prior"
    """Which side is wrong: "prior", "scans", or "order"."""
    catch_all: bool = False
    """Fits much that is wrong otherwise: named only where nothing more special fits."""
    angle: bool = False
    """Tells by how many degrees something is turned: a straight drive shows many a mistake as that."""


def scaled(factor: float) -> Callable[[F64], F64]:
    def read(T: F64) -> F64:
        out = T.copy()
        out[:, :3, 3] *= factor
        return out

    return read


def turned(*, yaw_deg: float) -> Callable[[F64], F64]:
    C = geometry.from_xyz_rpy(0, 0, 0, yaw=np.radians(yaw_deg))
    return lambda T: np.asarray(T @ C)


def _flipped(x: float, y: float) -> Callable[[F64], F64]:
    C = np.diag([x, y, 1.0, 1.0])
    return lambda T: np.asarray(T @ C)


def _inverse(T: F64) -> F64:
    return np.array([geometry.inverse(one) for one in T])


def _transposed(T: F64) -> F64:
    out = T.copy()
    out[:, :3, :3] = np.swapaxes(T[:, :3, :3], 1, 2)
    return out


def _headed(T: F64, yaw: F64) -> F64:
    out = np.tile(np.eye(4), (len(T), 1, 1))
    c, s = np.cos(yaw), np.sin(yaw)
    out[:, 0, 0], out[:, 0, 1], out[:, 1, 0], out[:, 1, 1] = c, -s, s, c
    out[:, :3, 3] = T[:, :3, 3]
    return out


def heading(T: F64) -> F64:
    """(n,) yaw of poses, radians."""
    yaw: F64 = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    return yaw


def course(T: F64) -> F64:
    """(n,) direction in which the positions move, over a metre or so on either side, radians."""
    p = T[:, :2, 3]
    step = np.median(np.linalg.norm(np.diff(p, axis=0), axis=1)) if len(p) > 1 else 0.0
    k = int(np.clip(np.ceil(1.5 / max(float(step), 0.01)), 1, max(1, len(p) // 4)))
    last, first = np.minimum(np.arange(len(p)) + k, len(p) - 1), np.maximum(np.arange(len(p)) - k, 0)
    way = p[last] - p[first]
    return np.asarray(np.arctan2(way[:, 1], way[:, 0]))


def _from_deltas(T: F64) -> F64:
    out = [np.eye(4)]
    for one in T[1:]:
        out.append(out[-1] @ one)
    return np.array(out)


def _degrees(first: int) -> Callable[[F64], F64]:
    """Positions as longitude and latitude in degrees; ``first``: column of the longitude."""

    def read(T: F64) -> F64:
        out = T.copy()
        longitude, latitude = T[:, first, 3], T[:, 1 - first, 3]
        out[:, 0, 3] = longitude * _DEGREE_M * np.cos(np.radians(np.clip(latitude[0], -89, 89)))
        out[:, 1, 3] = latitude * _DEGREE_M
        return out

    return read


def _mirrored_positions(T: F64) -> F64:
    out = T.copy()
    out[:, 1, 3] *= -1.0
    return out


def _swapped_positions(T: F64) -> F64:
    out = T.copy()
    out[:, :2, 3] = T[:, 1::-1, 3]
    return out


def _in_map_axes(T: F64) -> F64:
    out = np.tile(np.eye(4), (len(T), 1, 1))
    out[:, :3, 3] = T[:, :3, 3]
    return out


def _quarter_turns(yaw_deg: int) -> tuple[Reading, Reading]:
    """What custom confuses, of the scans and of the prior: both move the same way."""
    rule = turned(yaw_deg=-yaw_deg)
    scans = {
        90: "the scans are turned by 90 deg about z (x right, y forward)",
        -90: "the scans are turned by -90 deg about z (x left, y to the rear)",
        180: "the scans face backwards (x to the rear): they are turned by 180 deg about z",
    }
    prior = f"the prior's headings are off by {yaw_deg} deg, counter-clockwise"
    return (
        Reading(scans[yaw_deg], "turn the points, or T_base_lidar, so that x is forward", rule, "scans", angle=True),
        Reading(prior, f"turn its rotations by {-yaw_deg} deg about z", rule, angle=True),
    )


AS_IT_IS = Reading("as it is", "", lambda T: T)
READINGS = (
    Reading("the prior holds inverse poses (T_lidar_map)", "write T_map_lidar, the inverse of each matrix", _inverse),
    Reading(
        "the prior is in camera axes (x right, y down, z forward)",
        "put KITTI's calib.txt into the drive, or write T_map_lidar",
        lambda T: np.asarray(CAMERA_TO_LIDAR @ T @ CAMERA_TO_LIDAR.T),
    ),
    Reading(
        "the prior's rotations are transposed (or its angles clockwise)", "transpose the 3 x 3 rotations", _transposed
    ),
    Reading(
        "the prior's heading is a compass bearing (0 north, clockwise)",
        "use yaw = 90 deg - bearing",
        lambda T: _headed(T, np.pi / 2 - heading(T)),
    ),
    Reading("the prior's positions are in millimetres", "divide its positions by 1000", scaled(1e-3)),
    Reading("the prior's positions are in centimetres", "divide its positions by 100", scaled(1e-2)),
    Reading("the prior's positions are in kilometres", "multiply its positions by 1000", scaled(1e3)),
    Reading("the prior's positions are degrees (longitude, latitude)", "project them to metres", _degrees(0)),
    Reading("the prior's positions are degrees (latitude, longitude)", "project them to metres", _degrees(1)),
    Reading("the prior's x and y are swapped", "swap the first two coordinates", _swapped_positions),
    Reading("the prior's track is mirrored (y negated)", "negate y of its positions", _mirrored_positions),
    Reading(
        "each pose of the prior counts from the one before (odometry steps)",
        "chain them: T_map_lidar of a scan is the product of all steps up to it",
        _from_deltas,
    ),
    Reading("the scans, or the prior's rows, are in reverse order", "reverse one of them", lambda T: T[::-1], "order"),
    Reading(
        "the scans are left-handed (y to the right)", "negate y of every point", _flipped(1.0, -1.0), told_by="scans"
    ),
    Reading("the scans are mirrored (x negated)", "negate x of every point", _flipped(-1.0, 1.0), told_by="scans"),
    Reading(
        "x and y of the scans are swapped",
        "swap x and y of every point",
        lambda T: np.asarray(T @ np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])),
        told_by="scans",
    ),
    *(reading for yaw_deg in (90, -90, 180) for reading in _quarter_turns(yaw_deg)),
    Reading(
        "the scans are turned into the map's axes already, about the sensor",
        "turn the points back by the prior's rotation, or give poses without rotation",
        _in_map_axes,
        told_by="scans",
    ),
    Reading(
        "the prior's rotations do not belong to its positions (missing, or angles in the wrong unit)",
        "check its angles: radians or degrees, which is yaw, which way they count",
        lambda T: _headed(T, course(T)),
        catch_all=True,
    ),
)
"""Every one but the right one, and what a number tells: scale, turn, time (:mod:`mapvote.doctor.measured`)."""


LEVER_M = 10.0
"""A rotation counts as what it moves at this distance."""
_TIME_S = 3.0
"""Shifts in time are looked for so far, and over a quarter of the drive: beyond, little is left to compare."""
LEAST = {"scale": 0.02, "turn": 2.0, "pitch": 2.0, "time": 0.15}
"""Share, degrees, degrees, seconds. Less is not complained of: priors err so much by themselves."""
SURE, LIKELY = 4.0, 2.0
"""Standard errors: what is more than so many is an error, and may be one."""
_SURE_OF_TIME = 5.0


@dataclass(frozen=True, slots=True)
class Measured:
    """One number, fitted."""

    kind: str
    """ "scale", "turn", "pitch" or "time"."""
    value: float
    """Factor that the prior's positions are too large by; degrees; seconds."""
    sigma: float
    poses: Callable[[F64], F64]
    """The prior mended."""

    @property
    def off(self) -> tuple[float, float]:
        """(by how much, its standard error), of a scale as a share."""
        if self.kind == "scale":
            return abs(float(np.log(self.value))), self.sigma / self.value
        return abs(self.value), self.sigma

    @property
    def least(self) -> float:
        """What the drive can surely show."""
        return max(LEAST[self.kind], (_SURE_OF_TIME if self.kind == "time" else SURE) * self.off[1])

    @property
    def words(self) -> tuple[str, str]:
        """(what, how to mend it)."""
        if self.kind == "scale":
            what = f"prior and scans differ in scale: the prior is {self.value:.3f} times as large (+-{self.sigma:.3f})"
            return what, "compare with a known length: a projection's scale (Mercator), feet, the sensor's calibration"
        if self.kind == "time":
            side = "late" if self.value > 0 else "early"
            return (
                f"the prior is {abs(self.value):.2f} s {side} (+-{self.sigma:.2f})",
                "shift its times against the scans",
            )
        if self.kind == "pitch":
            what = f"the scans are pitched by {self.value:.1f} deg (+-{self.sigma:.1f}) against the prior's motion"
            return what, "level the points, or put the sensor's pitch into T_base_lidar and the prior's rotations"
        what = f"headings and scans are turned against each other by {self.value:.1f} deg (+-{self.sigma:.1f})"
        return what, "mend the yaw of T_base_lidar, or of the prior"


def residuals(T: F64, runs: Sequence[Run]) -> F64:
    """(2 * runs, 6) position (m) and rotation (rad) by which the motion told by poses T (n, 4, 4) differs from the one
    seen, at the middle and at the end of every run, in the frame of its first scan."""
    out = []
    for run in runs:
        for k in (len(run.indices) // 2, len(run.indices) - 1):
            told, seen = geometry.inverse(T[run.indices[0]]) @ T[run.indices[k]], run.T_first_lidar[k]
            apart = geometry.inverse(seen) @ told
            if np.linalg.det(apart[:3, :3]) < 0:
                out.append(np.array([*apart[:3, 3], np.pi, np.pi, np.pi]))
            else:
                out.append(np.concatenate([told[:3, 3] - seen[:3, 3], geometry.log(apart)[3:]]))
    return np.array(out)


def misfits(T: F64, runs: Sequence[Run]) -> F64:
    """(runs,) metres by which the motion of each run differs, a rotation by what it moves 10 m away."""
    r = residuals(T, runs)
    each = np.linalg.norm(r[:, :3], axis=1) + LEVER_M * np.linalg.norm(r[:, 3:], axis=1)
    return np.asarray(each.reshape(-1, 2).mean(axis=1))


def at_times(T: F64, stamps_ns: I64, shift_s: float) -> F64:
    """The poses (n, 4, 4) told for ``shift_s`` later than each stamp; held at the ends."""
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    wanted = np.clip(seconds + shift_s, seconds[0], seconds[-1])
    out = np.tile(np.eye(4), (len(T), 1, 1))
    rotations = scipy.spatial.transform.Rotation.from_matrix(T[:, :3, :3])
    out[:, :3, :3] = scipy.spatial.transform.Slerp(seconds, rotations)(wanted).as_matrix()
    for axis in range(3):
        out[:, axis, 3] = np.interp(wanted, seconds, T[:, axis, 3])
    return out


def _fit_rule(
    rule: Callable[[F64], Callable[[F64], F64]], starts: list[F64], T: F64, runs: Sequence[Run]
) -> tuple[F64, F64]:
    """(parameters (p,) of ``rule`` that fit the runs best, their standard errors (p,)): robust, from several starts."""
    weights = np.array([1.0, 1.0, 1.0, LEVER_M, LEVER_M, LEVER_M])

    def off(parameters: F64) -> F64:
        return np.asarray((residuals(rule(parameters)(T), runs) * weights).ravel())

    costs = [float(np.abs(off(start)).sum()) for start in starts]
    best = starts[int(np.argmin(costs))]
    found = scipy.optimize.least_squares(off, best, loss="soft_l1", f_scale=0.3, max_nfev=30)
    spread = 1.4826 * float(np.median(np.abs(found.fun))) + 0.02
    # Neighbouring numbers of a run err alike: two of every three are taken to say nothing new.
    covariance = np.linalg.pinv(found.jac.T @ found.jac) * 3.0 * spread**2
    return np.asarray(found.x), np.sqrt(np.maximum(np.diag(covariance), 0.0))


def measure_scale(T: F64, runs: Sequence[Run]) -> Measured:
    """By which factor the prior's positions are too large."""
    told_m = sum(float(np.linalg.norm(T[r.indices[-1], :3, 3] - T[r.indices[0], :3, 3])) for r in runs)
    seen_m = sum(float(np.linalg.norm(r.end[:3, 3])) for r in runs)
    start = np.log(max(seen_m, 1e-3) / max(told_m, 1e-6))
    x, sigma = _fit_rule(lambda p: scaled(float(np.exp(p[0]))), [np.array([start]), np.zeros(1)], T, runs)
    factor = float(np.exp(-x[0]))
    return Measured("scale", factor, factor * float(sigma[0]), scaled(1.0 / factor))


def measure_turn(T: F64, runs: Sequence[Run]) -> tuple[Measured, Measured]:
    """(yaw, pitch) by which the headings told are turned against the scans: degrees, counter-clockwise; nose up.

    Roll hardly shows in a motion; it is left to the road.
    """

    def rule(p: F64) -> Callable[[F64], F64]:
        C = geometry.from_xyz_rpy(0, 0, 0, pitch=float(p[1]), yaw=float(p[0]))
        return lambda T: np.asarray(T @ C)

    starts = [np.array([yaw, 0.0]) for yaw in np.radians(np.arange(-180, 180, 30))]
    x, sigma = _fit_rule(rule, starts, T, runs)
    yaw, pitch = np.degrees((x + np.pi) % (2 * np.pi) - np.pi)
    yaw_sigma, pitch_sigma = np.degrees(sigma)
    turn = Measured("turn", -float(yaw), float(yaw_sigma), rule(x))
    return turn, Measured("pitch", float(pitch), float(pitch_sigma), rule(x))


def measure_time(T: F64, runs: Sequence[Run], stamps_ns: I64) -> Measured | None:
    """How much later than the scans the prior's times are; None if no shift that the drive can show fits."""
    most_s = min(_TIME_S, (stamps_ns[-1] - stamps_ns[0]) * 1e-9 / 4.0)

    def rule(p: F64) -> Callable[[F64], F64]:
        return lambda T: at_times(T, stamps_ns, float(p[0]))

    starts = [np.array([s]) for s in np.arange(-most_s, most_s + 0.01, min(0.2, most_s))]
    x, sigma = _fit_rule(rule, starts, T, runs)
    return None if abs(x[0]) >= most_s else Measured("time", float(x[0]), float(sigma[0]), rule(x))
