"""What is wrong at a path, whatever lies there: a map, a ballot, a drive, or a drive on a map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from mapvote.core.point_map import PointMap
from mapvote.core.types import F32, F64, I64, Drive, MapvoteError
from mapvote.doctor.finding import Finding, Progress, in_order
from mapvote.doctor.map_fit import Laid, check_cloud_on_map, check_on_map, in_another_unit
from mapvote.doctor.maps import check_cloud, check_map, examine_map, tile_by_tile
from mapvote.doctor.motion import (
    Road,
    Run,
    check_ranges,
    check_road,
    check_scan_motion,
    find_road,
    follow,
    range_scatter_m,
    starts_across,
    starts_of_runs,
)
from mapvote.doctor.prior import NO_PRIOR
from mapvote.doctor.prior_fit import CHAIN_SCANS, check_agreement, unbroken
from mapvote.doctor.records import check_bag, check_ballot
from mapvote.doctor.scans import IN_MAP_FRAME, Looks, cheap_checks, in_map_frame, look_at_all
from mapvote.formats import open_drive
from mapvote.formats.drives.options import DriveOptions
from mapvote.formats.drives.rosbag import is_rosbag
from mapvote.formats.maps.mapvote_folder import is_map_folder
from mapvote.formats.registry import DRIVES, MAPS
from mapvote.slam.driven_road import wrong_attitude

_LOST_SCANS = 4
"""A chain of no more has lost itself at its first step."""
_ROAD_SCANS = 7
_TURNED_OVER = np.diag([1.0, -1.0, -1.0]).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What the doctor found, errors first, and of a drive how it lies."""

    findings: list[Finding]
    drive: Drive | None = None
    T_read: F64 | None = None
    """(n, 4, 4) its prior."""
    T_mended: F64 | None = None
    """(n, 4, 4) takes its points, as they are in the files, to their place in the map; None if unknown."""


@dataclass(frozen=True)
class Evidence:
    """The evidence for the checks of a drive: scans, road, registrations. Each is computed once, at first use."""

    drive: Drive
    progress: Progress | None = None

    @cached_property
    def looks(self) -> Looks:
        return look_at_all(self.drive, lambda done, n: self.tell("looking at scans", done, n))

    def tell(self, stage: str, done: int, n: int) -> None:
        if self.progress is not None:
            self.progress(stage, done, n)

    @property
    def T(self) -> F64 | None:
        """(n, 4, 4) the prior as it was read."""
        return self.drive.T_map_lidar_prior

    @property
    def in_map_frame(self) -> bool:
        """Whether the points are in the map's frame: then nothing else can be checked."""
        return self.T is not None and len(self.looks.index) > 0 and in_map_frame(self.T, self.looks)

    @cached_property
    def readable(self) -> I64:
        """(m,) scans that could be read."""
        return self.looks.index

    def as_read(self, i: int) -> F32:
        """(p, 3) points of the i-th scan that could be read."""
        return self.drive.read_scan(int(self.readable[i])).points

    def points(self, i: int) -> F32:
        """The same, turned over where the sensor is upside down: what else is wrong shows only then."""
        return self.as_read(i) @ _TURNED_OVER if self.road.up == "-z" else self.as_read(i)

    @cached_property
    def some(self) -> I64:
        """A few of the readable scans, spread evenly."""
        return np.linspace(0, len(self.readable) - 1, min(len(self.readable), _ROAD_SCANS)).astype(np.int64)

    @cached_property
    def road(self) -> Road:
        """As the points are read."""
        return find_road([self.as_read(int(i)) for i in self.some])

    @cached_property
    def road_below(self) -> Road:
        return find_road([self.points(int(i)) for i in self.some]) if self.road.up == "-z" else self.road

    @cached_property
    def scatter_m(self) -> float:
        """Of ranges, of the first LiDAR: rays of another one begin elsewhere, and end on other things."""
        scans = [self.drive.read_scan(int(self.readable[i])) for i in self.some]
        return float(np.median([range_scatter_m(scan.by_lidar()[0][1].points) for scan in scans]))

    @property
    def can_be_registered(self) -> bool:
        """Else whatever seems wrong with the motion may be its consequence."""
        return (
            len(self.readable) > 2
            and 1.5 <= float(np.median(self.looks.range_m[:, 1])) <= 150.0
            and self.road_below.up == "+z"
        )

    @cached_property
    def runs(self) -> tuple[list[Run], list[Run]]:
        """(runs spread over the drive, these and runs across the places where scans differ most)."""
        spread = starts_of_runs(len(self.readable), None if self.T is None else self.T[self.readable])
        starts = dict.fromkeys([*spread.tolist(), *starts_across(self.looks.leaps, len(self.readable)).tolist()])
        every = []
        for k, start in enumerate(starts):
            every.append(self.run(start))
            self.tell("registering scans", k + 1, len(starts))
        return every[: len(spread)], every

    def run(self, start: int, **most: int) -> Run:
        run = follow(self.points, start, len(self.readable), self.road_below, **most)
        return replace(run, indices=self.readable[run.indices])

    def chain(self) -> Run:
        """A long run, from the first scans that it can begin with: its first step tries every way and speed, and may
        find a wrong one; the next scan then does not fit, though nothing is wrong with the drive."""
        run = self.run(0, scans=CHAIN_SCANS)
        for start in (_LOST_SCANS, 2 * _LOST_SCANS):
            fitting = len(unbroken(run).indices)
            if fitting > _LOST_SCANS or fitting == len(run.indices):
                break
            run = self.run(start, scans=CHAIN_SCANS)
        return run

    @cached_property
    def leaps(self) -> list[Finding]:
        """What is wrong with the scans' own motion; while there is anything, a prior cannot be held against it."""
        return check_scan_motion(self.drive, self.runs[1]) if self.can_be_registered else []

    @cached_property
    def agreement(self) -> tuple[list[Finding], F64 | None]:
        """(how prior and scans differ, the prior as it would be mended)."""
        if self.T is None or not self.can_be_registered or self.leaps:
            return [], self.T
        turns = float(np.median(self.looks.turns))
        found, T = check_agreement(self.drive, self.T, self.runs[0], self.road_below, turns, self.chain)
        if self.road.up == "-z":
            # Nothing wrong with a prior shows surely in scans that are mended by a guess.
            found = [f for f in found if f.severity == "error"]
            T = T.copy()
            T[:, :3, :3] = T[:, :3, :3] @ _TURNED_OVER
        return found, T


def _ranges_and_road(e: Evidence) -> list[Finding]:
    if len(e.readable) <= 2:
        return []
    return check_ranges(e.scatter_m) + check_road(e.road, e.scatter_m, e.T, e.readable[e.some].tolist())


def _attitude(e: Evidence) -> list[Finding]:
    """What ``build`` would say too: it asks by the same function."""
    if e.T is None or not e.can_be_registered or any(f.severity == "error" for f in e.agreement[0]):
        return []
    wrong = wrong_attitude(e.drive, e.readable.tolist())
    return [] if wrong is None else [Finding("warning", wrong.what, wrong.mend)]


CHECKS: tuple[Callable[[Evidence], list[Finding]], ...] = (
    lambda e: cheap_checks(e.drive, e.looks),
    _ranges_and_road,
    lambda e: e.leaps,
    lambda e: e.agreement[0],
    _attitude,
)
"""Of a drive by itself, in the order in which one needs the other."""


def examine_drive(drive: Drive, progress: Progress | None = None) -> tuple[list[Finding], F64 | None]:
    """(findings, errors first; the prior (n, 4, 4) as it would be mended) of a drive."""
    e = Evidence(drive, progress)
    if e.in_map_frame:
        return [IN_MAP_FRAME], np.tile(np.eye(4), (len(drive), 1, 1))
    return in_order(f for check in CHECKS for f in check(e)), e.agreement[1]


def diagnose(
    path: Path,
    options: DriveOptions | None = None,
    point_map: PointMap | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Everything the doctor finds at ``path``: in a map, a ballot or a drive; with ``point_map``, also whether a drive
    or a map lies on it."""
    if is_map_folder(path) or any(layout.recognised(path) for layout in MAPS.values()):
        found, cloud = examine_map(path)
        if point_map is not None and cloud is not None:
            found = in_order([*found, *check_cloud_on_map(point_map, cloud)])
        return Diagnosis(found)
    if path.is_file() and not any(layout.recognised(path) for layout in DRIVES.values()):
        return Diagnosis(check_ballot(path.read_bytes()))
    options = options or DriveOptions()
    drive, unopened = _opened(path, options)
    found = unopened + (check_bag(path, options) if is_rosbag(path) else [])
    T = None
    if drive is not None:
        more, T = examine_drive(drive, progress)
        # That a prior that could not be read is missing goes without saying.
        found += [f for f in more if not (unopened and f == NO_PRIOR)]
    if point_map is not None:
        found, T = _with_map(found, drive, T, point_map, progress)
    read = None if drive is None else drive.T_map_lidar_prior
    unknown = T is read and any(f.severity == "error" for f in found)
    return Diagnosis(in_order(found), drive, read, None if unknown else T)


def _opened(path: Path, options: DriveOptions) -> tuple[Drive | None, list[Finding]]:
    """(the drive, what stopped it from opening as it is): a broken prior hides nothing else."""
    try:
        return open_drive(path, **asdict(options)), []
    except MapvoteError as error:
        found = [Finding("error", str(error))]
    try:
        return open_drive(path, **asdict(replace(options, prior="none"))), found
    except MapvoteError:
        return None, found


def _with_map(
    found: list[Finding], drive: Drive | None, T: F64 | None, point_map: PointMap, progress: Progress | None
) -> tuple[list[Finding], F64 | None]:
    """(also what is wrong with the map, and with the drive on it; the poses (n, 4, 4) as they lie on the map)."""
    of_points = [f for f in check_cloud(tile_by_tile(point_map)) if f.severity != "note"]
    of_map = of_points + [f for f in check_map(point_map) if f.severity != "note"]
    named = [replace(f, what=f"the map: {f.what}") for f in of_map]
    if drive is None or T is None or any(f.severity == "error" for f in found):
        return found + named, T
    if any(f.severity == "error" for f in of_points):  # as it is, no scan can fit it
        unit = in_another_unit(Laid(drive, T, point_map, progress))
        return [*found, *named, *([unit] if unit is not None else [])], T
    more, T = check_on_map(drive, T, point_map, progress)
    if not of_map and all(f.severity == "note" for f in more):
        found = [f for f in found if not f.map_tells]
    return [*found, *named, *more], T
