"""A scan as NDT wants it: thinned once, de-skewed as often as a motion is tried."""

from __future__ import annotations

from mapvote.core.types import F32, F64, Scan
from mapvote.localisation.deskew import deskewed
from mapvote.localisation.ndt import LEVELS, in_rows, thinned


class Sample:
    """The points of one scan that each level compares with the map."""

    def __init__(self, scan: Scan) -> None:
        time_s = scan.time_s
        self._parts = {
            size: (scan.points.take(few, axis=0), None if time_s is None else time_s.take(few))
            for size, few in thinned(scan.points).items()
        }

    def clouds(self, twist: F64) -> list[F32]:
        """(3, m) by level, at the scan's stamp if the sensor's motion per second was ``twist`` (6,)."""
        clouds = {size: in_rows(deskewed(*part, twist)) for size, part in self._parts.items()}
        return [clouds[level.points_m] for level in LEVELS]

    def coarse(self, twist: F64) -> list[F32]:
        """The same, of the fewest points at every level: to try many guesses."""
        return [in_rows(deskewed(*self._parts[max(self._parts)], twist))] * len(LEVELS)
