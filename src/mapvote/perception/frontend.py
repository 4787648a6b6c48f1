"""The pipeline of a scan: its pose, obstacles above the ground, moving objects, and the voxels that its rays saw.

    localise and de-skew -> to the map's frame -> find the ground -> find moving objects -> wait -> cast the rays

Vehicles, the making of maps and experiments all go this way. Scans go in one by one; observations come out in the same
order, each once its place is confirmed and the moving-object filter has decided it, a second or two later.
"""

from __future__ import annotations

import time
from bisect import insort
from collections import deque
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from math import ceil
from typing import Protocol

import numpy as np

from mapvote.core.point_map import PointMap
from mapvote.core.points import Fields
from mapvote.core.record import record
from mapvote.core.reference import LocalMap
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I32, I64, Bool, MapvoteError, PosePrior, Reference, Scan
from mapvote.matching.localiser import Localise
from mapvote.matching.odometry import Fix, Standing
from mapvote.perception.placement import ONE_LIDAR, LidarPart, cells_and_obstacles, lidar_parts, place_points
from mapvote.perception.raycast import ScanView, Sky, cast_rays


@record()
@dataclass(frozen=True, slots=True)
class Spread:
    """How the work of confirmed scans is spread."""

    calls: int = 6
    """Calls within which a confirmed scan is worked on. The check that first confirms a track gives out several scans,
    each later one three: one of them is taken with each call."""


SPREAD = Spread()


class MoversFilter(Protocol):
    """Which points move: :class:`mapvote.perception.moving_objects.MovingFilter`, or anything with its methods."""

    def push(
        self, rows: F32, origin_map: F64, obstacle: Bool, stamp_ns: int, lidars: tuple[LidarPart, ...] = ONE_LIDAR
    ) -> list[Bool]: ...

    def flush(self) -> list[Bool]: ...

    def forget(self, count: int) -> None: ...


@dataclass(slots=True)
class DriveReport:
    """Statistics of a drive."""

    stamps_ns: list[int] = field(default_factory=list)
    """Each scan's stamp."""
    lost: list[int] = field(default_factory=list)
    """Indices of scans that abstained because the vehicle was not sure where it was."""
    observed: list[F64] = field(default_factory=list)
    """(3, 3) covariance of the position of each scan that was observed: one that still waits for the filter is not in
    it yet."""
    T_map_lidar: list[F64] = field(default_factory=list)
    """Pose of every scan that is decided; the best guess for a lost one."""
    covariances: list[F32] = field(default_factory=list)
    """(6, 6) of each of these poses, as :class:`mapvote.core.types.Registration` has it."""
    priors: list[PosePrior | None] = field(default_factory=list)
    """Each scan's prior."""
    stage_s: dict[str, list[float]] = field(default_factory=dict)
    """CPU seconds of every scan by stage: localise, ground, moving, see, vote. All stages run on one thread."""

    @property
    def scans(self) -> int:
        """How many scans were observed."""
        return len(self.stamps_ns)

    def sigmas_m(self, newest: int = 0) -> F64:
        """(n,) position sigma of each scan that was observed, the largest over all directions; of the ``newest`` ones,
        unless that is 0. All at once, for whoever asks: an eigenvalue for each scan would take a 200th of its time."""
        covariances = np.array(self.observed[-newest:]).reshape(-1, 3, 3)
        return np.asarray(np.sqrt(np.linalg.eigvalsh(covariances)[:, -1]))

    def length_m(self) -> float:
        """Road driven between scans in turn that were both localised."""
        steps = np.linalg.norm(np.diff([T[:3, 3] for T in self.T_map_lidar], axis=0), axis=1)
        localised = np.ones(len(self.T_map_lidar), dtype=np.bool_)
        localised[self.lost] = False
        return float(steps[localised[1:] & localised[:-1]].sum())

    def driven(self) -> list[F64]:
        """(3,) each: where the sensor was, map metres, of the scans that were localised."""
        lost = set(self.lost)
        return [T[:3, 3] for i, T in enumerate(self.T_map_lidar) if i not in lost]

    def prior_misfit_m(self) -> float | None:
        """Median distance in the plane between fix and prior of the scans that were localised; None without priors."""
        lost = set(self.lost)
        off = [
            float(np.linalg.norm(T[:2, 3] - prior.T_map_lidar[:2, 3]))
            for i, (T, prior) in enumerate(zip(self.T_map_lidar, self.priors, strict=False))
            if prior is not None and i not in lost
        ]
        return float(np.median(off)) if off else None

    def prior_sigma_m(self) -> float | None:
        """The standard deviation that the priors state; None without priors."""
        sigmas_m = [prior.sigma_m for prior in self.priors if prior is not None]
        return float(np.median(sigmas_m)) if sigmas_m else None

    def turn(self, C: F64) -> None:
        """Poses and priors T become T C (4, 4): those of a sensor in other axes."""
        self.T_map_lidar[:] = [np.asarray(T @ C) for T in self.T_map_lidar]
        self.priors[:] = [p and replace(p, T_map_lidar=np.asarray(p.T_map_lidar @ C)) for p in self.priors]

    def split(self, n: int) -> DriveReport:
        """Keep the first ``n`` scans, all of which have voted or are lost; returns the report of those after them."""
        later = DriveReport(
            self.stamps_ns[n:],
            [i - n for i in self.lost if i >= n],
            [],
            self.T_map_lidar[n:],
            self.covariances[n:],
            self.priors[n:],
        )
        del self.stamps_ns[n:], self.T_map_lidar[n:], self.covariances[n:], self.priors[n:]
        self.lost = [i for i in self.lost if i < n]
        return later

    def timed(self, stage: str) -> _Timed:
        """Enter what it encloses as the time of one scan in this stage."""
        return _Timed(self.stage_s.setdefault(stage, []))


class _Timed:
    """The CPU time of what it encloses. A class, entered five times a scan: a generator would take longer."""

    __slots__ = ("_seconds", "_start")

    def __init__(self, seconds: list[float]) -> None:
        self._seconds = seconds

    def __enter__(self) -> None:
        self._start = time.thread_time()

    def __exit__(self, *raised: object) -> None:
        if raised[0] is None:
            self._seconds.append(time.thread_time() - self._start)


@dataclass(frozen=True, slots=True)
class PlacedScan:
    """A scan in the map's frame."""

    index: int
    """Its number in the drive; lost scans count."""
    rows: F32
    """(3, n) metres from ``origin_map`` along the map's axes, de-skewed."""
    origin_map: F64
    """(3,) the sensor, map metres; of a sweep the first LiDAR."""
    up_map: F64
    """(3,) the sensor's own upward axis, in the map's frame."""
    position_covariance: F64
    """(3, 3) of the position, square metres."""
    reference: Reference
    """The map that separated its points from the ground."""
    outer: Reference
    """The planes around the vehicle that ``reference`` was cut from."""
    obstacle: Bool
    """(n,) points that stand above the ground of ``reference``; none outside it."""
    cell: I32
    """(n,) each point's cell in ``reference``, row * cols + col; -1 outside it."""
    lidars: tuple[LidarPart, ...] = ONE_LIDAR
    """The LiDARs that took it: their rays begin at different places."""
    fields: Fields = field(default_factory=dict)
    """Attributes (n,) of the points that the sensor measures."""
    forward_map: F64 = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    """(3,) the sensor's own x axis, in the map's frame."""
    standing: Standing = field(default_factory=Standing)
    """Whether its pose still stands."""

    @property
    def points_map(self) -> F64:
        """(n, 3) map metres: computed anew."""
        return self.points_at(np.arange(self.rows.shape[1]))

    def points_at(self, chosen: I64) -> F64:
        """(m, 3) map metres of the points with these indices (m,)."""
        points = np.empty((len(chosen), 3))
        for row, begin, axis in zip(self.rows, self.origin_map, points.T, strict=True):
            np.add(row.take(chosen), begin, out=axis)
        return points


@dataclass(frozen=True, slots=True)
class Observation:
    """The observation of one localised scan."""

    scan: PlacedScan
    moving: Bool
    """(n,) points of moving objects."""
    view: ScanView
    """Hits and voxels that rays passed, over ``reference.grid``."""
    reference: Reference
    """The partial reference map R_i (paper III-A) that the scan is compared with."""


class Frontend:
    """One vehicle's sensor on one drive. Memory is bounded: the scans of a second wait, and the map around the vehicle.

    ``ground`` separates points from the ground, and is the filter's window; rays are cast in ``compared``, by
    default the same window, and hits and sight only ``with_sight``, which surfaces do not ask for. ``localise`` and
    ``movers`` as above, with a state of their own: fresh ones for each drive. ``sensor``: follow its rays without
    return, too.
    """

    def __init__(
        self,
        localise: Localise,
        movers: MoversFilter,
        ground: LocalMap,
        compared: LocalMap | None = None,
        *,
        with_sight: bool = True,
        sensor: Sensor | None = None,
        spread: Spread = SPREAD,
    ) -> None:
        self.report = DriveReport()
        self._spread = spread
        self._confirmed: deque[Fix] = deque()
        """Fixes whose scans wait for their turn."""
        self._localise = localise
        self._movers = movers
        self._ground = ground
        self._compared = compared
        self._with_sight = with_sight
        self._sky = None if sensor is None else Sky(sensor)
        self._waiting: deque[PlacedScan] = deque()
        self._ended = False

    def observe(self, scan: Scan, prior: PosePrior | None = None) -> list[Observation]:
        """Take in one scan; returns the observations that are now decided, of scans that came earlier.

        Raises MapvoteError after :meth:`finish`.
        """
        if self._ended:
            raise MapvoteError("this drive has ended: begin the next one with a new Vehicle")
        report = self.report
        report.stamps_ns.append(scan.stamp_ns)
        report.priors.append(prior)
        with report.timed("localise"):
            self._confirmed.extend(self._localise.push(scan, prior))
        self._take_back()
        turns = ceil(len(self._confirmed) / self._spread.calls)
        return [seen for _ in range(turns) for seen in self._take(self._confirmed.popleft())]

    def finish(self) -> list[Observation]:
        """The drive has ended: the observations that still wait, decided with less than the full look ahead."""
        self._ended = True
        with self.report.timed("localise"):
            self._confirmed.extend(self._localise.flush())
        self._take_back()
        decided = [seen for fix in self._confirmed for seen in self._take(fix)]
        self._confirmed.clear()
        return decided + self._see(self._movers.flush())

    @property
    def done(self) -> int:
        """How many of the report's scans have voted or are lost; those after them still wait."""
        return self._waiting[0].index if self._waiting else len(self.report.T_map_lidar)

    def cut(self) -> DriveReport:
        """The report of the scans that are done; those that still wait are the first of the drive from here on."""
        done = self.report
        n = self.done
        self.report = done.split(n)
        self._waiting = deque(replace(scan, index=scan.index - n) for scan in self._waiting)
        return done

    def go_on_in(self, point_map: PointMap) -> None:
        """From here on the map is another version: scans that wait are compared with it, too."""
        self._ground = self._ground.on(point_map)
        if self._compared is not None:
            self._compared = self._compared.on(point_map)
        for i, scan in enumerate(self._waiting):
            reference, outer = self._ground.at(scan.origin_map)
            cell, obstacle = cells_and_obstacles(scan.rows, scan.origin_map, reference)
            self._waiting[i] = replace(scan, reference=reference, outer=outer, obstacle=obstacle, cell=cell)

    def _take(self, fix: Fix) -> list[Observation]:
        """One more scan is decided: a lost scan casts no vote."""
        report = self.report
        index = len(report.T_map_lidar)
        report.T_map_lidar.append(fix.registration.T_map_lidar)
        report.covariances.append(fix.registration.covariance.astype(np.float32))
        if fix.prior is not None:
            report.priors[index] = fix.prior
        if not (fix.trusted and fix.standing.holds):
            report.lost.append(index)
            return []
        with report.timed("ground"):
            placed = self._place(fix, index)
        self._waiting.append(placed)
        with report.timed("moving"):
            stamp_ns = fix.scan.stamp_ns
            decided = self._movers.push(placed.rows, placed.origin_map, placed.obstacle, stamp_ns, placed.lidars)
        return self._see(decided)

    def _place(self, fix: Fix, index: int) -> PlacedScan:
        scan = fix.scan
        T_map_lidar = fix.registration.T_map_lidar
        origin_map = scan.origin_map(T_map_lidar)
        reference, outer = self._ground.at(origin_map)
        rows, cell, obstacle = place_points(scan, fix.twist, T_map_lidar, origin_map, reference)
        forward_map, _, up_map = T_map_lidar[:3, :3].T
        lidars = lidar_parts(scan, T_map_lidar[:3, :3])
        return PlacedScan(
            index,
            rows,
            origin_map,
            up_map,
            fix.registration.covariance[:3, :3],
            reference,
            outer,
            obstacle,
            cell,
            lidars,
            scan.fields,
            forward_map,
            fix.standing,
        )

    def _take_back(self) -> None:
        """The newest scans whose poses stand no longer are lost."""
        count = 0
        while self._waiting and not self._waiting[-1].standing.holds:
            insort(self.report.lost, self._waiting.pop().index)
            count += 1
        self._movers.forget(count)

    def _see(self, decided: list[Bool]) -> list[Observation]:
        """The oldest scans that wait, one for each mask of moving points (n,)."""
        out = []
        for moving in decided:
            scan = self._waiting.popleft()
            self.report.observed.append(scan.position_covariance)
            with self.report.timed("see"):
                reference = scan.reference if self._compared is None else self._compared.at(scan.origin_map)[0]
                views = [self._view_of(scan, lidar, moving, reference) for lidar in scan.lidars]
                view = reduce(ScanView.joined, views)
            out.append(Observation(scan, moving, view, reference))
        return out

    def _view_of(self, scan: PlacedScan, lidar: LidarPart, moving: Bool, reference: Reference) -> ScanView:
        """The view of one of the scan's LiDARs."""
        own = lidar.part
        cell = scan.cell[own] if self._compared is None else None
        sky = None
        if self._sky is not None and lidar.by_first:
            sky = partial(self._sky.rays, scan.up_map, scan.forward_map)
        rows = lidar.own_rows(scan.rows)
        origin_map = lidar.origin_map(scan.origin_map)
        return cast_rays(rows, origin_map, scan.obstacle[own], moving[own], reference, cell, self._with_sight, sky)
