"""What shows in a drive without registering a scan: before a verb works with it, and while it does."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mapvote.core.types import Drive
from mapvote.doctor.finding import Finding, usable
from mapvote.doctor.looks import Looking, Looks
from mapvote.doctor.movement import in_map_frame
from mapvote.doctor.prior import NO_PRIOR, check_prior, check_times
from mapvote.doctor.scans import check_scans

_FIRST_LOOK = 24
"""Scans looked at before a drive is used: what is wrong with all of them shows, and costs a tenth of a second."""
IN_MAP_FRAME = Finding(
    "error",
    "the points are in the map's frame already: they move along with the prior",
    "give them in the sensor's frame: p_lidar = inverse(T_map_lidar) p_map, one pose a scan",
)


def cheap_checks(drive: Drive, looks: Looks) -> list[Finding]:
    """What ``looks`` at a drive's scans, its times and its prior show."""
    T = drive.T_map_lidar_prior
    if T is not None and len(looks.index) and in_map_frame(T, looks):
        return [IN_MAP_FRAME]
    found = check_times(drive) + check_scans(drive, looks)
    return found + (check_prior(drive) if len(drive) >= 2 else [])


class LookedAt:
    """A drive that must be usable. Some of its scans are looked at before, the others when they are read: so none is
    read only to be looked at. If some show an error all are looked at, for the error to be told as of all."""

    def __init__(self, drive: Drive, progress: Callable[[int, int], None] | None = None) -> None:
        """MapvoteError with the first error that some of the scans show, if there is one."""
        self._looking = Looking(drive)
        some = np.unique(np.linspace(0, len(drive) - 1, _FIRST_LOOK).astype(np.int64)).tolist() if len(drive) else []
        found = cheap_checks(drive, self._looking.look(some, progress))
        if any(f.severity == "error" for f in found):
            self.warnings(progress)

    @property
    def drive(self) -> Drive:
        """To be used in place of the drive as it came."""
        return self._looking.drive

    def warnings(self, progress: Callable[[int, int], None] | None = None) -> list[Finding]:
        """What all scans show, also those that nobody has read; MapvoteError with the first error, if there is one."""
        drive = self.drive
        found = cheap_checks(drive, self._looking.look(range(len(drive)), progress))
        return [f for f in usable(str(drive.path), found) if f != NO_PRIOR]
