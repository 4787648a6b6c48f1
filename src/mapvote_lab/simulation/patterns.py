"""Where the rays of a simulated LiDAR go, and when they leave.

* A spinning sensor turns clockwise seen from above. Its stamp is the middle of the revolution, when it faces forward;
  the ray at azimuth phi leaves at ``-phi / (2 pi) / rate`` from the stamp.
* A rosette is drawn by two prisms that turn at rates without a common measure (Liu, Yuan and Zhang, *Low-cost
  Retina-like Robotic Lidars Based on Incommensurable Scanning*, 2020). Each bends the ray by half of the cone's angle,
  so no scan repeats another. Its stamp is its first ray.
* A solid-state sensor has fields side by side; in each a mirror sweeps lines from the top down, to and fro. The line
  sinks while it is drawn, so points lie on no rings. Its stamp is its first ray.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mapvote.core.record import record
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, Bool


@dataclass(frozen=True, slots=True)
class Firing:
    """The rays of one scan in order of time."""

    directions: F32
    """(firings, rays that leave together, 3) unit, in the sensor's frame."""
    time_s: F64
    """(firings,) when they leave, from the stamp."""


Pattern = Callable[[Sensor, float, float], Firing]
"""(sensor, stamp in seconds, phase in [0, 1)) to the rays of the scan with this stamp."""


@record()
@dataclass(frozen=True, slots=True)
class RosetteScan:
    """The rosette of two prisms, with the rates of the paper's sensor and a number of points of later ones."""

    cone_deg: float = 70.4
    """Angle of the cone that is seen, degrees."""
    points_per_s: int = 240_000
    """Rays each second."""
    prism_hz: tuple[float, float] = (121.5667, -77.7333)
    """Turns of the two prisms each second: 7294 and -4664 rpm."""


@record()
@dataclass(frozen=True, slots=True)
class RasterScan:
    """The mirrors of the solid-state sensor."""

    fields: int = 5
    """Fields side by side, each with a mirror."""


@record()
@dataclass(frozen=True, slots=True)
class MovingSlices:
    """How bodies move while a sensor that does not turn takes a scan."""

    slices: int = 10
    """Slices of a scan in which a body stands still: 10 ms, .3 m at 100 km/h."""


MOVING_SLICES = MovingSlices()
ROSETTE_SCAN = RosetteScan()
RASTER_SCAN = RasterScan()


def turning(sensor: Sensor, stamp_s: float, phase: float) -> Firing:
    """One revolution of all beams; ``phase`` turns it by a share of the azimuth step."""
    step = 2.0 * np.pi / sensor.azimuths
    azimuth: F64 = np.asarray(np.pi - (np.arange(sensor.azimuths) + 1.0 - phase) * step, dtype=np.float64)
    directions = _directions(azimuth[:, None], np.radians(np.array(sensor.elevations_deg))[None])
    return Firing(directions, np.asarray(-azimuth / (2.0 * np.pi) / sensor.rate_hz, dtype=np.float64))


def rosette(sensor: Sensor, stamp_s: float, phase: float, scan: RosetteScan = ROSETTE_SCAN) -> Firing:
    """The piece of the rosette from ``stamp_s`` on."""
    time_s = (np.arange(round(scan.points_per_s / sensor.rate_hz)) + phase) / scan.points_per_s
    turned = np.exp(2j * np.pi * np.multiply.outer(np.array(scan.prism_hz), stamp_s + time_s)).sum(axis=0)
    off = np.radians(0.25 * scan.cone_deg) * np.abs(turned)
    about = np.angle(turned)
    ray = np.column_stack([np.cos(off), np.sin(off) * np.cos(about), np.sin(off) * np.sin(about)])
    return Firing(ray[:, None].astype(np.float32), time_s)


def raster(sensor: Sensor, stamp_s: float, phase: float, scan: RasterScan = RASTER_SCAN) -> Firing:
    """One sweep of all fields from the top down; ``phase`` shifts the firings by a share of their step."""
    (right_deg, left_deg), *_ = sensor.blind_sectors_deg
    wide_deg = (360.0 - (left_deg - right_deg)) / scan.fields
    columns = round(wide_deg / sensor.azimuth_step_deg)
    done = (np.arange(columns * sensor.beams) + phase) / (columns * sensor.beams)
    along = (done * sensor.beams) % 2.0
    across = wide_deg * np.where(along < 1.0, along, 2.0 - along)
    edges = right_deg - wide_deg * (1.0 + np.arange(scan.fields))
    azimuth = np.radians(edges + across[:, None])
    elevation = np.radians(sensor.fov_top_deg + done[:, None] * (sensor.fov_bottom_deg - sensor.fov_top_deg))
    return Firing(_directions(azimuth, elevation), np.asarray(done / sensor.rate_hz, dtype=np.float64))


def in_view(sensor: Sensor, directions: F32 | F64) -> Bool:
    """(n,) whether the sensor ever looks in ``directions`` (n, 3), unit vectors in its frame."""
    if pattern_of(sensor) is rosette:
        return np.asarray(directions[:, 0] >= np.cos(np.radians(0.5 * ROSETTE_SCAN.cone_deg)))
    azimuth_deg = np.degrees(np.arctan2(directions[:, 1], directions[:, 0])) % 360.0
    seen = np.ones(len(directions), dtype=np.bool_)
    for start_deg, end_deg in sensor.blind_sectors_deg:
        seen &= (azimuth_deg < start_deg) | (azimuth_deg > end_deg)
    return seen


def _directions(azimuth: F64, elevation: F64) -> F32:
    """(n, m, 3) unit vectors of angles that broadcast to (n, m), radians."""
    shape = np.broadcast_shapes(azimuth.shape, elevation.shape)
    directions = np.empty((*shape, 3), dtype=np.float32)
    directions[..., 0] = np.cos(azimuth) * np.cos(elevation)
    directions[..., 1] = np.sin(azimuth) * np.cos(elevation)
    directions[..., 2] = np.sin(elevation)
    return directions


def pattern_of(sensor: Sensor) -> Pattern:
    """How this sensor scans; one that is not listed turns."""
    others: dict[str, Pattern] = {"rosette70": rosette, "mems120": raster}
    return others.get(sensor.name, turning)
