"""Poses that a vehicle may vote with: a track is followed, doubted, confirmed, moved or taken back.

A scan votes once the place of its track has been confirmed by a look taken at it or after it. Until a track is
confirmed its scans wait here; where another place fits better the track moves there, and they move along. The scans of
a confirmed track are given out at once: the filter of moving objects holds each for a second, and a look comes within
that second. If the look refutes the track, the scans since the last good look are taken back (:class:`Standing`), so
that they never vote. Memory is bounded by the scans that may wait.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from mapvote.config import Settings
from mapvote.core.geometry import exp, inverse
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.sensors import Sensor
from mapvote.core.types import F64, I64, PosePrior, Registration, Scan
from mapvote.matching.global_search import Bound, GlobalSearch
from mapvote.matching.odometry import Fix, Tracker
from mapvote.matching.pose_check import Judge, Verdict
from mapvote.matching.prepare import Sample, deskew, motion_at, thin_for_levels, twist_between
from mapvote.matching.prior_frame import PriorFrame, distance_to


@record(votes=True)
@dataclass(frozen=True, slots=True)
class Localisation:
    """Numbers of the confirmation of a track."""

    checks: int = 3
    """Checks in turn that must hold before the first vote."""
    wait_scans: int = 40
    """Scans that wait at most until their track is confirmed: the number that a vehicle can hold, 4 s at 10 Hz."""
    every_m: float = 10.0
    """Distance after which a track that holds is checked again, well within the 15 m of a check."""
    every_s: float = 1.0
    """Time after which it is checked again, or that for which the filter of moving objects holds a scan, if less."""
    kept: int = 2
    """Newest scans of a confirmed track that wait: with two a track that is moved knows its motion."""
    jumps: int = 4
    """Moves of a track on one scan before it counts as lost there."""
    memory: float = 0.1
    """Weight of the newest difference between fix and prior in the one remembered."""
    back_m: float = 1.0
    """Distance from the motion of the scans after it at which a scan that is followed back is lost."""
    back_rad: float = float(np.radians(5.0))
    """Turn from that motion at which it is lost."""
    leap_m: float = 1.0
    """Distance of a pose from the motion before it at which the track has leapt ..."""
    leap_mps2: float = 10.0
    """... and the acceleration, which no car exceeds, by which it may be farther."""
    first_search: int = 6
    """Scans without a confirmed place before the whole map is searched; every further search waits twice as long."""


LOCALISATION = Localisation()


@record(votes=True)
@dataclass(frozen=True, slots=True)
class Start:
    """Which prior a track may start from, and how one that is too wide for it bounds the search."""

    sure_m: float = 5.0
    """A prior no wider than this is tried as a pose, metres; half of the farthest guess around it."""
    sure_rad: float = 0.2
    """The same for its heading, radians."""
    sigmas: float = 3.0
    """A wider one bounds the search of the map to so many of its standard deviations."""
    beside_m: float = 5.0
    """Width of the bound beside them, metres."""
    bounded: int = 3
    """Searches in turn within the bound that may fail before the whole map is searched."""


START = Start()


class Localise(Protocol):
    """Poses of scans. Scans go in, in order of time; fixes come out in the same order, some later."""

    def push(self, scan: Scan, prior: PosePrior | None) -> list[Fix]:
        """One more scan; the fixes that are decided by now. Untrusted ones cast no vote."""
        ...

    def flush(self) -> list[Fix]:
        """The drive is over: the fixes of all scans that still wait."""
        ...


@dataclass(slots=True)
class _Waiting:
    fix: Fix
    misfit: F64 | None
    """(3,) shift of the fix from the unchanged prior, map metres."""
    prior: PosePrior | None = None
    """The prior of the scan, unchanged."""
    in_map: PosePrior | None = None
    """The prior in the map's frame, where its own frame was known."""
    begun: int = 0
    """Number of the prior's frame: a prior may begin several."""
    nowhere: bool = False
    """Whether the scan has no place yet."""


class Localiser:
    """NDT in a finished map, trusted only where several scans agree that no other place fits as well.

    Without a prior, and when no place holds for long, the whole map is searched.
    """

    def __init__(
        self,
        point_map: PointMap,
        settings: Settings,
        sensor: Sensor,
        numbers: Localisation = LOCALISATION,
        start: Start = START,
    ) -> None:
        self.numbers = numbers
        self.search = GlobalSearch(point_map, settings.ndt, sensor.range_sigma_m)
        self.map_around = self.search.map_around  # one window of the map: a search and a track never need it at once
        self.tracker = Tracker(self.map_around, settings.ndt)
        self.judge = Judge(sensor.range_sigma_m)
        self.prior_frame = PriorFrame()
        self._start = start
        self._failed_within = 0
        """Searches in turn within a prior's bound that found no place."""
        self.misfit = np.zeros(3)
        """(3,) shift of trusted fixes from their priors lately, map metres."""
        self._waiting: deque[_Waiting] = deque()
        self._given: list[_Waiting] = []
        """Scans of the confirmed track that were given out since the last look."""
        self._every_s = min(numbers.every_s, settings.moving.lookahead_s)
        self._held = 0
        """Looks in turn that held."""
        self._confirmed = False
        self._looked_at: Fix | None = None
        self._unconfirmed = 0
        self._next_search = self.numbers.first_search

    def push(self, scan: Scan, prior: PosePrior | None) -> list[Fix]:
        """See :class:`Localise`."""
        if not self._has_place(scan, prior):
            nowhere = Registration(np.eye(4), np.eye(6), 0.0, 0.0, 0, False)
            self._waiting.append(_Waiting(Fix(scan, nowhere, np.zeros(6), False), None, prior, nowhere=True))
            return self._decide(max(0, len(self._waiting) - self.numbers.wait_scans), False)
        believed = None
        if prior is not None:
            self._catch_leap(scan, prior)
            prior = self._at_height(prior)
            believed = self._corrected(prior) if self._is_pose(prior) and not self._reverses(prior) else None
        predicted = self._predicted(scan)
        fix = self.tracker.localise(scan, believed)
        misfit = None if prior is None else fix.registration.T_map_lidar[:3, 3] - prior.T_map_lidar[:3, 3]
        self._waiting.append(_Waiting(fix, misfit, prior))
        self._place_prior(self._waiting[-1])
        if self._leapt(fix, predicted) and not self._doubt():
            for waiting in list(self._waiting)[:-1]:
                waiting.fix = replace(waiting.fix, trusted=False)
        due = self._is_due(fix)
        if not (due and self._confirmed):  # a look costs as much as a step of the map ahead: not both in one scan
            self.map_around.prepare(fix.registration.T_map_lidar[:3, 3])
        if due:
            self._look()
            if self._confirmed and self._held:
                return self._decide(len(self._waiting), True)
        elif self._confirmed:
            return self._give_out(max(0, len(self._waiting) - self.numbers.kept))
        return self._decide(max(0, len(self._waiting) - self.numbers.wait_scans), False)

    def flush(self) -> list[Fix]:
        """See :class:`Localise`."""
        if self._waiting and self._confirmed:
            self._look()
        return self._decide(len(self._waiting), self._confirmed)

    def go_on_in(self, point_map: PointMap) -> None:
        """The map is another version from here on; the track goes on."""
        self.search.go_on_in(point_map)

    def _has_place(self, scan: Scan, prior: PosePrior | None) -> bool:
        """Search the whole map where there is nothing else to go by, or where the track has not held for long."""
        placed = prior is not None and self._is_pose(prior)
        homeless = not placed and self.tracker.last_pose is None
        self._unconfirmed = 0 if self._confirmed else self._unconfirmed + 1
        if not (homeless or self._unconfirmed >= self._next_search):
            return True
        if self._unconfirmed < self._next_search and self._unconfirmed > 1:
            return False
        self._next_search = 2 * max(self._unconfirmed, self.numbers.first_search)
        bound = self._bound(prior)
        T_map_lidar = self.search(scan, bound)
        self._failed_within = self._failed_within + 1 if T_map_lidar is None and bound is not None else 0
        if T_map_lidar is not None:
            self.tracker.move_to(T_map_lidar, scan.stamp_ns)
            has_frame = prior is not None and bound is None and not prior.is_planar
            if prior is not None and has_frame and self.prior_frame.is_far(prior, T_map_lidar):
                self._take_frame(prior, T_map_lidar)
        return T_map_lidar is not None or not homeless

    def _is_pose(self, prior: PosePrior) -> bool:
        """Whether the prior is sure enough to be tried as a pose of the scan; without a height only beside a track."""
        if self.prior_frame.is_own and not prior.is_planar:
            return True
        if prior.is_planar and self.tracker.last_pose is None:
            return False
        sure = prior.sigma_m <= self._start.sure_m and prior.sigma_rad <= self._start.sure_rad
        return sure and not self.prior_frame.is_unknown

    def _bound(self, prior: PosePrior | None) -> Bound | None:
        """The circle in which a prior that is no sure pose, or that knows no height, is searched for; None where the
        whole map is searched."""
        if prior is None or (self._is_pose(prior) and not prior.is_planar) or self.prior_frame.is_unknown:
            return None
        if self._failed_within >= self._start.bounded:
            return None
        x, y = prior.T_map_lidar[:2, 3].tolist()
        return Bound(x, y, self._start.sigmas * prior.sigma_m + self._start.beside_m)

    def _reverses(self, prior: PosePrior) -> bool:
        """Whether the heading of fixes is more than a right angle off the track: the way driven then is backwards."""
        last = self.tracker.last_pose
        return prior.is_planar and last is not None and float(prior.T_map_lidar[:2, 0] @ last[:2, 0]) < 0.0

    def _at_height(self, prior: PosePrior) -> PosePrior:
        """The prior, at the height of the track where it knows none: satellites count heights from an ellipsoid, maps
        mostly from the sea, which may differ by 100 m."""
        if not prior.is_planar or self.tracker.last_pose is None:
            return prior
        T_map_lidar = prior.T_map_lidar.copy()
        T_map_lidar[2, 3] = self.tracker.last_pose[2, 3]
        return replace(prior, T_map_lidar=T_map_lidar)

    def _take_frame(self, prior: PosePrior, T_map_lidar: F64) -> None:
        """The prior is in a frame of its own: the scans that wait were taken where their priors lie in it."""
        self.prior_frame.begin(prior, T_map_lidar)
        self.misfit = np.zeros(3)
        following = prior
        following_ns = self.tracker.last_stamp_ns
        for waiting in reversed(self._waiting):
            if waiting.prior is None:
                break
            self._place_prior(waiting)
            guess = self.prior_frame.in_map(waiting.prior).T_map_lidar
            seconds = 1e-9 * (following_ns - waiting.fix.scan.stamp_ns)
            twist = twist_between(waiting.prior.T_map_lidar, following.T_map_lidar, max(seconds, 1e-3))
            self._register_anew(waiting, guess, twist)
            following = waiting.prior
            following_ns = waiting.fix.scan.stamp_ns

    def _place_prior(self, waiting: _Waiting) -> None:
        """The prior of a scan that waits, in the frame that is known now."""
        if waiting.prior is not None and self.prior_frame.is_own:
            waiting.in_map = self.prior_frame.in_map(waiting.prior)
            waiting.begun = self.prior_frame.begun

    def _catch_leap(self, scan: Scan, prior: PosePrior) -> None:
        """A prior of its own frame that leaps away from a track that holds has begun anew: so does its frame."""
        if not self.prior_frame.is_own or not self._confirmed or self.tracker.last_pose is None:
            return
        age = 1e-9 * (scan.stamp_ns - self.tracker.last_stamp_ns)
        if age > self.tracker.numbers.twist_age_s:
            return
        predicted = self.tracker.last_pose @ exp(age * self.tracker.twist)
        if self.prior_frame.leapt(prior, predicted):
            self.prior_frame.begin(prior, predicted)

    def _corrected(self, prior: PosePrior) -> PosePrior:
        """The prior in the map's frame, without its error of late, and no more certain than that error."""
        if self.prior_frame.is_own and not prior.is_planar:
            return self.prior_frame.in_map(prior)
        T_map_lidar = prior.T_map_lidar.copy()
        T_map_lidar[:3, 3] += self.misfit
        sigma_m = max(prior.sigma_m, math.hypot(*self.misfit))
        return PosePrior(T_map_lidar, sigma_m, prior.sigma_rad, prior.is_planar)

    def _predicted(self, scan: Scan) -> tuple[F64, float] | None:
        """Where the motion of the track leads by now (4, 4), and the seconds since; None where that says little."""
        age_s = 1e-9 * (scan.stamp_ns - self.tracker.last_stamp_ns)
        last = self.tracker.last_pose
        if last is None or not self.tracker.has_motion or age_s > self.tracker.numbers.twist_age_s:
            return None
        return last @ exp(age_s * self.tracker.twist), age_s

    def _leapt(self, fix: Fix, predicted: tuple[F64, float] | None) -> bool:
        """Whether a confirmed track found the scan where no motion leads: here or before it the place was wrong."""
        if not self._confirmed or predicted is None or not fix.trusted:
            return False
        T_map_lidar, age_s = predicted
        off_m = math.dist(fix.registration.T_map_lidar[:3, 3], T_map_lidar[:3, 3])
        return off_m > self.numbers.leap_m + 0.5 * self.numbers.leap_mps2 * age_s**2

    def _is_due(self, fix: Fix) -> bool:
        last = self._looked_at
        if last is None or not self._confirmed or not fix.trusted:
            return True
        way_m = math.dist(fix.registration.T_map_lidar[:3, 3], last.registration.T_map_lidar[:3, 3])
        return way_m >= self.numbers.every_m or 1e-9 * (fix.scan.stamp_ns - last.scan.stamp_ns) >= self._every_s

    def _look(self) -> None:
        """Judge the newest fix; move the track while another place fits better."""
        verdict = self._verdict()
        for _ in range(self.numbers.jumps):
            if verdict.lead >= 0.0 or verdict.T_map_lidar_other is None:
                break
            self._move(verdict.T_map_lidar_other)
            verdict = self._verdict()
        self._looked_at = self._waiting[-1].fix
        if self._looked_at.trusted and self.judge.holds(verdict):
            self._held += 1
            self._learn_of_given()
            if not self._confirmed and self._held >= self.numbers.checks:
                self._confirmed = True
                self._follow_back()
        else:
            self._doubt()

    def _doubt(self) -> bool:
        """The track does not hold at the newest scan. Poses that were given out stand if it holds at the scan before,
        and are taken back if not. Returns which."""
        stands = self._confirmed and len(self._waiting) > 1 and self.judge.holds(self._verdict(-2))
        if stands:
            self._learn_of_given()
        for given in self._given:
            given.fix.standing.holds = False
        self._given.clear()
        self._held = 0
        self._confirmed = False
        return stands

    def _learn_of_given(self) -> None:
        """The track held: so did the scans that were given out since the last look."""
        for given in self._given:
            self._learn(given)
        self._given.clear()

    def _follow_back(self) -> None:
        """The track holds: the scans before it that have no place are registered from it backwards in time, with the
        motion of the scans after them, as far as each fits where that leads."""
        waiting = list(self._waiting)
        first = next((i for i, one in enumerate(waiting) if not one.nowhere), 0)
        twist = self.tracker.twist
        for i in range(first - 1, -1, -1):
            later = waiting[i + 1].fix
            seconds = 1e-9 * (later.scan.stamp_ns - waiting[i].fix.scan.stamp_ns)
            if i + 2 < len(waiting):
                after = waiting[i + 2].fix
                span = 1e-9 * (after.scan.stamp_ns - later.scan.stamp_ns)
                twist = twist_between(later.registration.T_map_lidar, after.registration.T_map_lidar, span)
            guess = later.registration.T_map_lidar @ exp(-seconds * twist)
            self._register_anew(waiting[i], guess, twist)
            off_m, off_rad = distance_to(guess, waiting[i].fix.registration.T_map_lidar)
            if not waiting[i].fix.trusted or off_m > self.numbers.back_m or off_rad > self.numbers.back_rad:
                waiting[i].fix = replace(waiting[i].fix, trusted=False)
                return

    def _verdict(self, of: int = -1) -> Verdict:
        fix = self._waiting[of].fix
        T_map_lidar = fix.registration.T_map_lidar
        around = self.map_around(T_map_lidar[:3, 3])
        few = (fix.sample or Sample(fix.scan)).solid(fix.twist)
        if self._confirmed:  # a track that held is held again at less cost; where it is doubted, nothing is saved
            verdict = self.judge.judge(around, few, T_map_lidar, quick=True)
            if self.judge.holds(verdict):
                return verdict
        return self.judge.judge(around, few, T_map_lidar)

    def _move(self, T_map_lidar: F64) -> None:
        """The newest scan was taken here: it and all that wait are registered anew, the track goes on from here."""
        self._doubt()
        newest = self._waiting[-1]
        shift = T_map_lidar @ inverse(newest.fix.registration.T_map_lidar)
        twist = self.tracker.twist
        if len(self._waiting) == 1 and newest.fix.scan.time_s is not None:
            self.tracker.move_to(T_map_lidar, newest.fix.scan.stamp_ns)
            around = self.map_around(T_map_lidar[:3, 3])
            sample = Sample(newest.fix.scan)
            twist = self.tracker.guess_motion(around, newest.fix.scan.stamp_ns, sample, T_map_lidar)
        for waiting in self._waiting:
            if waiting.nowhere:
                continue
            self._register_anew(waiting, shift @ waiting.fix.registration.T_map_lidar, twist)
        self._go_on()

    def _register_anew(self, waiting: _Waiting, guess: F64, twist: F64) -> None:
        before = waiting.fix.registration.T_map_lidar
        around = self.map_around(guess[:3, 3])
        result = around.refine(thin_for_levels(deskew(waiting.fix.scan, twist)), guess)
        waiting.fix = Fix(waiting.fix.scan, result, twist, self.tracker.is_sound(result))
        waiting.nowhere = False
        if waiting.misfit is not None:
            waiting.misfit = waiting.misfit + result.T_map_lidar[:3, 3] - before[:3, 3]

    def _go_on(self) -> None:
        """The track goes on from the newest scan that waits, with the motion of the last two."""
        newest = self._waiting[-1]
        twist = None
        if len(self._waiting) > 1:
            last = self._waiting[-2]
            seconds = 1e-9 * (newest.fix.scan.stamp_ns - last.fix.scan.stamp_ns)
            poses = last.fix.registration.T_map_lidar, newest.fix.registration.T_map_lidar
            twist = twist_between(*poses, seconds) if seconds <= self.tracker.numbers.twist_age_s else None
        registration = newest.fix.registration
        self.tracker.move_to(registration.T_map_lidar, newest.fix.scan.stamp_ns, twist, registration.score)

    def _give_out(self, count: int) -> list[Fix]:
        """The fixes of the oldest ``count`` scans of a confirmed track, until a look says otherwise."""
        given = [self._waiting.popleft() for _ in range(count)]
        for one in given:
            self._settle(one, one.fix.trusted)
        self._given += given
        return [one.fix for one in given]

    def _decide(self, count: int, confirmed: bool) -> list[Fix]:
        """The fixes of the oldest ``count`` scans, which nothing changes any more."""
        decided = []
        for _ in range(count):
            waiting = self._waiting.popleft()
            self._settle(waiting, waiting.fix.trusted and confirmed)
            self._learn(waiting)
            decided.append(waiting.fix)
        return decided

    def _settle(self, waiting: _Waiting, trusted: bool) -> None:
        """The fix as it is given out, its prior placed by all that was learnt before it."""
        if waiting.prior is not None and waiting.begun == self.prior_frame.begun:
            self._place_prior(waiting)
        prior = waiting.fix.prior if waiting.in_map is None else waiting.in_map
        waiting.fix = replace(waiting.fix, trusted=trusted, prior=prior)

    def _learn(self, waiting: _Waiting) -> None:
        """A trusted fix corrects the remembered error of the prior."""
        fix = waiting.fix
        if not fix.trusted or waiting.prior is None:
            return
        if waiting.misfit is not None:
            self.misfit = self.misfit + self.numbers.memory * (waiting.misfit - self.misfit)
        in_frame = waiting.begun == self.prior_frame.begun and not waiting.prior.is_planar
        if in_frame and self._is_pose(waiting.prior):
            self.prior_frame.learn(waiting.prior, fix.registration.T_map_lidar)


class GivenPoses:
    """Poses that need no improvement: a prior to be trusted, the outcome of SLAM, or the truth."""

    def __init__(self, stamps_ns: I64, T_map_lidar: F64) -> None:
        """``stamps_ns`` (n,) ascending and ``T_map_lidar`` (n, 4, 4): a pose for every scan that will come."""
        self._poses = {int(stamp): i for i, stamp in enumerate(stamps_ns)}
        self._stamps_ns = stamps_ns
        self._T_map_lidar = T_map_lidar

    def push(self, scan: Scan, prior: PosePrior | None) -> list[Fix]:
        """See :class:`Localise`: decided at once."""
        i = self._poses[scan.stamp_ns]
        twist = motion_at(self._stamps_ns, self._T_map_lidar, i)
        registration = Registration(self._T_map_lidar[i], np.zeros((6, 6)), 1.0, 1.0, 0, True)
        return [Fix(scan, registration, twist, True)]

    def flush(self) -> list[Fix]:
        """See :class:`Localise`: nothing waits."""
        return []
