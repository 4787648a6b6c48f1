"""What is wrong at a path, whatever lies there: a map, a ballot, a drive, or a drive on a map."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Drive, MapvoteError
from mapvote.doctor import Finding, Progress, any_error, in_order
from mapvote.doctor.drive_evidence import DriveEvidence, check_ranges, check_road
from mapvote.doctor.map_fit import MapEvidence, check_cloud_on_map, check_on_map, in_another_unit
from mapvote.doctor.maps import check_cloud, check_map, examine_map, tile_by_tile
from mapvote.doctor.prior_fit import agreement, check_attitude
from mapvote.doctor.records import check_bag, check_ballot
from mapvote.doctor.scans import IN_MAP_FRAME, NO_PRIOR, cheap_checks
from mapvote.formats import is_cloud, open_drive
from mapvote.formats.drives.rosbag import is_rosbag
from mapvote.formats.registry import DRIVES

CHECKS: tuple[Callable[[DriveEvidence], Iterable[Finding]], ...] = (
    lambda e: cheap_checks(e.drive, e.looks),
    check_ranges,
    check_road,
    lambda e: e.leaps,
)
"""Of the scans of a drive, in the order in which one needs the other."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What the doctor found, errors first, and of a drive how it lies."""

    findings: list[Finding]
    drive: Drive | None = None
    T_read: F64 | None = None
    """(n, 4, 4) its prior."""
    T_mended: F64 | None = None
    """(n, 4, 4) takes its points, as they are in the files, to their place in the map; None if unknown."""


def examine_drive(drive: Drive, progress: Progress | None = None) -> tuple[list[Finding], F64 | None]:
    """(findings, errors first; the prior (n, 4, 4) as it would be mended) of a drive."""
    e = DriveEvidence(drive, progress)
    if e.in_map_frame:
        return [IN_MAP_FRAME], np.tile(np.eye(4), (len(drive), 1, 1))
    found = [f for check in CHECKS for f in check(e)]
    of_prior, T = agreement(e)
    attitude = [] if any_error(of_prior) else check_attitude(e)
    return in_order([*found, *of_prior, *attitude]), T


def diagnose(
    path: Path,
    options: Mapping[str, Any] | None = None,
    point_map: PointMap | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Everything the doctor finds at ``path``: in a map, a ballot or a drive; with ``point_map``, also whether a drive
    or a map lies on it. ``options``: of the drive, as ``open_drive`` takes them."""
    if is_cloud(path):
        found, cloud = examine_map(path)
        if point_map is not None and cloud is not None:
            found = in_order([*found, *check_cloud_on_map(point_map, cloud)])
        return Diagnosis(found)
    if path.is_file() and not any(layout.recognised(path) for layout in DRIVES.values()):
        return Diagnosis(list(check_ballot(path.read_bytes())))
    options = options or {}
    drive, unopened = _opened(path, options)
    found = unopened + (check_bag(path, **options) if is_rosbag(path) else [])
    T = None
    if drive is not None:
        more, T = examine_drive(drive, progress)
        # That a prior that could not be read is missing goes without saying.
        found += [f for f in more if not (unopened and f == NO_PRIOR)]
    if point_map is not None:
        found, T = _with_map(found, drive, T, point_map, progress)
    read = None if drive is None else drive.T_map_lidar_prior
    unknown = T is read and any_error(found)
    return Diagnosis(in_order(found), drive, read, None if unknown else T)


def _opened(path: Path, options: Mapping[str, Any]) -> tuple[Drive | None, list[Finding]]:
    """(the drive, what stopped it from opening as it is): a broken prior hides nothing else."""
    found: list[Finding] = []
    for prior in (options.get("prior"), "none"):
        try:
            return open_drive(path, **{**options, "prior": prior}), found
        except MapvoteError as error:
            found = found or [Finding("error", str(error))]
    return None, found


def _with_map(
    found: list[Finding], drive: Drive | None, T: F64 | None, point_map: PointMap, progress: Progress | None
) -> tuple[list[Finding], F64 | None]:
    """(also what is wrong with the map, and with the drive on it; the poses (n, 4, 4) as they lie on the map)."""
    of_points = [f for f in check_cloud(tile_by_tile(point_map)) if f.severity != "note"]
    of_map = of_points + [f for f in check_map(point_map) if f.severity != "note"]
    named = [replace(f, what=f"the map: {f.what}") for f in of_map]
    if drive is None or T is None or any_error(found):
        return found + named, T
    if any_error(of_points):  # as it is, no scan can fit it
        unit = in_another_unit(MapEvidence(drive, T, point_map, progress))
        return [*found, *named, *([unit] if unit is not None else [])], T
    more, T = check_on_map(drive, T, point_map, progress)
    if not of_map and all(f.severity == "note" for f in more):
        found = [f for f in found if not f.map_tells]
    return [*found, *named, *more], T
