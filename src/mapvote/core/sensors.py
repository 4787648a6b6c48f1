"""LiDAR models: everything that a threshold may be derived from (paper II for the HDL-32E)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
"""Axes of a sensor whose points lie in its own frame."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """A LiDAR. Beams are listed from the top down; azimuths are counter-clockwise from x forward."""

    name: str
    elevations_deg: tuple[float, ...]
    azimuth_step_deg: float
    rate_hz: float = 10.0
    min_range_m: float = 1.0
    max_range_m: float = 100.0
    range_sigma_m: float = 0.02
    clockwise: bool = True
    """Seen from above."""
    rings: bool = True
    """False: the beams do not lie on rings (solid-state, non-repeating); ``elevations_deg`` is then an even grid."""
    blind_sectors_deg: tuple[tuple[float, float], ...] = ()
    """Azimuths (from, to) where the vehicle itself, or the sensor's window, hides everything."""
    azimuth_axes: tuple[tuple[float, float, float], ...] = UPRIGHT
    """Forward, to which it looks in the middle of a revolution, left, and up, about which it turns, in the frame of the
    points: other ones where its points were turned. Points without times get them by azimuths in these axes."""

    @property
    def beams(self) -> int:
        return len(self.elevations_deg)

    @property
    def azimuths(self) -> int:
        """Firings in one revolution."""
        return round(360.0 / self.azimuth_step_deg)

    @property
    def fov_top_deg(self) -> float:
        """Elevation of the highest beam."""
        return max(self.elevations_deg)

    @property
    def fov_bottom_deg(self) -> float:
        """Elevation of the lowest beam."""
        return min(self.elevations_deg)


def _even(top_deg: float, bottom_deg: float, beams: int) -> tuple[float, ...]:
    return tuple(float(e) for e in np.linspace(top_deg, bottom_deg, beams).round(4))


SENSORS: dict[str, Sensor] = {
    s.name: s
    for s in (
        Sensor("vlp16", _even(15.0, -15.0, 16), 0.2),
        Sensor("hdl32e", _even(10.67, -30.67, 32), 0.16),
        Sensor("hdl64e", _even(2.0, -8.33, 32) + _even(-8.83, -24.33, 32), 0.1728, max_range_m=120.0),
    )
}
"""Models by name: those that scans are recognised as."""
NAMED = SENSORS | {
    s.name: s
    for s in (
        Sensor("beams128", _even(15.0, -25.0, 128), 0.2),
        Sensor("rosette70", _even(35.2, -35.2, 156), 0.45, rings=False, blind_sectors_deg=((35.2, 324.8),)),
        Sensor("mems120", _even(12.5, -12.5, 125), 0.2, rings=False, blind_sectors_deg=((60.0, 300.0),)),
    )
}
"""Sensors that a drive or a scenario may name: these, 128 beams over the field of view of several makes, and two that
look ahead only: a rosette that never repeats itself in a cone of 70 deg, and mirrors that scan 120 x 25 deg. No scan is
recognised as one of the three. They are no real sensors, and the beams of the first are so dense that the rings of
others lie on them."""
