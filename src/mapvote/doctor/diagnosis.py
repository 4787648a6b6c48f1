"""What is wrong at a path, whatever lies there: a map, a ballot or a drive, and a drive on a map."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Drive
from mapvote.doctor.bags import check_bag
from mapvote.doctor.ballots import check_ballot
from mapvote.doctor.drives import examine_drive
from mapvote.doctor.finding import Finding, Progress, in_order
from mapvote.doctor.maps import check_whole, examine_map
from mapvote.doctor.on_map import check_on_map, check_unit
from mapvote.formats.drives.options import DriveOptions
from mapvote.formats.drives.rosbag import is_rosbag
from mapvote.formats.maps.mapvote_folder import is_map_folder
from mapvote.formats.registry import DRIVES, MAPS


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What the doctor found, errors first, and of a drive how it lies."""

    findings: list[Finding]
    drive: Drive | None = None
    T_read: F64 | None = None
    """(n, 4, 4) its prior."""
    T_mended: F64 | None = None
    """(n, 4, 4) what takes its points, as they are in the files, to where they belong; None where nobody knows."""


def diagnose(
    path: Path,
    options: DriveOptions | None = None,
    point_map: PointMap | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Everything the doctor finds at ``path``: in a map, a ballot or a drive (with a map, also if it lies on it)."""
    if is_map_folder(path) or any(layout.recognised(path) for layout in MAPS.values()):
        return Diagnosis(examine_map(path)[0])
    if path.is_file() and not any(layout.recognised(path) for layout in DRIVES.values()):
        return Diagnosis(check_ballot(path.read_bytes()))
    options = options or DriveOptions()
    found = check_bag(path, options) if is_rosbag(path) else []
    more, drive, T = examine_drive(path, options, progress)
    found += more
    if point_map is not None:
        sound, of_map = not any(f.severity == "error" for f in found), _of_the_map(point_map)
        found += of_map
        if drive is not None and T is not None and sound:
            if any(f.severity == "error" for f in of_map):
                more = check_unit(drive, T, point_map, progress)
            else:
                more, T = check_on_map(drive, T, point_map, progress)
            if all(f.severity == "note" for f in more):
                found = [f for f in found if not f.map_tells]
            found += more
    read = None if drive is None else drive.T_map_lidar_prior
    unknown = T is read and any(f.severity == "error" for f in found)
    return Diagnosis(in_order(found), drive, read, None if unknown else T)


def _of_the_map(point_map: PointMap) -> list[Finding]:
    """What is wrong with a map, among findings about a drive."""
    found = [f for f in check_whole(point_map) if f.severity != "note"]
    return [replace(f, what=f"the map: {f.what}") for f in found]
