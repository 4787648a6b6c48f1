"""Numbers that make prior and scans agree: a scale, a turn between them, a shift in time. Each with its error."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from mapvote.core import geometry
from mapvote.core.types import F64, I64
from mapvote.doctor.motion import Run
from mapvote.doctor.prior import scaled

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
