"""The vehicle's side (paper III): scans go in one by one, a ballot comes out."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from mapvote.codec.ballot import (
    Ballot,
    BallotTile,
    Odds,
    changed_cells_of,
    in_steps,
    pack_path,
    pack_planes,
    tile_key,
)
from mapvote.codec.tile_planes import base_hash
from mapvote.config import Settings
from mapvote.core.grid import TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.points import Values, attributes_among, point_field
from mapvote.core.process_memory import give_back_free_pages
from mapvote.core.reference import LocalMap, reference_window
from mapvote.core.rule import rule_named
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, U64, CellState, Drive, MapvoteError, PosePrior, Scan
from mapvote.core.voting import one_hot, to_wire
from mapvote.formats.drives.upright import upright
from mapvote.matching.localiser import Localise, Localiser
from mapvote.matching.prior_frame import PriorFrame
from mapvote.perception.frontend import DriveReport, Frontend, Observation
from mapvote.perception.moving_objects import MovingFilter
from mapvote.rules.voter import Counted, NewPoints, make_voter, points_in


class ClosedStretch(NamedTuple):
    """The road of one ballot that is closed."""

    drive_id: str
    written: Callable[[], Ballot]
    """Writes the ballot: it may be called later and in another thread, and raises MapvoteError if no scan has voted."""
    report: DriveReport
    """Report on its scans."""
    point_map: PointMap
    """The map that it was driven on."""
    prior_in_map: bool
    """Whether the priors were in the map's frame."""


class Vehicle:
    """One vehicle on one drive.

    ``localise``: default NDT in ``point_map``. The prior's sigmas say how far ``observe``'s prior may be off. Memory is
    bounded by the road driven: counters by tile, and the reference of the tiles around the vehicle.
    """

    def __init__(
        self,
        name: str,
        sensor: Sensor,
        point_map: PointMap,
        settings: Settings | None = None,
        *,
        drive_id: str = "drive",
        localise: Localise | None = None,
        prior_sigma_m: float = 1.0,
        prior_sigma_deg: float = 1.0,
    ) -> None:
        self.name = name
        self.point_map = point_map
        self.drive_id = drive_id
        self.settings = settings or Settings()
        self._rule = rule_named(self.settings.voting.method)
        self._prior_sigmas = prior_sigma_m, float(np.radians(prior_sigma_deg))
        self._localise = localise or Localiser(point_map, self.settings, sensor)
        self._frontend = Frontend(
            self._localise,
            MovingFilter(sensor, self.settings.moving),
            LocalMap(point_map, self.settings.voting.window_m, measured=self._rule.needs_heights),
            with_sight=self._rule.needs_sight,
            sensor=sensor,
        )
        self.sensor = sensor
        self._count_anew()

    def _count_anew(self) -> None:
        """No scan has voted yet."""
        self._voter = make_voter(self._rule, self.settings, self.sensor, self.point_map)
        self._new_points = NewPoints(
            self.point_map.lattice,
            beyond=self._rule.takes_points_beyond,
            names=attributes_among(self.point_map.field_names),
        )

    @property
    def report(self) -> DriveReport:
        """How the drive goes."""
        return self._frontend.report

    @property
    def prior_frame(self) -> PriorFrame | None:
        """The frame of the priors, as far as it is learnt; None where poses are given."""
        return self._localise.prior_frame if isinstance(self._localise, Localiser) else None

    def expect_own_frame(self) -> None:
        """The priors from here on are in a frame of their own, which is learnt, unless that has happened."""
        frame = self.prior_frame
        if frame is not None and not frame.is_own:
            frame.is_unknown = True

    @property
    def prior_in_map(self) -> bool:
        """Whether the priors are in the map's frame, not in one of their own."""
        frame = self.prior_frame
        return frame is None or not (frame.is_own or frame.is_unknown)

    def last_stretch(self) -> ClosedStretch:
        """The stretch of the ballot that is open, which the end of the drive closes: after :meth:`finish`."""
        return ClosedStretch(self.drive_id, self.ballot, self.report, self.point_map, self.prior_in_map)

    @property
    def done(self) -> int:
        """How many scans of the report have voted or are lost; those after them still wait."""
        return self._frontend.done

    def observe(self, scan: Scan, prior: F64 | PosePrior | None = None) -> None:
        """One scan: localise, find what moves, see, vote. Its vote waits up to a second until it is known what moved.

        ``prior``: T_map_lidar (4, 4), with the standard deviations of the vehicle's priors, or a prior with its own.

        Raises MapvoteError once the drive has ended.
        """
        if prior is not None and not isinstance(prior, PosePrior):
            prior = PosePrior(prior, *self._prior_sigmas)
        self._vote(self._frontend.observe(scan, prior))

    def finish(self) -> None:
        """The drive has ended: the scans that still wait vote now."""
        self._vote(self._frontend.finish())
        self._hold_to(self.point_map)  # nothing of it is laid out any more: the ballot needs the memory
        give_back_free_pages()

    def cut(self, next_drive_id: str, point_map: PointMap | None = None) -> ClosedStretch:
        """End this ballot and begin the next one on the same track: the drive goes on.

        Scans that have voted are in the stretch that ends, which is returned; those that wait vote in the next.
        ``point_map``: another version of the map, which the next ballot holds to.
        """
        report = self._frontend.cut()
        written = partial(
            write_ballot,
            self.name,
            self.drive_id,
            self.point_map,
            self.settings,
            report,
            self._voter.each(),
            self._new_points,
        )
        ended = ClosedStretch(self.drive_id, written, report, self.point_map, self.prior_in_map)
        self.drive_id = next_drive_id
        if point_map is not None and point_map is not self.point_map:
            self._hold_to(point_map)
        self._count_anew()
        return ended

    def _hold_to(self, point_map: PointMap) -> None:
        """Take this version of the map from here on."""
        self.point_map = point_map
        if isinstance(self._localise, Localiser):
            self._localise.go_on_in(point_map)
        self._frontend.go_on_in(point_map)

    def _vote(self, observations: list[Observation]) -> None:
        for seen in observations:
            with self.report.timed("vote"):
                self._new_points.gather(seen, self._voter.observe(seen))

    def ballot(self, only: Collection[TileIndex] | None = None) -> Ballot:
        """The ballot of the scans that have voted so far; after :meth:`finish`, of the whole drive. The state does not
        change.

        ``only``: of these tiles, so that the ballot of a drive that goes on can be kept piece by piece. Raises
        MapvoteError if no scan has voted.
        """
        state = self.point_map, self.settings, self.report, self._voter.each(only), self._new_points
        return write_ballot(self.name, self.drive_id, *state)


@dataclass(frozen=True, slots=True)
class Cuts:
    """When the ballot of a drive without an end is closed: whichever comes first."""

    length_m: float = 2000.0
    time_s: float = 600.0
    stop_s: float = 120.0
    """The vehicle stood for so long."""
    stop_m: float = 1.0
    """Two places nearer than this are one stop."""


class RoadDriven:
    """The road of the ballot that is open, by its localised scans: each is read once, when it is done."""

    def __init__(self, cuts: Cuts) -> None:
        self._cuts = cuts
        self._read = 0
        self._length_m = 0.0
        self._moved = False
        """Whether the vehicle has left the place where it began."""
        self._last_ns = self._moved_ns = 0
        """Stamps of the last scan, and of the last one that was not at the present place."""
        self._last: F64 | None = None
        self._place: F64 | None = None

    def is_full(self, report: DriveReport, done: int) -> bool:
        """Whether the ballot of the first ``done`` scans of ``report`` is to be closed now."""
        lost = set(report.lost) if done > self._read else set()
        cuts = self._cuts
        for i in range(self._read, done):
            self._last_ns = report.stamps_ns[i]
            position = report.T_map_lidar[i][:3, 3]
            if i not in lost and (self._place is None or np.linalg.norm(position - self._place) > cuts.stop_m):
                self._moved = self._place is not None
                self._place = position
                self._moved_ns = self._last_ns
            if i not in lost and self._last is not None:
                self._length_m += float(np.linalg.norm(position - self._last))
            self._last = None if i in lost else position
        self._read = done
        if not done:
            return False
        age_s = 1e-9 * (self._last_ns - report.stamps_ns[0])
        stood_s = 1e-9 * (self._last_ns - self._moved_ns) if self._moved else 0.0
        return self._length_m >= cuts.length_m or age_s >= cuts.time_s or stood_s >= cuts.stop_s


def write_ballot(
    vehicle: str,
    drive: str,
    point_map: PointMap,
    settings: Settings,
    report: DriveReport,
    counted: Iterable[tuple[TileIndex, Counted]],
    new_points: NewPoints,
) -> Ballot:
    """The ballot of one voter, counted under ``settings``. Raises MapvoteError if no scan has voted."""
    voted = len(report.observed)
    if voted == 0:
        if len(report.lost) < report.scans:
            raise MapvoteError(f"{vehicle}: no scan has voted yet; finish() ends a drive this short")
        raise MapvoteError(
            f"{vehicle}: none of {report.scans} scans could be localised in map {point_map.map_id}; "
            "is the drive on this map, and its prior in the map's frame?"
        )
    points = new_points.by_tile()
    two_stage = settings.voting.two_stage
    names = new_points.names
    tiles = [_ballot_tile(point_map, tile, count, points(tile), names, two_stage) for tile, count in counted]
    tiles.sort(key=lambda tile: tile.tile)
    return Ballot(
        map_id=point_map.map_id,
        version=point_map.version or 1,
        base={tile_key(tile.tile): base_hash(point_map.tiles.get(tile.tile)) for tile in tiles},
        vehicle=vehicle,
        drive=drive,
        start_ns=report.stamps_ns[0],
        end_ns=report.stamps_ns[-1],
        method=settings.voting.method,
        settings_hash=settings.digest(),
        scans=report.scans,
        scans_localised=voted,
        median_sigma_m=float(np.median(report.sigmas_m())),
        length_m=report.length_m(),
        prior_misfit_m=report.prior_misfit_m(),
        prior_sigma_m=report.prior_sigma_m(),
        path=pack_path(report.driven(), point_map.lattice),
        tiles=tiles,
    )


def _ballot_tile(
    point_map: PointMap, tile: TileIndex, count: Counted, points: F64, names: Sequence[str], two_stage: bool
) -> BallotTile:
    """One-stage, the server decides: then every cell that got a vote for changed-occupied may need its points."""
    planes = count.planes
    states = planes.states
    assert states is not None
    # The new points, and their attributes that were measured.
    built = CellState.CHANGED_OCCUPIED
    came = states == built if two_stage or planes.tally is None else planes.tally[..., built] > 0
    new_points, sent = offered(point_map, tile, np.where(came, count.new, np.uint64(0)), points, names)
    measured = {name: values for name, values in sent.items() if (values != point_field(name).unmeasured).any()}
    planes = replace(planes, new_points=new_points, fields=measured)
    if not two_stage:
        tally = to_wire(one_hot(states)) if planes.tally is None else planes.tally
        return pack_planes(tile, replace(planes, states=None, tally=tally))
    # The vehicle's confidence in each change.
    odds = None
    if count.log_odds is not None:
        odds = Odds(changed_cells_of(states), in_steps(count.log_odds(new_points)))
    return pack_planes(tile, replace(planes, tally=None, odds=odds))


def offered(
    point_map: PointMap, tile: TileIndex, new: U64, points: F64, names: Sequence[str]
) -> tuple[F32, dict[str, Values]]:
    """Those of a tile's ``points`` (n, 3 + k), map metres, that lie in its ``new`` voxels (256, 256): (m, 3) from its
    corner, and their k attributes (m,) by ``names``."""
    if not len(points):
        return np.empty((0, 3), dtype=np.float32), {}
    window = point_map.lattice.tile(tile)
    mapped = point_map.tiles.get(tile)
    has_ground = mapped is not None and mapped.has_ground
    base = mapped.base if mapped is not None and has_ground else reference_window(point_map, window).base
    return points_in(window, points, new, base, names)


def vote_drive(
    drive: Drive,
    point_map: PointMap,
    settings: Settings | None = None,
    *,
    localise: Localise | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Ballot, DriveReport]:
    """Every scan of ``drive`` observed by one Vehicle. ``progress(done, total)`` is called after each scan.

    A sensor that its prior, or its T_base_lidar, mounts upside down, on its side or turned is localised in axes with x
    ahead and z up; the report has its own again.
    """
    mount = None
    if localise is None:
        drive, mount = upright(drive)
    vehicle = vehicle_on(drive, point_map, settings, localise=localise)
    for i, scan in enumerate(drive):
        vehicle.observe(scan, PosePrior.of(drive, i))
        if progress:
            progress(i + 1, len(drive))
    vehicle.finish()
    report = vehicle.report
    ballot = vehicle.ballot()
    if mount is not None:
        report.turn(mount.C)
    return ballot, report


def vehicle_on(
    drive: Drive, point_map: PointMap, settings: Settings | None = None, *, localise: Localise | None = None
) -> Vehicle:
    """A vehicle that has driven nowhere yet, with the names, the sensor and the prior's sigmas of ``drive``."""
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
    if not drive.prior_in_map:
        vehicle.expect_own_frame()
    return vehicle


def vote_in_stretches(
    drive: Drive, vehicle: Vehicle, cuts: Cuts, progress: Callable[[int, int], None] | None = None
) -> Iterator[ClosedStretch]:
    """Every scan of ``drive`` observed by ``vehicle``: the stretches whose ballots a live drive would close. They are
    named DRIVE-001, DRIVE-002 and so on."""
    number = 1
    vehicle.drive_id = stretch_name(drive.drive_id, number)
    road = RoadDriven(cuts)
    for i, scan in enumerate(drive):
        vehicle.observe(scan, PosePrior.of(drive, i))
        if progress:
            progress(i + 1, len(drive))
        if road.is_full(vehicle.report, vehicle.done):
            number += 1
            road = RoadDriven(cuts)
            yield vehicle.cut(stretch_name(drive.drive_id, number))
    vehicle.finish()
    yield vehicle.last_stretch()


def stretch_name(drive_id: str, k: int) -> str:
    """The name of the k-th ballot of a drive, from 1."""
    return f"{drive_id}-{k:03d}"
