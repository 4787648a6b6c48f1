"""A vehicle that votes while it drives: it takes scans and poses as they arrive and gives ballots as they close.

No ballot leaves the vehicle before the doctor's checks on the first ten seconds are done.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mapvote.codec.ballot import Ballot
from mapvote.core.grid import TileIndex, window_around
from mapvote.core.mount import Mount
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.types import F32, F64, Drive, MapvoteError, PosePrior, Scan
from mapvote.doctor import Finding, any_error, in_order
from mapvote.doctor.localised import LocalisedDrive, written_if_localised
from mapvote.doctor.map_fit import check_on_map
from mapvote.doctor.scans import NO_PRIOR, Looking, cheap_checks
from mapvote.formats.drives.fixes import FIX_RULES, Fixes
from mapvote.live.doubt import DoubtKeeper
from mapvote.live.log_lines import Repeated
from mapvote.live.outbox import Outbox
from mapvote.live.priors import Priors, pose_in, turned_by
from mapvote.live.road_map import Maps
from mapvote.live.thinning import THINNING, Thinning
from mapvote.vehicle import ClosedStretch, Cuts, RoadDriven, Vehicle, stretch_name

log = logging.getLogger("mapvote.live")


@record()
@dataclass(frozen=True, slots=True)
class LiveRule:
    """Numbers of a live drive."""

    fixes: int = 400
    """Poses of scans that voted that are kept at most."""
    shown: int = 64
    """Votes on single tiles that wait to be shown at most."""
    patience_ns: int = 300_000_000
    """Time that a scan waits for a pose later than its own stamp, nanoseconds; then the newest ones are extrapolated,
    or it has none."""
    back_ns: int = 10**9
    """Step of a stamp back after which the clock has jumped, nanoseconds."""
    ahead_ns: int = 3600 * 10**9
    """Step of a stamp ahead after which the clock has jumped, nanoseconds."""
    jumped: int = 3
    """Odd stamps in turn that make a jump; a single one is late or damaged."""
    checked_ns: int = 10 * 10**9
    """First part of a drive that the doctor checks, nanoseconds."""
    kept_every: int = 4
    """Scans of that part of which one is kept for the check: 30 MB."""
    sick_share: float = 0.5
    """Share of scans with a sure place below which the fit of the drive to the map is checked."""
    latencies: int = 6000
    """Latencies that are kept: ten minutes at 10 Hz."""


LIVE_RULE = LiveRule()


class WaitingScan(NamedTuple):
    """A scan that arrived."""

    stamp_ns: int
    sent_ns: int
    """When it was sent, by the clock of this machine; latency counts from the stamp where that agrees, else from
    here."""
    read: Callable[[], Scan]
    """Raises MapvoteError if it cannot be used."""


class Fixed(NamedTuple):
    """Where a scan was taken, once it is sure."""

    stamp_ns: int
    T_map_lidar: F64
    covariance: F32
    """(6, 6) as :class:`mapvote.core.types.Registration` has it."""


@dataclass(slots=True)
class Counts:
    """The outcome of every scan that arrived."""

    scans: int = 0
    observed: int = 0
    localised: int = 0
    """Scans that voted."""
    lost: int = 0
    """Scans without a sure place: they cast no vote."""
    left_out: int = 0
    """Because the computer was too slow."""
    missing: int = 0
    """Scans that never arrived: counted from the gaps between stamps."""
    unusable: int = 0
    """Damaged, or without a usable point."""
    late: int = 0
    """Not later than the last one."""
    without_pose: int = 0
    """Scans that odometry does not cover; they are localised without a prior."""
    without_map: int = 0
    """Left out because tiles around the vehicle had not come yet."""
    clock_jumps: int = 0
    ballots: int = 0


class FirstSeconds:
    """Some scans of the first ten seconds, and the findings on them."""

    def __init__(self, sensor_told: str) -> None:
        self._told = sensor_told
        self._kept: dict[int, Scan] = {}
        self._stamps_ns = list[int]()
        self._priors = list[F64 | None]()
        self._looking: Looking | None = None

    def add(self, scan: Scan, T_map_lidar_prior: F64 | None, vehicle: Vehicle) -> bool:
        """Look at this scan; returns whether the ten seconds are over."""
        if self._looking is None:
            self._looking = Looking(self._drive(vehicle))
        n = len(self._stamps_ns)
        self._stamps_ns.append(scan.stamp_ns)
        self._priors.append(T_map_lidar_prior)
        self._kept[n] = scan
        self._looking.look([n])
        if n % LIVE_RULE.kept_every:
            del self._kept[n]
        return scan.stamp_ns - self._stamps_ns[0] >= LIVE_RULE.checked_ns

    def _drive(self, vehicle: Vehicle) -> Drive:
        priors = [T for T in self._priors if T is not None]
        return Drive(
            Path("the first seconds"),
            vehicle.name,
            vehicle.drive_id,
            vehicle.sensor,
            np.array(self._stamps_ns, dtype=np.int64),
            lambda i: self._kept[i] if i in self._kept else self._kept[i - i % LIVE_RULE.kept_every],
            np.stack(priors) if priors and len(priors) == len(self._stamps_ns) else None,
            sensor_told=self._told,
        )

    def findings(self, vehicle: Vehicle, point_map: PointMap) -> list[Finding]:
        """Faults of the scans themselves and, if the vehicle finds no sure place, their fit to the map."""
        if self._looking is None:
            return []
        frame = vehicle.prior_frame
        if frame is not None and frame.is_unknown:
            self._priors = [None] * len(self._priors)
        elif frame is not None and frame.is_own:
            self._priors = [None if T is None else frame.T_map_prior @ T for T in self._priors]
        drive = self._drive(vehicle)
        findings = [f for f in cheap_checks(drive, self._looking.look([])) if f != NO_PRIOR]
        report = vehicle.report
        decided = len(report.T_map_lidar)
        if decided and len(report.lost) > LIVE_RULE.sick_share * decided and not any_error(findings):
            findings += self._on_map(drive, point_map, len(report.lost), decided)
        return in_order(findings)

    def _on_map(self, drive: Drive, point_map: PointMap, lost: int, decided: int) -> list[Finding]:
        problem = f"{lost} of the first {decided} scans are not localised on map {point_map.map_id}"
        lost_scans = Finding("warning", problem, "they cast no vote; is this the map of this road?")
        if drive.T_map_lidar_prior is None:
            return [lost_scans]
        try:
            findings = check_on_map(drive, drive.T_map_lidar_prior, point_map)[0]
        except MapvoteError as error:
            return [lost_scans, Finding("warning", str(error))]
        return [lost_scans, *findings]


class LiveDrive:
    """One vehicle on a drive without an end."""

    def __init__(
        self,
        make_vehicle: Callable[[PointMap], Vehicle],
        maps: Maps,
        outbox: Outbox,
        *,
        name: str,
        cuts: Cuts | None = None,
        with_poses: bool = True,
        T_base_lidar: F64 | None = None,
        first: FirstSeconds | None = None,
    ) -> None:
        """``make_vehicle`` makes a vehicle that has driven nowhere yet. ``with_poses``: scans wait for odometry's.
        ``T_base_lidar`` (4, 4): the LiDAR on what odometry tracks. ``first``: no ballot leaves before
        :meth:`first_findings` was asked, and none of a stretch on which the vehicle did not know where it was. Without
        it nothing is checked."""
        self.counts, self._maps, self._outbox = Counts(), maps, outbox
        self.latencies_s: deque[float] = deque(maxlen=LIVE_RULE.latencies)
        """From stamp to vote, of the last scans that voted during the drive. Those of its last second vote at its
        end."""
        self._make_vehicle, self._cuts, self._with_poses = make_vehicle, cuts or Cuts(), with_poses
        self.T_base_lidar = np.eye(4) if T_base_lidar is None else T_base_lidar
        self.mount: Mount | None = None
        """The mount by which scans are turned upright; None: they are as measured."""
        self._place: F64 | None = None
        """(3,) where the last scan was that has a place, map metres."""
        self._is_lost = False
        """Whether the last decided scan has no place."""
        self.prior_in_map = True
        """Whether odometry is in the map's frame. Where it is not, its frame is learnt."""
        self._frames_begun = 0
        """How often a frame of odometry was told."""
        self.name, self.number = name, outbox.begin(name)
        self.vehicle: Vehicle | None = None
        """None until the first scan: the map around it may have to come first."""
        self._road = RoadDriven(self._cuts)
        self._priors = Priors()
        self._waiting = deque[WaitingScan]()
        self._observed = deque[tuple[int, int]]()
        """Stamp and time of sending of the scans that are observed but not done."""
        self.fixes: deque[Fixed] = deque(maxlen=LIVE_RULE.fixes)
        """Fixes of the scans that voted last. The publisher of a fix removes it."""
        self.kept: deque[Ballot] = deque(maxlen=LIVE_RULE.shown)
        """The last votes on single tiles that went to the journal. The reader that shows them removes them."""
        self._touched: dict[TileIndex, float] = {}
        """Tiles with votes that are not in the journal, and since when."""
        self._next_piece_s = 0.0
        """When the next of them may go there, by the steady clock."""
        self._thinning, self._last_ns, self._odd_stamps, self._finished = Thinning(), -1, 0, 0
        self._period_ns = 0
        """Between scans: the shortest recent step."""
        self._repeated = Repeated(log.warning)
        self.first = first
        """None once :meth:`first_findings` was asked."""
        self._checked = first is not None
        self.doubt: DoubtKeeper | None = None
        """Keeps the clouds around doubtful changes; None: none are kept."""
        self._held = list[tuple[str, Callable[[], Ballot], str | None]]()
        self.checked_now = False
        """Whether the first seconds are over and their findings were not asked for."""

    @property
    def drive_id(self) -> str:
        """Identifier of the open ballot."""
        return stretch_name(self.name, self.number)

    @property
    def T_base_upright(self) -> F64:
        """(4, 4) T_base_lidar of the axes in which scans are given."""
        return self.T_base_lidar if self.mount is None else np.asarray(self.T_base_lidar @ self.mount.C.T)

    @property
    def place(self) -> F64 | None:
        """(3,) where the last scan was that has a place, map metres."""
        return self._place

    @property
    def waiting(self) -> int:
        """Scans that arrived and were not observed yet."""
        return len(self._waiting)

    def on_pose(self, time_ns: int, T_map_base: F64) -> None:
        """One pose of odometry in the map's frame, in any order."""
        back_s = self._priors.add(time_ns, T_map_base)
        if back_s:
            self._repeated("odometry", f"odometry's clock jumped back by {back_s:.1f} s")

    def on_fixes(self, fixes: Fixes) -> None:
        """The last fixes of the receiver, of which some may have come before."""
        self._priors.fixes = fixes

    def on_scan(self, scan: WaitingScan) -> None:
        """One scan, as it arrives. It is left out if it is not later than the last one, or if too many wait."""
        self.counts.scans += 1
        step_ns = scan.stamp_ns - self._last_ns
        if self._last_ns >= 0 and (step_ns < -LIVE_RULE.back_ns or step_ns > LIVE_RULE.ahead_ns):
            self._odd_stamps += 1
            if self._odd_stamps < LIVE_RULE.jumped:
                self.counts.late += 1
                return
            self._jump(step_ns)
        elif step_ns <= 0:
            self.counts.late += 1
            self._repeated("late", f"a scan at {scan.stamp_ns} ns is not later than the last one: left out")
            return
        elif self._last_ns >= 0 and self._period_ns:
            self.counts.missing += max(0, round(step_ns / self._period_ns) - 1)
        if 0 < step_ns < LIVE_RULE.back_ns:
            self._period_ns = step_ns if not self._period_ns else min(step_ns, int(1.02 * self._period_ns))
        self._odd_stamps = 0
        self._last_ns = scan.stamp_ns
        if self._thinning.admits(1e-9 * scan.sent_ns, len(self._waiting)):
            self._waiting.append(scan)
        else:
            self.counts.left_out += 1

    def _jump(self, step_ns: int) -> None:
        """The clock jumped. The scans before the jump vote, their ballot is closed, and a new track begins."""
        self.counts.clock_jumps += 1
        log.warning("the sensor's clock jumped by %.1f s: a new ballot begins", 1e-9 * step_ns)
        while self.step(ended=True):
            pass
        if self.vehicle is not None:
            self.vehicle.finish()
            self._count_votes(self.vehicle, ended=True)
            self._leave(self.vehicle.last_stretch())
        self.vehicle = None
        self._place = None
        self._observed.clear()
        if self.doubt is not None:
            self.doubt.forget()
        self._priors.jump_to(self._last_ns + step_ns)

    def step(self, *, ended: bool = False) -> bool:
        """Vote with the oldest scan that waits, if its pose is known; returns whether there was one. If none waits, or
        a tile's votes have been unwritten for too long, a tile goes to the journal."""
        start = time.monotonic()
        ready = self._is_ready(ended)
        sizes = self._outbox.sizes
        overdue_s = start - min(self._touched.values(), default=np.inf) - sizes.journal_s
        due = start >= self._next_piece_s or overdue_s > sizes.journal_s
        if self.vehicle is not None and due and overdue_s > (2.0 if ready else 0.0):
            self._keep_tile(self.vehicle)
            taken_s = time.monotonic() - start
            self._next_piece_s = start + taken_s / sizes.journal_share
        if not ready:
            return False
        waiting = self._waiting.popleft()
        self._priors.forget_before(waiting.stamp_ns)
        self._observe(waiting)
        self._thinning.cost(time.monotonic() - start)
        self.counts.left_out += self._thinning.shed(self._waiting)
        return True

    def _keep_tile(self, vehicle: Vehicle) -> None:
        """Give the votes of the tile that has waited longest to the journal."""
        tile = min(self._touched, key=lambda index: self._touched[index])
        del self._touched[tile]
        kept = vehicle.ballot([tile])
        if self.doubt is not None:
            kept = self.doubt.marked(self.drive_id, kept, vehicle.point_map.lattice)
        self._outbox.keep(self.drive_id, kept)
        self.kept.append(kept)

    def end(self) -> None:
        """No scan comes any more: every scan that arrived is decided. No ballot leaves yet."""
        while self.step(ended=True):
            pass
        if self.vehicle is not None:
            self.vehicle.finish()
            self._count_votes(self.vehicle, ended=True)

    def finish(self) -> None:
        """The drive has ended: the scans that wait vote, and the last ballot leaves."""
        self.end()
        if self.vehicle is not None:
            self.counts.ballots += 1
            self._held.append((self.drive_id, self._written(self.vehicle.last_stretch()), None))
            self._release()

    def first_findings(self) -> list[Finding]:
        """The findings of the first seconds. Ballots that waited for them leave, unless one is an error. Empty if it
        was asked before, or nothing was observed."""
        first = self.first
        self.first = None
        self.checked_now = False
        if first is None or self.vehicle is None:
            return []
        findings = first.findings(self.vehicle, self.vehicle.point_map)
        if not any(finding.severity == "error" for finding in findings):
            self._release()
        return findings

    def _release(self) -> None:
        for closed in self._held:
            self._outbox.leave(*closed)
        self._held.clear()

    def discard(self) -> None:
        """The drive is useless: no ballot of it leaves, and its journal is deleted."""
        self.vehicle = None
        self._held.clear()
        for number in range(1, self.number + 1):
            self._outbox.discard(stretch_name(self.name, number))

    def _is_ready(self, ended: bool) -> bool:
        """Whether a scan waits, and neither a pose later than it nor the map around it may still come."""
        if not self._waiting:
            return False
        scan = self._waiting[0]
        unknown = not self._priors.covers(scan.stamp_ns)
        if (
            self._with_poses
            and not ended
            and unknown
            and self._waiting[-1].stamp_ns - scan.stamp_ns < LIVE_RULE.patience_ns
        ):
            return False
        if ended or self.vehicle is not None or len(self._waiting) > THINNING.crowded:
            return True
        return self._maps.covers(self._position(self._prior(scan.stamp_ns)))

    def _observe(self, waiting: WaitingScan) -> None:
        try:
            scan = waiting.read()
        except MapvoteError as error:
            self.counts.unusable += 1
            self._repeated("unusable", str(error))
            return
        prior = self._prior(waiting.stamp_ns)
        self.counts.without_pose += self._with_poses and prior is None
        position = self._position(prior)
        if not self._maps.covers(position):
            newest = self._maps.current()
            if self.vehicle is None or newest is self.vehicle.point_map or not self._maps.covers(position):
                self.counts.without_map += 1
                return
            self._cut(self.vehicle, newest)  # the version of the open ballot ends here, a newer one does not
        if self.vehicle is None:
            self.vehicle = self._make_vehicle(self._maps.current())
            self._frames_begun = 0
            if not self.prior_in_map:
                self.vehicle.expect_own_frame()
            self.vehicle.drive_id, self._road, self._finished = self.drive_id, RoadDriven(self._cuts), 0
        vehicle = self.vehicle
        if self.first is not None:
            self.checked_now = self.first.add(scan, _sure_pose(prior), vehicle)
        self._observed.append((waiting.stamp_ns, waiting.sent_ns))
        self.counts.observed += 1
        if self.doubt is not None:
            self.doubt.add(waiting.stamp_ns, scan.points)
        vehicle.observe(scan, prior)
        self._count_votes(vehicle)
        if self._road.is_full(vehicle.report, vehicle.done):
            self._cut(vehicle, self._maps.current())

    def _cut(self, vehicle: Vehicle, newest: PointMap) -> None:
        self._road = RoadDriven(self._cuts)
        self._finished = 0
        self._leave(vehicle.cut(stretch_name(self.name, self.number + 1), newest))

    def _position(self, prior: F64 | PosePrior | None) -> F64 | None:
        """(3,) where the vehicle is by its last scan that has a place, while scans find theirs; else by its prior. None
        where neither says."""
        T = pose_in(prior)
        by_prior = None if T is None else self._in_map(T)
        if self._place is None or (self._is_lost and by_prior is not None):
            return None if by_prior is None else np.asarray(by_prior[:3, 3])
        return self._place

    def _in_map(self, prior: F64) -> F64 | None:
        """The prior in the map's frame; None while it is not known where its own frame lies."""
        frame = None if self.vehicle is None else self.vehicle.prior_frame
        if frame is not None and frame.is_own:
            return np.asarray(frame.T_map_prior @ prior)
        return prior if self.prior_in_map else None

    def _count_votes(self, vehicle: Vehicle, *, ended: bool = False) -> None:
        """Latencies of the scans that are done, unless the drive has ended, and the tiles that they voted on."""
        report = vehicle.report
        now_ns = time.time_ns()
        now_s = time.monotonic()
        lost = set(report.lost) if vehicle.done > self._finished else set()
        for i in range(self._finished, vehicle.done):
            stamp_ns, sent_ns = self._observed.popleft()
            self._is_lost = i in lost
            if self.doubt is not None:
                self.doubt.placed(stamp_ns, None if self._is_lost else report.T_map_lidar[i])
            if self._is_lost:
                self.counts.lost += 1
                continue
            self._place = report.T_map_lidar[i][:3, 3]
            self.counts.localised += 1
            self.fixes.append(Fixed(stamp_ns, report.T_map_lidar[i], report.covariances[i]))
            since_ns = stamp_ns if abs(sent_ns - stamp_ns) < 5 * 10**9 else sent_ns
            if not ended:
                self.latencies_s.append(1e-9 * (now_ns - since_ns))
            x, y = report.T_map_lidar[i][:2, 3]
            window = window_around(vehicle.point_map.lattice, x, y, vehicle.settings.voting.window_m)
            for tile in window.tiles():
                self._touched.setdefault(tile, now_s)
        self._finished = vehicle.done
        self._tell_frame(vehicle)

    def expect_own_frame(self) -> None:
        """Odometry turns out to be in a frame of its own: it is learnt."""
        self.prior_in_map = False
        if self.vehicle is not None:
            self.vehicle.expect_own_frame()

    def _tell_frame(self, vehicle: Vehicle) -> None:
        """Log the frame of odometry where it was taken anew."""
        frame = vehicle.prior_frame
        if frame is not None and frame.begun > self._frames_begun:
            self._frames_begun = frame.begun
            self._repeated("frame", f"odometry is in a frame of its own. Its origin in the map: {frame.told()}")

    def _written(self, stretch: ClosedStretch) -> Callable[[], Ballot]:
        """A function that writes the ballot of a closed stretch."""
        if self.doubt is not None:
            stretch = stretch._replace(written=self.doubt.flagging(stretch.drive_id, stretch.written))
        if not self._checked:
            return stretch.written
        localised = LocalisedDrive.of_report(stretch.report, prior_in_map=stretch.prior_in_map)
        return written_if_localised(stretch.written, localised, stretch.point_map)

    def _leave(self, stretch: ClosedStretch) -> None:
        """A ballot is closed, and the next one begins."""
        closed = self.drive_id
        self.number += 1
        self.counts.ballots += 1
        self._touched.clear()
        self._held.append((closed, self._written(stretch), self.drive_id))
        if self.first is None:
            self._release()

    def _prior(self, time_ns: int) -> F64 | PosePrior | None:
        # The mount last, as in a recorded drive: equal to the last bit.
        return turned_by(self._priors.at(time_ns, self.T_base_lidar), self.mount)


def _sure_pose(prior: F64 | PosePrior | None) -> F64 | None:
    """The pose of a prior whose heading is known; a fix alone has none that the doctor could examine."""
    unsure = isinstance(prior, PosePrior) and prior.sigma_rad > FIX_RULES.known_rad
    return None if unsure else pose_in(prior)
