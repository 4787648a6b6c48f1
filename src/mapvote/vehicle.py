"""The vehicle's side (paper III): scans go in one by one, a ballot comes out.

One pass over a drive can serve several voters (the paper's five cases, other occlusion rules, columns): what a scan
saw is worked out once, and each voter classifies and counts by its own settings.
"""

from __future__ import annotations

import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from mapvote.config import Settings, VotingSettings
from mapvote.core.ballot import Ballot, BallotTile, content_hash, pack_plane, tile_key
from mapvote.core.columns import cut_reference, reference_window
from mapvote.core.geometry import transform
from mapvote.core.grid import TILE_CELLS, TileIndex, tile_grid, window_around
from mapvote.core.sensors import Sensor
from mapvote.core.types import F64, Bool, CellState, Drive, MapvoteError, PointMap, Reference, Registration, Scan
from mapvote.core.voting import decide, to_wire
from mapvote.perception.classify import classify_paper
from mapvote.perception.tally import NewPoints, Tally, points_in
from mapvote.perception.visibility import find_obstacles, see

Localise = Callable[[Scan, F64 | None], Registration | None]
"""(scan, T_map_lidar prior or None) -> where the scan was taken, or None when lost (the scan then casts no vote)."""


def trust_prior(scan: Scan, T_map_lidar_prior: F64 | None) -> Registration | None:
    """The prior as it is: for poses that need no improvement, or to measure what localisation is worth."""
    if T_map_lidar_prior is None:
        return None
    return Registration(T_map_lidar_prior, np.zeros((6, 6)), 1.0, 1.0, 0, True)


@dataclass(slots=True)
class DriveReport:
    """How a drive went."""

    scans: int = 0
    lost: list[int] = field(default_factory=list)
    """Indices of scans that abstained because the vehicle was not sure where it was."""
    sigmas_m: list[float] = field(default_factory=list)
    """Position sigma of each scan that voted."""
    T_map_lidar: list[F64 | None] = field(default_factory=list)
    """Pose of every scan, None where lost."""
    stage_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    """Seconds of every scan by stage: localise, ground, moving, see, vote."""

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.stage_s[stage].append(time.perf_counter() - start)


@dataclass(frozen=True, slots=True)
class _Seen:
    """A localised scan that waits for the moving-object filter to decide."""

    points_map: F64
    origin_map: F64


class Vehicle:
    """One vehicle on one drive.

    ``voters``: the settings of every voter, default only ``settings.voting``. ``localise``: see :data:`Localise`.
    Memory is bounded by the road driven: tallies by tile, and the reference of the tiles around the vehicle.
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
        localise: Localise = trust_prior,
    ) -> None:
        self.name, self.sensor, self.point_map, self.drive_id = name, sensor, point_map, drive_id
        self.settings = settings or Settings()
        self.localise = localise
        self.report = DriveReport()
        lattice = point_map.lattice
        self._voters = {_tally_key(v): (v, Tally(lattice)) for v in voters or [self.settings.voting]}
        self._new_points = NewPoints(lattice)
        self._waiting: deque[_Seen] = deque()
        self._around: Reference | None = None
        self._stamps_ns: list[int] = []

    def observe(self, scan: Scan, T_map_lidar_prior: F64 | None = None) -> None:
        """One scan: localise, remove moving objects, see, classify, vote. A lost scan casts no vote."""
        index = self.report.scans
        self.report.scans += 1
        self._stamps_ns.append(scan.stamp_ns)
        with self.report.timed("localise"):
            registration = self.localise(scan, T_map_lidar_prior)
        self.report.T_map_lidar.append(registration.T_map_lidar if registration else None)
        if registration is None:
            self.report.lost.append(index)
            return
        self.report.sigmas_m.append(float(np.sqrt(np.trace(registration.covariance[:3, :3]))))
        T_map_lidar = registration.T_map_lidar
        self._waiting.append(_Seen(transform(T_map_lidar, scan.points), T_map_lidar[:3, 3].copy()))
        self._vote(self._waiting.popleft(), np.zeros(len(scan.points), dtype=np.bool_))

    def _vote(self, seen: _Seen, moving: Bool) -> None:
        with self.report.timed("see"):
            reference = self._reference_at(seen.origin_map)
            obstacle, cell = find_obstacles(seen.points_map, reference)
            view = see(seen.points_map, seen.origin_map, obstacle, moving, reference, cell)
        with self.report.timed("vote"):
            new = np.zeros(view.grid.shape, dtype=np.bool_)
            for voting, tally in self._voters.values():
                states, weights = classify_paper(view, reference, seen.origin_map, self.sensor, voting)
                tally.add(view.grid, states, weights)
                new |= states == CellState.CHANGED_OCCUPIED
            wanted = obstacle & ~moving & (cell >= 0)
            wanted[wanted] = new.ravel()[cell[wanted]]
            self._new_points.offer(seen.points_map[wanted])

    def _reference_at(self, origin_map: F64) -> Reference:
        """The partial reference map R_i: the 80 m window around the sensor, cut from the tiles around it."""
        lattice = self.point_map.lattice
        window = window_around(lattice, origin_map[0], origin_map[1], self.settings.voting.window_m)
        if self._around is None or window.intersection(self._around.grid) != window:
            row, col = window.row0 + window.rows // 2, window.col0 + window.cols // 2
            centre = tile_grid(lattice, (row // TILE_CELLS, col // TILE_CELLS))
            self._around = reference_window(self.point_map, centre.padded(max(TILE_CELLS, window.rows)))
        return cut_reference(self._around, window)

    def ballot(self, voting: VotingSettings | None = None) -> Ballot:
        """What this vehicle says so far, by the voter with these settings (default: the first).

        Raises MapvoteError if no scan voted, or no voter has these settings.
        """
        voting = voting or next(iter(self._voters.values()))[0]
        if _tally_key(voting) not in self._voters:
            raise MapvoteError("no voter of this vehicle has these settings; name them when the Vehicle is made")
        if len(self.report.lost) == self.report.scans:
            raise MapvoteError(
                f"{self.name}: none of {self.report.scans} scans could be localised in map {self.point_map.map_id}; "
                "is the drive on this map, and its prior in the map's frame?"
            )
        tally = self._voters[_tally_key(voting)][1]
        points = self._new_points.by_tile()
        tiles = [self._tile(t, tally, points.get(t), voting) for t in sorted(tally.tiles) if tally.tiles[t].any()]
        return Ballot(
            map_id=self.point_map.map_id,
            base={tile_key(t.tile): self._base_hash(t.tile) for t in tiles},
            vehicle=self.name,
            drive=self.drive_id,
            start_ns=self._stamps_ns[0],
            end_ns=self._stamps_ns[-1],
            method=f"{voting.method}-{'two-stage' if voting.two_stage else 'one-stage'}",
            settings_hash=self.settings.model_copy(update={"voting": voting}).digest(),
            scans=self.report.scans,
            scans_localised=self.report.scans - len(self.report.lost),
            median_sigma_m=float(np.median(self.report.sigmas_m)),
            tiles=tiles,
        )

    def _tile(self, tile: TileIndex, tally: Tally, points: F64 | None, voting: VotingSettings) -> BallotTile:
        votes = tally.tiles[tile]
        states = decide(votes)
        new_points = None
        if points is not None:  # one-stage: the server decides, so every cell that got such a vote may need its points
            wanted = (
                states == CellState.CHANGED_OCCUPIED if voting.two_stage else votes[..., CellState.CHANGED_OCCUPIED] > 0
            )
            kept = points_in(tile_grid(tally.lattice, tile), points, wanted)
            new_points = pack_plane(kept) if len(kept) else None
        if voting.two_stage:
            return BallotTile(tile=tile, states=pack_plane(states), new_points=new_points)
        return BallotTile(tile=tile, tally=pack_plane(np.moveaxis(to_wire(votes), -1, 0)), new_points=new_points)

    def _base_hash(self, tile: TileIndex) -> str:
        return content_hash(self.point_map.tiles[tile].points) if tile in self.point_map.tiles else ""


def _tally_key(voting: VotingSettings) -> VotingSettings:
    """Voters that differ only in who decides (one stage or two) count alike and share a tally."""
    return voting.model_copy(update={"two_stage": True})


def vote_drive(
    drive: Drive,
    point_map: PointMap,
    settings: Settings | None = None,
    *,
    localise: Localise = trust_prior,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Ballot, DriveReport]:
    """Every scan of ``drive`` observed by one Vehicle. ``progress(done, total)`` is called after each scan."""
    vehicle = Vehicle(drive.vehicle, drive.sensor, point_map, settings, drive_id=drive.drive_id, localise=localise)
    for i, scan in enumerate(drive):
        prior = None if drive.T_map_lidar_prior is None else drive.T_map_lidar_prior[i]
        vehicle.observe(scan, prior)
        if progress:
            progress(i + 1, len(drive))
    return vehicle.ballot(), vehicle.report
