"""Numbers that make prior and scans agree: a scale, a turn between them, a shift in time. Each with its error."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize
from scipy.spatial.transform import Rotation, Slerp

from mapvote.core import geometry
from mapvote.core.types import F64, I64
from mapvote.doctor.agreement import LEVER_M, residuals
from mapvote.doctor.motion import Run

_TIME_S = 3.0
"""Shifts in time are looked for so far, and over a quarter of the drive: beyond, little is left to compare."""


@dataclass(frozen=True, slots=True)
class Measured:
    """One number, fitted."""

    kind: str
    """ "scale", "turn" or "time"."""
    value: float
    """Factor that the prior's positions are too large by; degrees; seconds."""
    sigma: float
    poses: Callable[[F64], F64]
    """The prior mended."""


def at_times(T: F64, stamps_ns: I64, shift_s: float) -> F64:
    """The poses (n, 4, 4) told for ``shift_s`` later than each stamp; held at the ends."""
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    wanted = np.clip(seconds + shift_s, seconds[0], seconds[-1])
    out = np.tile(np.eye(4), (len(T), 1, 1))
    out[:, :3, :3] = Slerp(seconds, Rotation.from_matrix(T[:, :3, :3]))(wanted).as_matrix()
    for axis in range(3):
        out[:, axis, 3] = np.interp(wanted, seconds, T[:, axis, 3])
    return out


def _fit(
    poses_of: Callable[[F64], Callable[[F64], F64]], starts: list[F64], T: F64, runs: Sequence[Run]
) -> tuple[F64, F64]:
    """(best parameters (p,), their standard errors (p,)) by robust least squares from several starts."""
    weights = np.array([1.0, 1.0, 1.0, LEVER_M, LEVER_M, LEVER_M])

    def off(parameters: F64) -> F64:
        return np.asarray((residuals(poses_of(parameters)(T), runs) * weights).ravel())

    costs = [float(np.abs(off(start)).sum()) for start in starts]
    found = optimize.least_squares(off, starts[int(np.argmin(costs))], loss="soft_l1", f_scale=0.3, max_nfev=30)
    spread = 1.4826 * float(np.median(np.abs(found.fun))) + 0.02
    # Neighbouring numbers of a run err alike: two of every three are taken to say nothing new.
    covariance = np.linalg.pinv(found.jac.T @ found.jac) * 3.0 * spread**2
    return np.asarray(found.x), np.sqrt(np.diag(covariance))


def measure_scale(T: F64, runs: Sequence[Run]) -> Measured:
    told_m = sum(float(np.linalg.norm(T[r.indices[-1], :3, 3] - T[r.indices[0], :3, 3])) for r in runs)
    seen_m = sum(float(np.linalg.norm(r.end[:3, 3])) for r in runs)
    start = np.log(max(seen_m, 1e-3) / max(told_m, 1e-6))

    def rule(p: F64) -> Callable[[F64], F64]:
        def poses(T: F64) -> F64:
            out = T.copy()
            out[:, :3, 3] *= np.exp(p[0])
            return out

        return poses

    x, sigma = _fit(rule, [np.array([start]), np.zeros(1)], T, runs)
    factor = float(np.exp(-x[0]))
    return Measured("scale", factor, factor * float(sigma[0]), rule(x))


def measure_turn(T: F64, runs: Sequence[Run]) -> tuple[Measured, Measured]:
    """(yaw, pitch) by which the headings told are turned against the scans: degrees, counter-clockwise; nose up.

    Roll hardly shows in a motion; it is left to the road.
    """

    def rule(p: F64) -> Callable[[F64], F64]:
        C = geometry.from_xyz_rpy(0, 0, 0, pitch=float(p[1]), yaw=float(p[0]))
        return lambda T: np.asarray(T @ C)

    starts = [np.array([yaw, 0.0]) for yaw in np.radians(np.arange(-180, 180, 30))]
    x, sigma = _fit(rule, starts, T, runs)
    yaw, pitch = np.degrees((x + np.pi) % (2 * np.pi) - np.pi)
    yaw_sigma, pitch_sigma = np.degrees(sigma)
    mended = rule(x)
    return (
        Measured("turn", -float(yaw), float(yaw_sigma), mended),
        Measured("pitch", float(pitch), float(pitch_sigma), mended),
    )


def measure_time(T: F64, runs: Sequence[Run], stamps_ns: I64) -> Measured | None:
    """How much later than the scans the prior's times are; None if no shift that the drive can show fits."""
    most_s = min(_TIME_S, (stamps_ns[-1] - stamps_ns[0]) * 1e-9 / 4.0)

    def rule(p: F64) -> Callable[[F64], F64]:
        return lambda T: at_times(T, stamps_ns, float(p[0]))

    starts = [np.array([s]) for s in np.arange(-most_s, most_s + 0.01, min(0.2, most_s))]
    x, sigma = _fit(rule, starts, T, runs)
    if abs(x[0]) >= most_s:
        return None
    return Measured("time", float(x[0]), float(sigma[0]), rule(x))
