"""The vehicle's side (paper III): scans go in one by one, a ballot comes out.

One pass over a drive can serve several voters (the paper's five cases, other occlusion rules, columns): what a scan
saw is worked out once, and each voter counts by its own settings.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from mapvote.codec.ballot import Ballot, BallotTile, content_hash, pack_plane, tile_key
from mapvote.config import Settings, VotingSettings
from mapvote.core.geometry import transform
from mapvote.core.grid import TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.reference import LocalMap, reference_window
from mapvote.core.sensors import Sensor
from mapvote.core.types import F64, I32, U64, Bool, CellState, Drive, MapvoteError, Reference, Scan
from mapvote.core.voting import to_wire
from mapvote.detection.new_points import NewPoints, points_in, select
from mapvote.detection.voters import Detectors
from mapvote.detection.votes import Observation, TileVotes
from mapvote.localisation.ndt import PosePrior
from mapvote.localisation.tracker import Fix, MapWindow, Tracker
from mapvote.perception.moving_objects import MovingFilter
from mapvote.perception.raycast import cast_rays, find_obstacles

POINTS_REACH_M = 70.0
"""New points are taken up to here, farther than votes are cast: a tile's width around the vehicle is laid out."""


Localise = Callable[[Scan, PosePrior | None], Fix]
"""Where was this scan taken? ``Tracker.localise`` by NDT, or :class:`GivenPoses`. An untrusted fix casts no vote."""


Watch = Callable[[F64, F64, Bool, Bool], None]
"""Told of every scan that votes: (points (n, 3) and sensor (3,) in map metres, above ground (n,), moving (n,))."""


class Movers(Protocol):
    """Which points move: :class:`mapvote.perception.moving_objects.MovingFilter`, or anything with its two methods."""

    def push(self, points_map: F64, origin_map: F64, obstacle: Bool, stamp_ns: int) -> list[tuple[int, Bool]]: ...

    def flush(self) -> list[tuple[int, Bool]]: ...


@dataclass(slots=True)
class DriveReport:
    """How a drive went."""

    scans: int = 0
    lost: list[int] = field(default_factory=list)
    """Indices of scans that abstained because the vehicle was not sure where it was."""
    sigmas_m: list[float] = field(default_factory=list)
    """Position sigma of each scan that voted."""
    T_map_lidar: list[F64] = field(default_factory=list)
    """Pose of every scan; of a lost one the best guess."""
    stage_s: dict[str, list[float]] = field(default_factory=dict)
    """CPU seconds of every scan by stage: localise, ground, moving, see, vote. All of it runs on one thread."""

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        start = time.thread_time()
        yield
        self.stage_s.setdefault(stage, []).append(time.thread_time() - start)


@dataclass(frozen=True, slots=True)
class _Waiting:
    """A localised scan that waits for the moving-object filter to decide."""

    points_map: F64
    origin_map: F64
    sigma_m: float
    reference: Reference
    outer: Reference
    unmapped: U64
    """Over ``outer``: voxels that the map does not hold."""
    obstacle: Bool
    cell: I32


class Vehicle:
    """One vehicle on one drive.

    ``voters``: the settings of every voter, default only ``settings.voting``. ``localise``: default NDT in
    ``point_map``. ``movers``: default the occupancy filter of :mod:`mapvote.perception.moving_objects`.
    ``watch``: whoever wants to see the scans that vote, for measurements and pictures. The prior's sigmas say how far
    ``observe``'s prior may be off. Memory is bounded by the road driven: counters by tile, and the reference of the
    tiles around the vehicle.
    """

    def __init__(
        self,
        name: str,
        sensor: Sensor,
        point_map: PointMap,
        settings: Settings | None = None,
        *,
        drive_id: str = "drive",
        voters: Sequence[VotingSettings] | None = None,
        localise: Localise | None = None,
        movers: Movers | None = None,
        watch: Watch | None = None,
        prior_sigma_m: float = 1.0,
        prior_sigma_deg: float = 1.0,
    ) -> None:
        self.name, self.sensor, self.point_map, self.drive_id = name, sensor, point_map, drive_id
        self.settings = settings or Settings()
        self.localise = localise or Tracker(MapWindow(point_map, self.settings.ndt), self.settings.ndt).localise
        self.watch = watch
        self.movers = movers or MovingFilter(sensor, self.settings.moving)
        self.prior_sigmas = prior_sigma_m, float(np.radians(prior_sigma_deg))
        self.report = DriveReport()
        votings = voters or [self.settings.voting]
        self._first = votings[0]
        self._panel = Detectors([_counts_as(voting) for voting in votings], sensor, point_map)
        self._new_points = NewPoints(point_map.lattice)
        self._waiting: deque[_Waiting] = deque()
        self._surroundings = LocalMap(point_map, self.settings.voting.window_m)
        self._outer: Reference | None = None
        self._unmapped: U64 = np.zeros((0, 0), dtype=np.uint64)
        self._stamps_ns: list[int] = []

    def observe(self, scan: Scan, T_map_lidar_prior: F64 | None = None) -> None:
        """One scan: localise, find what moves, see, vote. Votes may wait a second until it is known what moved."""
        report, index = self.report, self.report.scans
        report.scans += 1
        self._stamps_ns.append(scan.stamp_ns)
        prior = None if T_map_lidar_prior is None else PosePrior(T_map_lidar_prior, *self.prior_sigmas)
        with report.timed("localise"):
            fix = self.localise(scan, prior)
        T_map_lidar = fix.registration.T_map_lidar
        report.T_map_lidar.append(T_map_lidar)
        if not fix.trusted:
            report.lost.append(index)
            return
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(fix.registration.covariance[:3, :3])[-1]))
        report.sigmas_m.append(sigma_m)
        with report.timed("ground"):
            points_map, origin_map = transform(T_map_lidar, fix.points), T_map_lidar[:3, 3].copy()
            reference, outer = self._surroundings.at(origin_map)
            if self._outer is not outer:
                self._outer, self._unmapped = outer, ~outer.occupied
            obstacle, cell = find_obstacles(points_map, reference)
        self._waiting.append(
            _Waiting(points_map, origin_map, sigma_m, reference, outer, self._unmapped, obstacle, cell)
        )
        with report.timed("moving"):
            decided = self.movers.push(points_map, origin_map, obstacle, scan.stamp_ns)
        for _, moving in decided:
            self._vote(self._waiting.popleft(), moving)

    def _vote(self, scan: _Waiting, moving: Bool) -> None:
        if self.watch:
            self.watch(scan.points_map, scan.origin_map, scan.obstacle, moving)
        with self.report.timed("see"):
            view = cast_rays(scan.points_map, scan.origin_map, scan.obstacle, moving, scan.reference, scan.cell)
        with self.report.timed("vote"):
            seen = Observation(view, scan.reference, scan.origin_map, scan.sigma_m)
            new = self._panel.add(seen)
            base = np.ascontiguousarray(scan.reference.base).ravel()
            chosen = select(scan.points_map, scan.cell, scan.obstacle & ~moving, new.ravel(), base)
            self._new_points.offer(scan.points_map[chosen])
            self._new_points.offer(_strange_beyond(scan))

    def ballot(self, voting: VotingSettings | None = None) -> Ballot:
        """What this vehicle says so far, by the voter with these settings (default: the first).

        Raises MapvoteError if no scan voted, or no voter has these settings.
        """
        voting = voting or self._first
        if _counts_as(voting) not in self._panel.voters:
            raise MapvoteError("no voter of this vehicle has these settings; name them when the Vehicle is made")
        if len(self.report.lost) == self.report.scans:
            raise MapvoteError(
                f"{self.name}: none of {self.report.scans} scans could be localised in map {self.point_map.map_id}; "
                "is the drive on this map, and its prior in the map's frame?"
            )
        for _, moving in self.movers.flush():
            self._vote(self._waiting.popleft(), moving)
        points = self._new_points.by_tile()
        votes = self._panel.voters[_counts_as(voting)].votes()
        return Ballot(
            map_id=self.point_map.map_id,
            base={tile_key(tile): self._base_hash(tile) for tile in votes},
            vehicle=self.name,
            drive=self.drive_id,
            start_ns=self._stamps_ns[0],
            end_ns=self._stamps_ns[-1],
            method=voting.method,
            settings_hash=self.settings.model_copy(update={"voting": voting}).digest(),
            scans=self.report.scans,
            scans_localised=self.report.scans - len(self.report.lost),
            median_sigma_m=float(np.median(self.report.sigmas_m)),
            tiles=[self._tile(t, v, points.get(t), voting.two_stage) for t, v in votes.items()],
        )

    def _tile(self, tile: TileIndex, votes: TileVotes, points: F64 | None, two_stage: bool) -> BallotTile:
        """One-stage, the server decides: then every cell that got such a vote may need its points and its mask."""
        changed = {
            change: votes.states == change if two_stage else votes.tally[..., change] > 0
            for change in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY)
        }
        new_points = None
        if points is not None:
            window = self.point_map.lattice.tile(tile)
            base = reference_window(self.point_map, window).base
            new = np.where(changed[CellState.CHANGED_OCCUPIED], votes.new, np.uint64(0))
            kept = points_in(window, points, new, base)
            new_points = pack_plane(kept) if len(kept) else None
        gone, left = votes.gone, np.uint64(0) if votes.remnants is None else votes.remnants
        if gone is not None:
            gone = np.where(changed[CellState.CHANGED_EMPTY], gone, left)
        return BallotTile(
            tile=tile,
            states=pack_plane(votes.states) if two_stage else None,
            tally=None if two_stage else pack_plane(np.moveaxis(to_wire(votes.tally), -1, 0)),
            gone=None if gone is None else pack_plane(gone),
            new_points=new_points,
            free=None if votes.free is None else pack_plane(votes.free),
        )

    def _base_hash(self, tile: TileIndex) -> str:
        return content_hash(self.point_map.tiles[tile].points) if tile in self.point_map.tiles else ""


def _strange_beyond(scan: _Waiting) -> F64:
    """(m, 3) obstacle points outside the local grid, within reach, in voxels that the map does not hold.

    They cast no vote. But the upper storeys of what is new can be seen only from afar, below the sensor's top beam.
    """
    outside = scan.points_map[scan.cell < 0]
    off = outside[:, :2] - scan.origin_map[:2]
    far = outside[np.einsum("ij,ij->i", off, off) < POINTS_REACH_M**2]
    obstacle, cell = find_obstacles(far, scan.outer)
    base = np.ascontiguousarray(scan.outer.base).ravel()
    return far[select(far, cell, obstacle, scan.unmapped.ravel(), base)]


def _counts_as(voting: VotingSettings) -> VotingSettings:
    """Voters that differ only in who decides (one stage or two) count alike and share their counters."""
    return voting.model_copy(update={"two_stage": True})


def vote_drive(
    drive: Drive,
    point_map: PointMap,
    settings: Settings | None = None,
    *,
    localise: Localise | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Ballot, DriveReport]:
    """Every scan of ``drive`` observed by one Vehicle. ``progress(done, total)`` is called after each scan."""
    vehicle = Vehicle(
        drive.vehicle,
        drive.sensor,
        point_map,
        settings,
        drive_id=drive.drive_id,
        localise=localise,
        prior_sigma_m=drive.prior_sigma_m,
        prior_sigma_deg=drive.prior_sigma_deg,
    )
    for i, scan in enumerate(drive):
        prior = None if drive.T_map_lidar_prior is None else drive.T_map_lidar_prior[i]
        vehicle.observe(scan, prior)
        if progress:
            progress(i + 1, len(drive))
    return vehicle.ballot(), vehicle.report
