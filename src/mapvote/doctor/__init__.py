"""What is wrong with a drive, and how to mend it: measured where it can be, else a list of what cannot be told apart.

Cheap looks at every file come first (:mod:`mapvote.doctor.scans`, :mod:`mapvote.doctor.prior`), then scans are
registered to each other (:mod:`mapvote.doctor.motion`) and the motion found is held against the prior under every
reading of it (:mod:`mapvote.doctor.frames`). docs/decisions/doctor.md says why.
"""

from __future__ import annotations

from pathlib import Path

from mapvote.core.point_map import PointMap
from mapvote.core.types import Drive, MapvoteError
from mapvote.doctor.drives import Progress, cheap_checks, examine_drive
from mapvote.doctor.finding import Finding, in_order
from mapvote.doctor.on_map import check_ground, check_on_map
from mapvote.formats.drives.options import DriveOptions

__all__ = ["Finding", "examine", "must_be_usable"]


def examine(
    path: Path,
    options: DriveOptions | None = None,
    point_map: PointMap | None = None,
    progress: Progress | None = None,
) -> list[Finding]:
    """Everything the doctor finds in the drive at ``path``, errors first; with a map also whether it lies on it."""
    found, drive, T = examine_drive(path, options, progress)
    if point_map is not None:
        found += check_ground(point_map)
        if drive is not None and T is not None and not any(f.severity == "error" for f in found):
            more, _ = check_on_map(drive, T, point_map, progress)
            found += more
    return in_order(found)


def must_be_usable(drive: Drive, progress: Progress | None = None) -> list[Finding]:
    """The warnings of the cheap checks; MapvoteError with the first error, if there is one."""
    found, _ = cheap_checks(drive, progress)
    errors = [f for f in found if f.severity == "error"]
    if errors:
        more = f" ({len(errors) - 1} more errors: mapvote doctor {drive.path})" if len(errors) > 1 else ""
        raise MapvoteError(f"{drive.path}: {errors[0].what}. {errors[0].mend}{more}")
    return [f for f in found if f.severity == "warning" and not f.what.startswith("no prior")]
