"""The track of a vehicle, scan after scan: predict, register, judge, recover (paper II).

A vehicle that does not trust its pose abstains: a lost vehicle must never demolish a street.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mapvote.config import NdtSettings
from mapvote.core.geometry import exp, from_xyz_rpy
from mapvote.core.record import record
from mapvote.core.types import F32, F64, PosePrior, Registration, Scan
from mapvote.matching.matcher import LocalMatcher, best_of
from mapvote.matching.ndt_voxels import LEVELS
from mapvote.matching.prepare import Sample, deskew, twist_between


@record(votes=True)
@dataclass(frozen=True, slots=True)
class Tracking:
    """Numbers of the track of a vehicle."""

    refined: int = 3
    """Best guesses that are refined when the vehicle is lost."""
    reconsidered: int = 8
    """Best guesses that are refined when a scan fits worse than the ones before it."""
    poor: float = 0.9
    """Share of the usual score below which other places are tried."""
    step_m: float = 1.0
    """Spacing of the guesses when the vehicle is lost."""
    reach_m: float = 10.0
    """Farthest guess when the vehicle is lost."""
    acceleration_mps2: float = 3.0
    """Rate at which a prediction by constant velocity goes stale: a car brakes harder only in an emergency."""
    yaws_deg: tuple[float, ...] = (0.0, -3.0, 3.0)
    """Turns of the guesses when the vehicle is lost."""
    rounds: int = 2
    """Times that a scan is de-skewed anew with the new motion, while that still changes."""
    speeds_mps: tuple[float, float, float] = (-2.5, 32.6, 2.5)
    """First, last and spacing of the forward speeds tried on a first scan."""
    far_better: float = 1.2
    """Factor by which another height must fit better before the prior's is given up."""
    twist_age_s: float = 1.0
    """Time between two poses beyond which they say little about the present velocity."""
    memory: float = 0.2
    """Weight of the newest score in the usual one."""


TRACKING = Tracking()


@dataclass(slots=True)
class Standing:
    """Whether a pose that was given out still stands."""

    holds: bool = True
    """False once a check has refuted the track that the pose is of."""


@dataclass(frozen=True, slots=True)
class Fix:
    """One scan, localised."""

    scan: Scan
    registration: Registration
    twist: F64
    """(6,) motion per second in the lidar frame by which the scan is de-skewed."""
    trusted: bool
    """Whether the registration by itself is sound; whether it is the right place, the Localiser finds out."""
    prior: PosePrior | None = None
    """The prior in the map's frame, where its own frame had to be learnt."""
    standing: Standing = field(default_factory=Standing)
    """Changes until a second after the scan at most."""
    sample: Sample | None = field(default=None, compare=False)
    """The points by which it was registered, if they are at hand."""

    @property
    def points(self) -> F32:
        """(n, 3) the scan's points in the lidar frame at its stamp, de-skewed: computed anew."""
        return deskew(self.scan, self.twist)


class Tracker:
    """Follows one vehicle. Scans must come in order of time.

    ``map_around``: the matcher to use near a position (3,), for a finished map a
    :class:`mapvote.matching.matcher.MapAround`.
    """

    def __init__(
        self, map_around: Callable[[F64], LocalMatcher], settings: NdtSettings, numbers: Tracking = TRACKING
    ) -> None:
        self.map_around = map_around
        self.numbers = numbers
        self._speeds_mps = np.arange(*numbers.speeds_mps)
        self._yaws_rad = np.radians(numbers.yaws_deg)
        self.settings = settings
        self.twist = np.zeros(6)
        """Motion per second in the lidar frame (velocity, angular velocity), from the last two trusted poses."""
        self.last_pose: F64 | None = None
        self.last_stamp_ns = 0
        self._measured = False
        """Whether ``twist`` was measured from two poses, so that it predicts the next."""
        self._usual_score = 0.0
        """Score of trusted scans lately: a far lower one means the wrong place, however certain the registration."""

    def localise(self, scan: Scan, prior: PosePrior | None = None) -> Fix:
        """The pose of the next scan. Without any prior, ever, the first pose is taken to be near the map's origin.

        A prior is a guess and a factor, no gate: whether a pose can be voted with is the Localiser's to say.
        """
        # The first guess and the motion by which the scan is de-skewed.
        seed, reach = self._seed(scan.stamp_ns, prior)
        around = self.map_around(seed[:3, 3])
        sample = Sample(scan)
        if reach >= self.numbers.step_m:
            seed = self._levelled(around, sample, seed)
        twist = (
            self.twist if self._knows_motion(scan) else self.guess_motion(around, scan.stamp_ns, sample, seed, prior)
        )
        # The pose from the first guess; others where it fits badly.
        first_level = self._first_level(reach)
        result = around.refine(sample.clouds(twist, first_level), seed, prior, first_level)
        if result.score < self.numbers.poor * self._usual_score:
            result = self._reconsider(around, sample.clouds(twist), scan.stamp_ns, result, prior)
        trusted = self.is_sound(result)
        if not trusted:
            centre = prior.T_map_lidar if prior is not None else seed
            result = self._search(around, sample.clouds(twist), centre, reach, prior)
            trusted = self.is_sound(result)
        # De-skewed anew while the motion to the new pose changes.
        finest = len(LEVELS) - 1
        moved = self._motion_to(result.T_map_lidar, scan.stamp_ns)
        for _ in range(self.numbers.rounds):
            if scan.time_s is None or moved is None or not _differ(twist, moved):
                break
            twist = moved
            result = around.refine(sample.clouds(twist, finest), result.T_map_lidar, prior, finest)
            trusted = self.is_sound(result)
            moved = self._motion_to(result.T_map_lidar, scan.stamp_ns)
        if trusted:
            self._accept(result.T_map_lidar, scan.stamp_ns, moved, twist)
            rate = self.numbers.memory if self._usual_score else 1.0
            self._usual_score += rate * (result.score - self._usual_score)
        return Fix(scan, result, twist, trusted, sample=sample)

    def _first_level(self, reach: float) -> int:
        """The coarsest level that a guess needs which may be off by ``reach`` metres."""
        if self.last_pose is None or reach > 0.5 * self.numbers.step_m:
            return 0
        return len(LEVELS) - 1 if reach <= LEVELS[-1].floor_m else 1

    @property
    def has_motion(self) -> bool:
        """Whether the motion that led to the last pose is known."""
        return self._measured or bool(self.twist.any())

    def _knows_motion(self, scan: Scan) -> bool:
        return scan.time_s is None or self.has_motion

    def guess_motion(
        self, around: LocalMatcher, stamp_ns: int, sample: Sample, seed: F64, prior: PosePrior | None = None
    ) -> F64:
        """The forward speed at which a scan fits the map best: unknown motion bends it, and moves it since the last."""
        age = 1e-9 * (stamp_ns - self.last_stamp_ns)
        moved: list[tuple[float, F64]] = []
        for speed in self._speeds_mps:
            twist = np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0])
            start = seed if self.last_pose is None else self.last_pose @ exp(age * twist)
            moved.append((around.refine(sample.coarse(twist), start, prior).score, twist))
        return max(moved, key=lambda scored: scored[0])[1]

    def begin(self, scan: Scan, T_map_lidar: F64) -> Fix:
        """Take the first pose as given: where there is no map yet, the first scan makes it."""
        self._accept(T_map_lidar, scan.stamp_ns, self._motion_to(T_map_lidar, scan.stamp_ns), self.twist)
        registration = Registration(T_map_lidar, np.zeros((6, 6)), 1.0, 1.0, 0, True)
        return Fix(scan, registration, self.twist, True)

    def _seed(self, stamp_ns: int, prior: PosePrior | None) -> tuple[F64, float]:
        """The first guess and how far it may be off: by constant velocity while that is fresher than the prior."""
        if self.last_pose is not None:
            age = 1e-9 * (stamp_ns - self.last_stamp_ns)
            fastest_mps = float(self._speeds_mps[-1])
            drift = 0.5 * self.numbers.acceleration_mps2 * age**2 if self.has_motion else age * fastest_mps
            if prior is None or drift < prior.sigma_m:
                return self.last_pose @ exp(age * self.twist), drift
        if prior is None:
            return np.eye(4), self.numbers.reach_m
        return prior.T_map_lidar, 2.0 * prior.sigma_m

    def _levelled(self, around: LocalMatcher, sample: Sample, seed: F64) -> F64:
        """The seed at the height at which the scan fits far better: satellites know heights worst, and NDT finds no
        road that lies metres from the scan's own."""
        steps = np.arange(self.numbers.step_m, self.numbers.reach_m + 1e-6)
        guesses = [seed, *(from_xyz_rpy(0.0, 0.0, z) @ seed for step in steps for z in (step, -step))]
        fits = around.likelihood(sample.coarse(np.zeros(6))[0], np.array(guesses))
        best = int(np.argmax(fits))
        return guesses[best] if fits[best] > self.numbers.far_better * fits[0] else seed

    def move_to(self, T_map_lidar: F64, stamp_ns: int, twist: F64 | None = None, score: float = 0.0) -> None:
        """The vehicle was here then: the track goes on from this pose, with this motion or none known."""
        self.last_pose = T_map_lidar
        self.last_stamp_ns = stamp_ns
        self.twist, self._measured = (np.zeros(6), False) if twist is None else (twist, True)
        self._usual_score = score

    def correct(self, T_map_lidar: F64, twist: F64) -> None:
        """The last scan was taken here, a little beside where it was found: the track goes on from this pose."""
        self.last_pose = T_map_lidar
        self.twist = twist

    def is_sound(self, result: Registration) -> bool:
        """Whether a registration converged, overlaps the map and is certain enough; pose_check tests the place."""
        s = self.settings
        position = result.covariance[:3, :3]
        if not result.converged or result.inlier_share < s.min_inlier_share:
            return False
        if np.sqrt(position[0, 0] + position[1, 1] + position[2, 2]) < 0.99 * s.max_sigma_m:
            return True  # no direction has more than all of them together, which takes less to ask
        return bool(np.sqrt(np.linalg.eigvalsh(position)[-1]) <= s.max_sigma_m)

    def _reconsider(
        self, around: LocalMatcher, clouds: list[F32], stamp_ns: int, result: Registration, prior: PosePrior | None
    ) -> Registration:
        """The best of ``result``, the prior's place, and every speed that a vehicle may have had since the last scan.

        A street looks alike along itself: a scan that fits worse than usual may have settled one house too early.
        """
        guesses = [] if prior is None else [prior.T_map_lidar]
        if self.last_pose is not None:
            age = 1e-9 * (stamp_ns - self.last_stamp_ns)
            guesses += [self.last_pose @ from_xyz_rpy(age * speed, 0.0, 0.0) for speed in self._speeds_mps]
        best = best_of(around, clouds, guesses, self.numbers.reconsidered, prior)
        return best if best.score > result.score else result

    def _search(
        self, around: LocalMatcher, clouds: list[F32], centre: F64, reach: float, prior: PosePrior | None
    ) -> Registration:
        """Guesses on a grid around ``centre``, ranked by the coarsest level; the best few are refined."""
        rings = int(np.ceil(min(max(reach, self.numbers.step_m), self.numbers.reach_m) / self.numbers.step_m))
        offsets = self.numbers.step_m * np.arange(-rings, rings + 1)
        guesses = [
            centre @ from_xyz_rpy(x, y, 0.0, 0.0, 0.0, yaw) for x in offsets for y in offsets for yaw in self._yaws_rad
        ]
        return best_of(around, clouds, guesses, self.numbers.refined, prior, 1000)

    def _motion_to(self, T_map_lidar: F64, stamp_ns: int) -> F64 | None:
        """Motion per second from the last trusted pose to this one, None if that was too long ago to say."""
        seconds = 1e-9 * (stamp_ns - self.last_stamp_ns)
        if self.last_pose is None or not 0 < seconds <= self.numbers.twist_age_s:
            return None
        return twist_between(self.last_pose, T_map_lidar, seconds)

    def _accept(self, T_map_lidar: F64, stamp_ns: int, motion: F64 | None, twist: F64) -> None:
        """The track goes on from this pose with the measured ``motion``, else with ``twist``."""
        self.twist = twist if motion is None else motion
        self._measured = self._measured or motion is not None
        self.last_pose = T_map_lidar
        self.last_stamp_ns = stamp_ns


def _differ(twist: F64, other: F64) -> bool:
    """Whether two motions bend a scan differently: by more than 2 cm, at its ends and 20 m away."""
    change = [abs(a - b) for a, b in zip(twist.tolist(), other.tolist(), strict=True)]
    return max(change[:3]) * 0.05 > 0.02 or max(change[3:]) * 0.05 * 20.0 > 0.02
