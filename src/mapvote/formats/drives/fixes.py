"""Priors of satellite fixes (sensor_msgs/NavSatFix, tables of latitudes): live and recorded drives read them here.

A fix states a position and its covariance, and no heading. The heading follows from the way between two fixes, from a
stated one (two antennas, an IMU whose covariance says that it knows north), or from the way and the turn that an IMU
measured since. A prior uses the fixes up to its own stamp alone, so that a recorded drive gets the priors of the live
one. Each prior has the standard deviations that follow from the fixes'.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mapvote.core.geometry import from_xyz_rpy, rotations_of, wrapped
from mapvote.core.record import record
from mapvote.core.types import F64, I64, MapvoteError, PosePrior
from mapvote.formats.geo.frame import MapFrame


@record(votes=True)
@dataclass(frozen=True, slots=True)
class FixRules:
    """How satellite fixes become priors."""

    unstated_m: float = 5.0
    """Standard deviation in the plane of a fix that states no covariance, metres."""
    least_m: float = 0.02
    """Smallest standard deviation of a fix that is believed, metres."""
    old_s: float = 2.0
    """A fix older than this gives no prior, seconds."""
    back_s: float = 10.0
    """Fixes this long before the last one may give the heading, seconds."""
    clear: float = 5.0
    """A way shorter than so many of its own standard deviations may be noise of a vehicle that stands."""
    slip_rad: float = 0.03
    """Standard deviation between the way driven and the axis of the vehicle, radians."""
    turn_rad_s: float = 0.15
    """Growth of the heading's standard deviation between fixes, radians per second: no sensor measures turns there."""
    drift_rad_s: float = 0.005
    """The same where an IMU measures the turn, radians per second."""
    acceleration_mps2: float = 1.5
    """Standard deviation of the acceleration between two fixes, metres per second squared."""
    speed_mps: float = 15.0
    """Standard deviation of the speed before a second fix, metres per second."""
    unstated_heading_rad: float = 0.1
    """Standard deviation of a heading in a table that states none, radians."""
    known_rad: float = 0.5
    """A heading less sure than this is unknown, radians."""
    beside_s: float = 0.1
    """Time before the first heading that an IMU states, and after its last, at which it still counts, seconds."""
    hole_s: float = 1.0
    """Time between two headings of an IMU beyond which the turn between them is unknown, seconds."""
    differ: float = 4.0
    """A stated heading so many standard deviations off the way driven makes the heading unknown."""


FIX_RULES = FixRules()
UNKNOWN_RAD = float(np.pi)
"""Standard deviation of a heading of which nothing is known."""


def _none() -> F64:
    return np.zeros(0)


@dataclass(frozen=True, slots=True)
class Fixes:
    """Positions of an antenna, and headings of the vehicle that carries it."""

    times_ns: I64 = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(n,) ascending."""
    position: F64 = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) the antenna, map metres."""
    sigma_m: F64 = field(default_factory=_none)
    """(n,) standard deviations in the plane."""
    north_rad: F64 = field(default_factory=_none)
    """(n,) yaw of true east in the map: the convergence of the meridians."""
    turn_times_ns: I64 = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(m,) ascending."""
    yaw_rad: F64 = field(default_factory=_none)
    """(m,) yaw of the vehicle from east, counter-clockwise."""
    yaw_sigma_rad: F64 = field(default_factory=_none)
    """(m,) its standard deviation; inf where only its changes count."""

    def with_fixes(self, later: Fixes, most: int) -> Fixes:
        """These and ``later`` ones, the newest ``most``; a fix that is no later than the last one is left out."""
        if len(self.times_ns) and later.times_ns[0] <= self.times_ns[-1]:
            return self
        return replace(
            self,
            times_ns=np.concatenate([self.times_ns, later.times_ns])[-most:],
            position=np.concatenate([self.position, later.position])[-most:],
            sigma_m=np.concatenate([self.sigma_m, later.sigma_m])[-most:],
            north_rad=np.concatenate([self.north_rad, later.north_rad])[-most:],
        )

    def with_headings(self, times_ns: Sequence[int], yaw_rad: Sequence[float], sigma_rad: Sequence[float]) -> Fixes:
        """These, and headings in the order of their times; NaN is no heading."""
        times = np.array(times_ns, dtype=np.int64)
        order = np.unique(times, return_index=True)[1]
        measured = order[np.isfinite(np.array(yaw_rad, dtype=np.float64)[order])]
        return replace(
            self,
            turn_times_ns=times[measured],
            yaw_rad=np.array(yaw_rad, dtype=np.float64)[measured],
            yaw_sigma_rad=np.array(sigma_rad, dtype=np.float64)[measured],
        )

    def yaw_at(self, times_ns: I64, rules: FixRules = FIX_RULES) -> F64:
        """(k,) yaw of the vehicle at these times, as the IMU counts it; NaN beyond its headings."""
        if not len(self.turn_times_ns):
            return np.full(len(times_ns), np.nan)
        # Between two headings by the shorter way: so it does not depend on the headings that are kept before them.
        after = np.clip(np.searchsorted(self.turn_times_ns, times_ns), 1, max(len(self.turn_times_ns) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(self.turn_times_ns) - 1)
        gap_ns = np.maximum(self.turn_times_ns[after] - self.turn_times_ns[before], 1)
        share = np.clip((times_ns - self.turn_times_ns[before]) / gap_ns, 0.0, 1.0)
        yaw = self.yaw_rad[before] + share * wrapped(self.yaw_rad[after] - self.yaw_rad[before])
        early = times_ns < self.turn_times_ns[0] - rules.beside_s * 1e9
        late = times_ns > self.turn_times_ns[-1] + rules.beside_s * 1e9
        return np.where(early | late | (gap_ns > rules.hole_s * 1e9), np.nan, yaw)


def fixes_of(
    times_ns: I64, lonlat: F64, covariances: F64 | None, frame: MapFrame, rules: FixRules = FIX_RULES
) -> Fixes:
    """Sound fixes (n, 3), longitude and latitude in degrees and height in metres, in the frame of the map.

    ``covariances`` (n, 9) east, north, up, row by row, square metres; NaN where none is stated. MapvoteError if the
    place of the map on Earth is unknown.
    """
    if frame.is_local:
        raise MapvoteError(
            "fixes of GNSS need the place of the map on Earth: import the map with --crs EPSG:n or --projector, or "
            "give origin in drive.toml"
        )
    axes = frame.axes_at(lonlat)
    return Fixes(
        times_ns,
        frame.from_lonlat(lonlat),
        sigmas_of(np.full((len(times_ns), 9), np.nan) if covariances is None else covariances, rules),
        np.arctan2(axes[:, 1, 0], axes[:, 0, 0]),
    )


def sigmas_of(covariances: F64, rules: FixRules = FIX_RULES) -> F64:
    """(n,) the largest standard deviation over all directions of the plane of covariances (n, 9), metres. Covariances
    that are not finite, or that state no error at all, count as not stated."""
    stated = np.isfinite(covariances).all(axis=1)
    squares = np.zeros(len(covariances))
    matrices = covariances[stated].reshape(-1, 3, 3)[:, :2, :2]
    if len(matrices):
        squares[stated] = np.linalg.eigvalsh(0.5 * (matrices + matrices.swapaxes(1, 2)))[:, -1]
    return np.where(squares > 0.0, np.maximum(np.sqrt(np.maximum(squares, 0.0)), rules.least_m), rules.unstated_m)


def prior_at(fixes: Fixes, stamp_ns: int, T_antenna_lidar: F64, rules: FixRules = FIX_RULES) -> PosePrior | None:
    """The prior of the LiDAR by the fixes up to ``stamp_ns``; None without a fresh fix.

    ``T_antenna_lidar`` (4, 4): the LiDAR from the antenna, in axes of the vehicle. A heading that nothing tells has the
    standard deviation :data:`UNKNOWN_RAD`; its prior bounds the place alone.
    """
    last = int(np.searchsorted(fixes.times_ns, stamp_ns, side="right")) - 1
    if last < 0 or stamp_ns - fixes.times_ns[last] > rules.old_s * 1e9:
        return None
    age_s = 1e-9 * (stamp_ns - fixes.times_ns[last])
    # The fixes before the last one, and how far the vehicle came since each.
    first = int(np.searchsorted(fixes.times_ns, fixes.times_ns[last] - int(rules.back_s * 1e9)))
    span_s = 1e-9 * (fixes.times_ns[last] - fixes.times_ns[first:last])
    way = fixes.position[last] - fixes.position[first:last]
    noise_m = np.hypot(fixes.sigma_m[last], fixes.sigma_m[first:last])
    # The place: the last fix, moved on by the surest velocity.
    position = fixes.position[last].copy()
    drift_mps = rules.speed_mps
    if len(span_s):
        drifts_mps = np.hypot(noise_m / span_s, 0.5 * rules.acceleration_mps2 * span_s)
        surest = int(np.argmin(drifts_mps))
        if drifts_mps[surest] < drift_mps:
            drift_mps = float(drifts_mps[surest])
            position += way[surest] / span_s[surest] * age_s
    grown_m = np.hypot(drift_mps * age_s, 0.5 * rules.acceleration_mps2 * age_s**2)
    sigma_m = float(np.hypot(fixes.sigma_m[last], grown_m))
    # The heading.
    yaw, sigma_rad = _heading(fixes, stamp_ns, range(first, last), rules)
    lever_m = float(np.linalg.norm(T_antenna_lidar[:2, 3]))
    sigma_m = float(np.hypot(sigma_m, lever_m * min(sigma_rad, 1.5)))
    x, y, z = position.tolist()
    T_map_antenna = from_xyz_rpy(x, y, z, 0.0, 0.0, yaw)
    return PosePrior(T_map_antenna @ T_antenna_lidar, sigma_m, sigma_rad, is_planar=True)


def priors_at(
    fixes: Fixes, stamps_ns: I64, T_antenna_lidar: F64, rules: FixRules = FIX_RULES
) -> tuple[F64, F64] | None:
    """(T_map_lidar (n, 4, 4), standard deviations (n, 2) in metres and radians) of a recorded drive: :func:`prior_at`
    of each scan. A scan without a prior has the pose of its neighbour, with the standard deviation inf. None if no
    scan has one."""
    priors = [prior_at(fixes, int(stamp_ns), T_antenna_lidar, rules) for stamp_ns in stamps_ns]
    with_prior = np.flatnonzero([prior is not None for prior in priors])
    if not len(with_prior):
        return None
    nearest = with_prior[np.clip(np.searchsorted(with_prior, np.arange(len(priors)), side="right") - 1, 0, None)]
    poses = np.stack([np.eye(4) if prior is None else prior.T_map_lidar for prior in priors])
    sigmas = [(np.inf, np.inf) if prior is None else (prior.sigma_m, prior.sigma_rad) for prior in priors]
    return poses[nearest], np.array(sigmas)


def _heading(fixes: Fixes, stamp_ns: int, earlier: range, rules: FixRules) -> tuple[float, float]:
    """(yaw of the vehicle in the map, its standard deviation) at ``stamp_ns``, by the way from the ``earlier`` fixes to
    the last one, and by what is stated."""
    last = earlier.stop
    course, course_sigma = _course(fixes, stamp_ns, earlier, rules)
    stated, stated_sigma = _stated(fixes, stamp_ns, last, rules)
    if stated_sigma > rules.known_rad:
        return course, course_sigma
    if course_sigma > rules.known_rad:
        return stated, stated_sigma
    # Both are known. A vehicle that reverses, and an IMU that does not know north, contradict the way driven.
    off = abs(float(np.angle(np.exp(1j * (stated - course)))))
    if off > rules.differ * np.hypot(course_sigma, stated_sigma):
        return course, UNKNOWN_RAD
    return (stated, stated_sigma) if stated_sigma < course_sigma else (course, course_sigma)


def _course(fixes: Fixes, stamp_ns: int, earlier: range, rules: FixRules) -> tuple[float, float]:
    """The heading by the way from an earlier fix: the one that makes it surest."""
    last = earlier.stop
    if not len(earlier):
        return 0.0, UNKNOWN_RAD
    way = fixes.position[last, :2] - fixes.position[earlier.start : last, :2]
    length_m = np.linalg.norm(way, axis=1)
    noise_m = np.hypot(fixes.sigma_m[last], fixes.sigma_m[earlier.start : last])
    # The way from fix to fix is the heading half-way between them; since then the vehicle has turned.
    middle_ns = (fixes.times_ns[earlier.start : last] + fixes.times_ns[last]) // 2
    turned = wrapped(fixes.yaw_at(np.array([stamp_ns]), rules) - fixes.yaw_at(middle_ns, rules))
    measured = np.isfinite(turned)
    rate = np.where(measured, rules.drift_rad_s, rules.turn_rad_s)
    with np.errstate(divide="ignore"):
        sigmas = np.hypot(np.hypot(noise_m / length_m, rules.slip_rad), rate * 1e-9 * (stamp_ns - middle_ns))
    sigmas[length_m < rules.clear * noise_m] = UNKNOWN_RAD
    best = int(np.argmin(sigmas))
    if not sigmas[best] <= rules.known_rad:
        return 0.0, UNKNOWN_RAD
    course = np.arctan2(way[best, 1], way[best, 0]) + (turned[best] if measured[best] else 0.0)
    return float(course), float(sigmas[best])


def _stated(fixes: Fixes, stamp_ns: int, last: int, rules: FixRules) -> tuple[float, float]:
    """The heading that two antennas or an IMU state at ``stamp_ns``, in the map; unknown where none is stated."""
    newest = int(np.searchsorted(fixes.turn_times_ns, stamp_ns, side="right")) - 1
    if newest < 0 or stamp_ns - fixes.turn_times_ns[newest] > rules.old_s * 1e9:
        return 0.0, UNKNOWN_RAD
    age_s = 1e-9 * (stamp_ns - fixes.turn_times_ns[newest])
    yaw = float(fixes.yaw_rad[newest] + fixes.north_rad[last])
    sigma_rad = float(np.hypot(fixes.yaw_sigma_rad[newest], rules.turn_rad_s * age_s))
    return yaw, min(sigma_rad, UNKNOWN_RAD)


def heading_of_imu(orientation: Sequence[float], covariance: Sequence[float], T_base_imu: F64) -> tuple[float, float]:
    """(yaw of the vehicle from east, counter-clockwise; its standard deviation) of a sensor_msgs/Imu (REP 145: x east,
    y north, z up).

    NaN where the message has no orientation: the first number of its covariance is -1, or the quaternion (x, y, z, w)
    is none. Inf where no covariance is stated: then north is unknown, and only changes of the yaw count.
    """
    q = np.array(orientation, dtype=np.float64)
    length = float(np.linalg.norm(q))
    if covariance[0] == -1.0 or not 0.5 < length < 2.0:
        return float("nan"), float("inf")
    R_enu_base = rotations_of([q])[0] @ T_base_imu[:3, :3].T
    variance = float(covariance[8])
    sigma_rad = float(np.sqrt(variance)) if np.isfinite(variance) and variance > 0.0 else float("inf")
    return float(np.arctan2(R_enu_base[1, 0], R_enu_base[0, 0])), sigma_rad


def antenna_lever(T_base: Mapping[str, F64], antenna: str, lidar: str) -> F64:
    """T_antenna_lidar (4, 4) in axes of the vehicle. ``T_base``: T_base_frame (4, 4) of each frame that is joined to
    the vehicle. A frame that is not is taken to lie at the vehicle's own origin."""
    T_antenna_lidar = T_base.get(lidar, np.eye(4)).copy()
    T_antenna_lidar[:3, 3] -= T_base.get(antenna, np.eye(4))[:3, 3]
    return T_antenna_lidar
