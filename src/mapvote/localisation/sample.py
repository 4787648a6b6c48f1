"""A scan as NDT wants it: thinned once, de-skewed as often as a motion is tried."""

from __future__ import annotations

from mapvote.core.types import F32, F64, Scan
from mapvote.localisation.deskew import deskew
from mapvote.localisation.ndt import LEVELS, in_rows, thinned


class Sample:
    """The points of one scan that each level compares with the map."""

    def __init__(self, scan: Scan) -> None:
        self._scans = {size: scan.only(few) for size, few in thinned(scan.points).items()}

    def clouds(self, twist: F64) -> list[F32]:
        """(3, m) by level, at the scan's stamp if the sensor's motion per second was ``twist`` (6,)."""
        clouds = {size: in_rows(deskew(scan, twist)) for size, scan in self._scans.items()}
        return [clouds[level.points_m] for level in LEVELS]

    def coarse(self, twist: F64) -> list[F32]:
        """The same, of the fewest points at every level: to try many guesses."""
        return [in_rows(deskew(self._scans[max(self._scans)], twist))] * len(LEVELS)
