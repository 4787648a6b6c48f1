"""The ways in which poses or axes of a drive get read wrongly, and numbers that make prior and scans agree.

A reading is a rule that turns the prior's poses T_map_lidar (n, 4, 4) into poses whose motions, from scan to scan, are
the ones that the scans show if that is what is wrong. Whatever frame the poses stand in cancels out; so do scans that
were turned or mirrored by C, whose motions are C M C^-1: T C^-1 moves so. Numbers are a scale, a turn between prior and
scans, a shift in time, each with its error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from mapvote.core.geometry import from_xyz_rpy, inverse, inverses, log, poses_at
from mapvote.core.record import record
from mapvote.core.types import F64, I64
from mapvote.doctor import Reading, Rule
from mapvote.doctor.drive_evidence import Run

CAMERA_TO_LIDAR = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From x right, y down, z forward to x forward, y left, z up."""


@record()
@dataclass(frozen=True, slots=True)
class PriorCheck:
    """Numbers of the comparison of a prior with the motion that scans show."""

    degree_m: float = 111_320.0
    """Length of a degree of latitude, metres."""
    lever_m: float = 10.0
    """Distance at which a rotation counts as a shift, metres."""
    time_s: float = 3.0
    """Largest shift in time that is searched, seconds, within a quarter of the drive: beyond, little is left to
    compare."""
    sure: float = 4.0
    """Standard errors from which a deviation is an error."""
    likely: float = 2.0
    """Standard errors from which a deviation may be an error."""
    sure_of_time: float = 5.0
    """Standard errors from which a shift in time is an error."""
    least_scale: float = 0.02
    """Deviation of the scale up to which nothing is reported, as a share: priors err so much by themselves."""
    least_turn_deg: float = 2.0
    """Deviation of a turn or a pitch up to which nothing is reported, degrees."""
    least_time_s: float = 0.15
    """Shift in time up to which nothing is reported, seconds."""

    def least_of(self, kind: str) -> float:
        """Deviation of this kind ("scale", "turn", "pitch" or "time") up to which nothing is reported."""
        return {"scale": self.least_scale, "time": self.least_time_s}.get(kind, self.least_turn_deg)


PRIOR_CHECK = PriorCheck()
X_FORWARD = "turn the points, or T_base_lidar, so that x is forward"


def scaled(factor: float) -> Rule:
    """Positions so many times as large."""
    return _moved(lambda p: factor * p)


def turned(C: F64) -> Rule:
    """Sensors turned by C (4, 4), in their own frame."""
    return lambda T: np.asarray(T @ C)


def _moved(of_positions: Callable[[F64], F64]) -> Rule:
    """Positions (n, 3) elsewhere."""
    return lambda T: poses_at(of_positions(T[:, :3, 3]), T[:, :3, :3])


def _headed(T: F64, yaw: F64) -> F64:
    """The same positions, level, with these headings (n,)."""
    c = np.cos(yaw)
    s = np.sin(yaw)
    zero = np.zeros(len(yaw))
    rotations = np.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1.0]])
    return poses_at(T[:, :3, 3], rotations.transpose(2, 0, 1))


def _heading(T: F64) -> F64:
    """(n,) yaw of poses, radians."""
    return np.asarray(np.arctan2(T[:, 1, 0], T[:, 0, 0]))


def _course(T: F64) -> F64:
    """(n,) direction in which the positions move, over a metre or so on either side, radians."""
    p = T[:, :2, 3]
    step = np.median(np.linalg.norm(np.diff(p, axis=0), axis=1)) if len(p) > 1 else 0.0
    k = int(np.clip(np.ceil(1.5 / max(float(step), 0.01)), 1, max(1, len(p) // 4)))
    last = np.minimum(np.arange(len(p)) + k, len(p) - 1)
    first = np.maximum(np.arange(len(p)) - k, 0)
    way = p[last] - p[first]
    return np.asarray(np.arctan2(way[:, 1], way[:, 0]))


def median_angle_deg(angles: F64) -> float:
    """Mean of angles (n,) in radians, by their sines and cosines."""
    return float(np.degrees(np.arctan2(np.median(np.sin(angles)), np.median(np.cos(angles)))))


def drift_angle_deg(T: F64) -> float:
    """By how much the headings differ from the course of the positions, median, degrees counter-clockwise."""
    return median_angle_deg(_heading(T) - _course(T))


def _from_steps(T: F64) -> F64:
    out = [np.eye(4)]
    for one in T[1:]:
        out.append(out[-1] @ one)
    return np.array(out)


def _from_degrees(first: int) -> Rule:
    """Positions as longitude and latitude in degrees; ``first``: column of the longitude."""

    def metres(p: F64) -> F64:
        longitude = p[:, first]
        latitude = p[:, 1 - first]
        east = longitude * PRIOR_CHECK.degree_m * np.cos(np.radians(np.clip(latitude[0], -89, 89)))
        return np.column_stack([east, latitude * PRIOR_CHECK.degree_m, p[:, 2]])

    return _moved(metres)


def _quarter_turns(yaw_deg: int) -> tuple[Reading, Reading]:
    """Axes that are commonly confused, of the scans and of the prior: both move the same way."""
    rule = turned(from_xyz_rpy(0, 0, 0, yaw=np.radians(-yaw_deg)))
    scans = {
        90: "the scans are turned by 90 deg about z (x right, y forward)",
        -90: "the scans are turned by -90 deg about z (x left, y to the rear)",
        180: "the scans face backwards (x to the rear): they are turned by 180 deg about z",
    }
    prior = f"the prior's headings are off by {yaw_deg} deg, counter-clockwise"
    return (
        Reading(scans[yaw_deg], X_FORWARD, rule, "scans", angle=True),
        Reading(prior, f"turn its rotations by {-yaw_deg} deg about z", rule, angle=True),
    )


AS_IT_IS = Reading("as it is", "", lambda T: T)
READINGS = (
    Reading("the prior holds inverse poses (T_lidar_map)", "write T_map_lidar, the inverse of each matrix", inverses),
    Reading(
        "the prior is in camera axes (x right, y down, z forward)",
        "put KITTI's calib.txt into the drive, or write T_map_lidar",
        lambda T: np.asarray(CAMERA_TO_LIDAR @ T @ CAMERA_TO_LIDAR.T),
    ),
    Reading(
        "the prior's rotations are transposed (or its angles clockwise)",
        "transpose the 3 x 3 rotations",
        lambda T: poses_at(T[:, :3, 3], np.swapaxes(T[:, :3, :3], 1, 2)),
    ),
    Reading(
        "the prior's heading is a compass bearing (0 north, clockwise)",
        "use yaw = 90 deg - bearing",
        lambda T: _headed(T, np.pi / 2 - _heading(T)),
    ),
    Reading("the prior's positions are in millimetres", "divide its positions by 1000", scaled(1e-3)),
    Reading("the prior's positions are in centimetres", "divide its positions by 100", scaled(1e-2)),
    Reading("the prior's positions are in kilometres", "multiply its positions by 1000", scaled(1e3)),
    Reading("the prior's positions are degrees (longitude, latitude)", "project them to metres", _from_degrees(0)),
    Reading("the prior's positions are degrees (latitude, longitude)", "project them to metres", _from_degrees(1)),
    Reading("the prior's x and y are swapped", "swap the first two coordinates", _moved(lambda p: p[:, [1, 0, 2]])),
    Reading(
        "the prior's track is mirrored (y negated)", "negate y of its positions", _moved(lambda p: p * [1.0, -1.0, 1.0])
    ),
    Reading(
        "each pose of the prior counts from the one before (odometry steps)",
        "chain them: T_map_lidar of a scan is the product of all steps up to it",
        _from_steps,
    ),
    Reading("the scans, or the prior's rows, are in reverse order", "reverse one of them", lambda T: T[::-1], "order"),
    Reading(
        "the scans are left-handed (y to the right)",
        "negate y of every point",
        turned(np.diag([1.0, -1.0, 1.0, 1.0])),
        told_by="scans",
        left_handed=True,
    ),
    Reading(
        "the scans are mirrored (x negated)", "negate x of every point", turned(np.diag([-1.0, 1.0, 1.0, 1.0])), "scans"
    ),
    Reading(
        "x and y of the scans are swapped", "swap x and y of every point", turned(np.eye(4)[[1, 0, 2, 3]]), "scans"
    ),
    *(reading for yaw_deg in (90, -90, 180) for reading in _quarter_turns(yaw_deg)),
    Reading(
        "the scans are turned into the map's axes already, about the sensor (on a road along x: or the prior's "
        "rotations do not belong to its positions)",
        "turn the points back by the prior's rotation, or give poses without rotation",
        lambda T: _headed(T, np.zeros(len(T))),
        told_by="scans",
    ),
    Reading(
        "the prior's rotations do not belong to its positions (missing, or angles in the wrong unit)",
        "check its angles: radians or degrees, which is yaw, which way they count",
        lambda T: _headed(T, _course(T)),
        catch_all=True,
    ),
)
"""Every one but the right one, and what a :class:`Number` says."""


@dataclass(frozen=True, slots=True)
class Number:
    """One number by which prior and scans differ, fitted."""

    kind: str
    """ "scale", "turn", "pitch" or "time"."""
    value: float
    """Factor that the prior's positions are too large by; degrees; seconds."""
    sigma: float
    poses: Rule
    """The prior mended."""

    @property
    def off(self) -> tuple[float, float]:
        """(by how much, its standard error), of a scale as a share."""
        if self.kind == "scale":
            return abs(float(np.log(self.value))), self.sigma / self.value
        return abs(self.value), self.sigma

    @property
    def least(self) -> float:
        """Deviations that the drive can surely show."""
        sure = PRIOR_CHECK.sure_of_time if self.kind == "time" else PRIOR_CHECK.sure
        return max(PRIOR_CHECK.least_of(self.kind), sure * self.off[1])

    @property
    def words(self) -> tuple[str, str]:
        """(what, how to mend it)."""
        by = f"by {self.value:.1f} deg (+-{self.sigma:.1f})"
        return {
            "scale": (
                f"prior and scans differ in scale: the prior is {self.value:.3f} times as large (+-{self.sigma:.3f})",
                "compare with a known length: a projection's scale (Mercator), feet, the sensor's calibration",
            ),
            "time": (
                f"the prior is {abs(self.value):.2f} s {'late' if self.value > 0 else 'early'} (+-{self.sigma:.2f})",
                "shift its times against the scans",
            ),
            "pitch": (
                f"the scans are pitched {by}, nose up, against the prior's motion",
                "level the points, or put the sensor's pitch into T_base_lidar and the prior's rotations",
            ),
            "turn": (
                f"headings and scans are turned against each other {by}",
                "mend the yaw of T_base_lidar, or of the prior",
            ),
        }[self.kind]


def _residuals(T: F64, runs: Sequence[Run]) -> F64:
    """(2 * runs, 6) position (m) and rotation (rad) by which the motion by poses T (n, 4, 4) differs from the one
    seen, at the middle and at the end of every run, in the frame of its first scan."""
    out = []
    for run in runs:
        for k in (len(run.indices) // 2, len(run.indices) - 1):
            believed = inverse(T[run.indices[0]]) @ T[run.indices[k]]
            seen = run.T_first_lidar[k]
            apart = inverse(seen) @ believed
            if np.linalg.det(apart[:3, :3]) < 0:
                out.append(np.array([*apart[:3, 3], np.pi, np.pi, np.pi]))
            else:
                out.append(np.concatenate([believed[:3, 3] - seen[:3, 3], log(apart)[3:]]))
    return np.array(out)


def misfits(T: F64, runs: Sequence[Run]) -> F64:
    """(runs,) metres by which the motion of each run differs, a rotation by what it moves 10 m away."""
    r = _residuals(T, runs)
    each = np.linalg.norm(r[:, :3], axis=1) + PRIOR_CHECK.lever_m * np.linalg.norm(r[:, 3:], axis=1)
    return np.asarray(each.reshape(-1, 2).mean(axis=1))


def at_times(T: F64, stamps_ns: I64, shift_s: float) -> F64:
    """The poses (n, 4, 4) believed ``shift_s`` later than each stamp; held at the ends."""
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    wanted = np.clip(seconds + shift_s, seconds[0], seconds[-1])
    rotations = scipy.spatial.transform.Rotation.from_matrix(T[:, :3, :3])
    positions = np.column_stack([np.interp(wanted, seconds, T[:, axis, 3]) for axis in range(3)])
    return poses_at(positions, scipy.spatial.transform.Slerp(seconds, rotations)(wanted).as_matrix())


def _fit_rule(rule: Callable[[F64], Rule], starts: list[F64], T: F64, runs: Sequence[Run]) -> tuple[F64, F64]:
    """(parameters (p,) of ``rule`` that fit the runs best, their standard errors (p,)): robust, from several starts."""
    weights = np.array([1.0, 1.0, 1.0, PRIOR_CHECK.lever_m, PRIOR_CHECK.lever_m, PRIOR_CHECK.lever_m])

    def off(parameters: F64) -> F64:
        return np.asarray((_residuals(rule(parameters)(T), runs) * weights).ravel())

    best = min(starts, key=lambda start: float(np.abs(off(start)).sum()))
    solution = scipy.optimize.least_squares(off, best, loss="soft_l1", f_scale=0.3, max_nfev=30)
    spread = 1.4826 * float(np.median(np.abs(solution.fun))) + 0.02
    # Neighbouring numbers of a run err alike: two of every three are taken to say nothing new.
    covariance = np.linalg.pinv(solution.jac.T @ solution.jac) * 3.0 * spread**2
    return np.asarray(solution.x), np.sqrt(np.maximum(np.diag(covariance), 0.0))


def measure_scale(T: F64, runs: Sequence[Run]) -> Number:
    """By which factor the prior's positions are too large."""
    believed_m = sum(float(np.linalg.norm(T[r.indices[-1], :3, 3] - T[r.indices[0], :3, 3])) for r in runs)
    seen_m = sum(float(np.linalg.norm(r.T_first_lidar[-1, :3, 3])) for r in runs)
    start = np.log(max(seen_m, 1e-3) / max(believed_m, 1e-6))
    x, sigma = _fit_rule(lambda p: scaled(float(np.exp(p[0]))), [np.array([start]), np.zeros(1)], T, runs)
    factor = float(np.exp(-x[0]))
    return Number("scale", factor, factor * float(sigma[0]), scaled(1.0 / factor))


def measure_turn(T: F64, runs: Sequence[Run]) -> tuple[Number, Number]:
    """(yaw, pitch) by which the headings are turned against the scans: degrees, counter-clockwise; nose up.

    Roll hardly shows in a motion; it is left to the road.
    """

    def rule(p: F64) -> Rule:
        return turned(from_xyz_rpy(0, 0, 0, pitch=float(p[1]), yaw=float(p[0])))

    starts = [np.array([yaw, 0.0]) for yaw in np.radians(np.arange(-180, 180, 30))]
    x, sigma = _fit_rule(rule, starts, T, runs)
    yaw, pitch = np.degrees((x + np.pi) % (2 * np.pi) - np.pi)
    yaw_sigma, pitch_sigma = np.degrees(sigma)
    turn = Number("turn", -float(yaw), float(yaw_sigma), rule(x))
    return turn, Number("pitch", float(pitch), float(pitch_sigma), rule(x))


def measure_time(T: F64, runs: Sequence[Run], stamps_ns: I64) -> Number | None:
    """How much later than the scans the prior's times are; None if no shift that the drive can show fits."""
    most_s = min(PRIOR_CHECK.time_s, (stamps_ns[-1] - stamps_ns[0]) * 1e-9 / 4.0)

    def rule(p: F64) -> Rule:
        return lambda T: at_times(T, stamps_ns, float(p[0]))

    starts = [np.array([s]) for s in np.arange(-most_s, most_s + 0.01, min(0.2, most_s))]
    x, sigma = _fit_rule(rule, starts, T, runs)
    return None if abs(x[0]) >= most_s else Number("time", float(x[0]), float(sigma[0]), rule(x))


@dataclass(frozen=True, slots=True)
class Similarity:
    """Positions p go to middle + offset + scale R (p - middle); a rotation Q goes to R Q own."""

    middle: F64
    """(3,) mean of the positions that were fitted."""
    offset_m: F64
    """(3,) at the middle."""
    rotation: F64
    """(3, 3) R."""
    scale: float
    own_deg: tuple[float, float]
    """(yaw, pitch) of ``own``: by which the sensors of both sets are turned against each other; 0 if not fitted."""
    off_m: F64
    """(n, 3) residual of each position."""
    sigma_m: float
    yaw_sigma_deg: float
    tilt_sigma_deg: float
    scale_sigma: float
    """Standard errors by how well the poses agree. Poses that err alike for seconds make them too small."""

    def applied(self, T: F64) -> F64:
        """Poses (n, 4, 4) of the first set as the second has them; of one that was fitted without an own turn."""
        positions = self.middle + self.offset_m + self.scale * (T[:, :3, 3] - self.middle) @ self.rotation.T
        return poses_at(positions, self.rotation @ T[:, :3, :3])


def fit_similarity(
    T_from: F64,
    T_to: F64,
    *,
    position_m: float,
    rotation_rad: float,
    scale: tuple[float, float] = (1.0, np.inf),
    own_turn: bool = False,
) -> Similarity:
    """The similarity from poses (n, 4, 4) to poses (n, 4, 4) of the same scans, by robust least squares (Umeyama, PAMI
    1991, gives the same for positions without outliers).

    ``position_m`` and ``rotation_rad``: errors of a pose; a residual of more than two of them counts less.
    ``scale``: (value, standard error) as known before. ``own_turn``: also fit the yaw and pitch by which the sensors of
    both sets are turned against each other; this needs a drive that moves.
    """
    Rotation = scipy.spatial.transform.Rotation
    middle = T_from[:, :3, 3].mean(axis=0)
    there = T_to[:, :3, 3].mean(axis=0)
    p = T_from[:, :3, 3] - middle
    q = T_to[:, :3, 3] - there
    R_from = Rotation.from_matrix(T_from[:, :3, :3])
    R_to = Rotation.from_matrix(T_to[:, :3, :3])

    def moved(x: F64) -> F64:
        return np.asarray(np.exp(x[6]) * Rotation.from_rotvec(x[3:6]).apply(p) + x[:3] - q)

    def off(x: F64) -> F64:
        rotated = Rotation.from_rotvec(x[3:6]) * R_from
        if own_turn:
            rotated = rotated * Rotation.from_euler("zy", x[7:])
        rotations = (rotated.inv() * R_to).as_rotvec() / rotation_rad
        scale_off = (x[6] - np.log(scale[0])) / scale[1]
        return np.concatenate([(moved(x) / position_m).ravel(), rotations.ravel(), [scale_off]])

    start = np.zeros(9 if own_turn else 7)
    start[3:6] = (R_to * R_from.inv()).mean().as_rotvec()
    start[6] = np.log(scale[0])
    solution = scipy.optimize.least_squares(off, start, loss="soft_l1", f_scale=2.0, max_nfev=100)
    x = solution.x
    spread = max(1.0, 1.4826 * float(np.median(np.abs(solution.fun))))
    sigma = spread * np.sqrt(np.diag(np.linalg.pinv(solution.jac.T @ solution.jac)))
    return Similarity(
        middle=middle,
        offset_m=there - middle + x[:3],
        rotation=Rotation.from_rotvec(x[3:6]).as_matrix(),
        scale=float(np.exp(x[6])),
        own_deg=(float(np.degrees(x[7])), float(np.degrees(x[8]))) if own_turn else (0.0, 0.0),
        off_m=moved(x),
        sigma_m=float(np.linalg.norm(sigma[:3])),
        yaw_sigma_deg=float(np.degrees(sigma[5])),
        tilt_sigma_deg=float(np.degrees(np.linalg.norm(sigma[3:5]))),
        scale_sigma=float(sigma[6]),
    )
