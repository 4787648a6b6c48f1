"""Traffic: cars, two-wheelers and pedestrians on plausible paths (paper V: "many moving objects").

Every body follows a track: (x, y, yaw) every ``Pace.step_s``, straight along a lane or a sidewalk, turning into the
crossing street, or braking in the queue before it. All of them move during the drive.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapvote.core.record import record
from mapvote.core.types import F32, F64, I32, I64
from mapvote_lab.simulation import shapes
from mapvote_lab.simulation.scenario import LANES, Scenario
from mapvote_lab.simulation.world import STREET, Terrain


@record()
@dataclass(frozen=True, slots=True)
class Pace:
    """How the tracks of moving bodies are laid out."""

    step_s: float = 0.25
    """Time between poses of a track, seconds."""
    beyond_m: float = 90.0
    """Length by which bodies go on beyond the ends of the street, metres: as far as a ray reaches."""


PACE = Pace()


@dataclass(frozen=True)
class Track:
    """A body and where it is: ``triangles`` (n, 3, 3) in its own frame (x forward, foot at z = 0),
    ``path`` (steps, 3) of x, y, yaw (continuous) every ``Pace.step_s`` from one step before the drive starts."""

    triangles: F64
    path: F64


class Traffic:
    """All moving bodies of one drive, packed so that a scan costs no loop over bodies."""

    def __init__(self, tracks: list[Track], terrain: Terrain) -> None:
        self._terrain = terrain
        self._paths = np.stack([t.path for t in tracks]) if tracks else np.zeros((0, 2, 3))
        self._triangles = shapes.join([t.triangles for t in tracks])
        self._owners = np.repeat(np.arange(len(tracks)), [len(t.triangles) for t in tracks])

    def poses(self, bodies: I64, time_s: F64) -> F64:
        """(n, 3) x, y, yaw of these bodies, each at its own time from the start of the drive."""
        step = np.clip(time_s / PACE.step_s + 1.0, 0.0, self._paths.shape[1] - 1.001)
        whole = step.astype(np.int64)
        share = (step - whole)[:, None]
        out: F64 = (1.0 - share) * self._paths[bodies, whole] + share * self._paths[bodies, whole + 1]
        return out

    def tails(self, stamp_s: float) -> F64:
        """(bodies, 3) map points half a metre above the ground where each body ends, 2.5 m behind its middle."""
        everyone = np.arange(len(self._paths))
        x, y, yaw = self.poses(everyone, np.full(len(everyone), stamp_s)).T
        x = x - 2.5 * np.cos(yaw)
        y = y - 2.5 * np.sin(yaw)
        return np.column_stack([x, y, self._terrain.height(x, y) + 0.5])

    def mesh(self, stamp_s: float, T_map_lidar: F64, rate_hz: float | None, reach_m: float) -> tuple[F32, I32]:
        """Triangles (m, 3, 3) in the map of the bodies within ``reach_m``, and the body each belongs to, (m,).

        With ``rate_hz`` each body stands where it is when the turning sensor faces it; None: where it is at the stamp.
        """
        everyone = np.arange(len(self._paths))
        pose = self.poses(everyone, np.full(len(everyone), stamp_s))
        offset = pose[:, :2] - T_map_lidar[:2, 3]
        near = np.flatnonzero(np.hypot(offset[:, 0], offset[:, 1]) < reach_m)
        pose = pose[near]
        if rate_hz is not None:
            forward = np.arctan2(T_map_lidar[1, 0], T_map_lidar[0, 0])
            bearing = np.arctan2(offset[near, 1], offset[near, 0]) - forward
            bearing = (bearing + np.pi) % (2.0 * np.pi) - np.pi
            pose = self.poses(near, stamp_s - bearing / (2.0 * np.pi) / rate_hz)
        chosen = np.isin(self._owners, near)
        row = np.searchsorted(near, self._owners[chosen])
        local, (x, y, yaw) = self._triangles[chosen], pose[row].T[..., None]
        mesh = np.empty(local.shape, dtype=np.float32)
        mesh[..., 0] = x + np.cos(yaw) * local[..., 0] - np.sin(yaw) * local[..., 1]
        mesh[..., 1] = y + np.sin(yaw) * local[..., 0] + np.cos(yaw) * local[..., 1]
        mesh[..., 2] = self._terrain.height(pose[:, 0], pose[:, 1])[row][:, None] + local[..., 2]
        return mesh, self._owners[chosen].astype(np.int32)


def make_traffic(
    scenario: Scenario, terrain: Terrain, lane: str, duration_s: float, rng: np.random.Generator
) -> Traffic:
    """Traffic met by a vehicle that drives in ``lane`` from its end of the street, for ``duration_s``."""
    clock: F64 = np.arange(-1.0, int(duration_s / PACE.step_s) + 4.0) * PACE.step_s
    tracks = _lanes(scenario, terrain, lane, clock, rng) + _kerbsides(scenario, terrain, clock, rng)
    if scenario.crossing_m is not None:
        tracks += _queues(scenario, terrain, clock, rng)
    return Traffic(tracks, terrain)


def _lanes(scenario: Scenario, terrain: Terrain, own_lane: str, clock: F64, rng: np.random.Generator) -> list[Track]:
    """Each lane flows at one speed of its own, so no car hits another; the vehicle's lane keeps a gap for it."""
    tracks = []
    for name, (direction, offset) in LANES.items():
        factor = 1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(0.08, 0.25)  # no car stays alongside for the whole drive
        speed = scenario.speed_kmh / 3.6 * (1.0 if name == own_lane else factor)
        entry = 0.0 if direction > 0 else scenario.length_m
        turns = scenario.crossing_m is not None and "outer" in name and name != own_lane
        for ahead in _spots(scenario.traffic.car_spacing_m, 11.0, speed * clock[-1], scenario.length_m, rng):
            body = _motor_vehicle(rng)
            aside = rng.normal(0.0, 0.15)
            if name == own_lane and -13.0 < ahead < 15.0:
                continue
            start = (entry + direction * ahead, terrain.axis_y + offset + aside)
            path = _straight(start, 0.0 if direction > 0 else np.pi, speed, 0.12, clock, rng)
            if turns and rng.uniform() < 0.3:
                path = _turn_left(start, direction, speed, scenario.crossing_m or 0.0, clock)
            tracks.append(Track(body, path))
    return tracks


def _kerbsides(scenario: Scenario, terrain: Terrain, clock: F64, rng: np.random.Generator) -> list[Track]:
    """Cyclists between the outer lane and the parked cars; pedestrians both ways on the sidewalks."""
    tracks = []
    length = scenario.length_m
    axis = terrain.axis_y
    for direction in (1, -1):
        for ahead in _spots(scenario.traffic.two_wheeler_spacing_m, 4.0, 7.0 * clock[-1], length, rng):
            start = ((0.0 if direction > 0 else length) + direction * ahead, axis + direction * (STREET.kerb_m - 2.4))
            path = _straight(start, 0.0 if direction > 0 else np.pi, rng.uniform(4.0, 7.0), 0.1, clock, rng)
            tracks.append(Track(shapes.two_wheeler(rng.uniform(1.6, 1.8)), path))
        for way in (1, -1):
            for ahead in _spots(2.0 * scenario.traffic.pedestrian_spacing_m, 1.5, 1.5 * clock[-1], length, rng):
                start = (
                    (0.0 if way > 0 else length) + way * ahead,
                    axis + direction * (STREET.kerb_m + rng.uniform(1.7, 2.4)),
                )
                path = _straight(start, 0.0 if way > 0 else np.pi, rng.uniform(0.9, 1.6), 0.12, clock, rng)
                tracks.append(Track(shapes.pedestrian(rng.uniform(1.5, 1.85)), path))
    return tracks


def _queues(scenario: Scenario, terrain: Terrain, clock: F64, rng: np.random.Generator) -> list[Track]:
    """The crossing street has red: its cars roll up one after another and stop, pedestrians walk along it."""
    assert scenario.crossing_m is not None
    tracks = []
    for direction in (1, -1):  # northbound keeps to the west
        for offset in (1.75, 5.25):
            stop = -(STREET.kerb_m + STREET.stop_line_m)
            arrival = rng.uniform(0.0, 4.0)
            while stop > -PACE.beyond_m:
                speed = rng.uniform(7.0, 10.0)
                brake = 2.5
                left = np.clip(speed - brake * np.maximum(clock - arrival, 0.0), 0.0, None)
                along = stop - speed**2 / (2 * brake) + speed * np.minimum(clock - arrival, 0.0)
                along = along + (speed**2 - left**2) / (2 * brake)
                x = np.full_like(along, scenario.crossing_m - direction * offset)
                heading = np.full_like(along, direction * 0.5 * np.pi)
                path = np.column_stack([x, terrain.axis_y + direction * along, heading])
                tracks.append(Track(_motor_vehicle(rng), path))
                stop -= rng.uniform(12.0, 14.0)
                arrival += rng.uniform(1.5, 5.0)
        for ahead in _spots(2.0 * scenario.traffic.pedestrian_spacing_m, 1.5, 1.5 * clock[-1], PACE.beyond_m, rng):
            start = (
                scenario.crossing_m + direction * (STREET.kerb_m + 2.0),
                terrain.axis_y - 0.5 * PACE.beyond_m + ahead,
            )
            path = _straight(start, direction * 0.5 * np.pi, rng.uniform(0.9, 1.6), 0.12, clock, rng)
            tracks.append(Track(shapes.pedestrian(rng.uniform(1.5, 1.85)), path))
    return tracks


def _straight(
    start: tuple[float, float], heading: float, speed: float, weave_m: float, clock: F64, rng: np.random.Generator
) -> F64:
    """A track along ``heading`` at constant speed, weaving a little from side to side."""
    rate = rng.uniform(0.3, 0.8)
    phase = rng.uniform(0.0, 2.0 * np.pi)
    along = speed * clock
    aside = weave_m * np.sin(rate * clock + phase)
    yaw = heading + weave_m * rate * np.cos(rate * clock + phase) / speed
    c = np.cos(heading)
    s = np.sin(heading)
    return np.column_stack([start[0] + c * along - s * aside, start[1] + s * along + c * aside, yaw])


def _turn_left(start: tuple[float, float], direction: int, speed: float, crossing_x: float, clock: F64) -> F64:
    """Along the outer lane, then a quarter circle into the crossing street's outer lane."""
    radius = 8.0
    bend = direction * (crossing_x - start[0]) - 5.25 - radius
    along = speed * clock
    angle = np.clip((along - bend) / radius, 0.0, 0.5 * np.pi)
    forward = np.minimum(along, bend) + radius * np.sin(angle)
    left = radius * (1.0 - np.cos(angle)) + np.maximum(along - bend - 0.5 * np.pi * radius, 0.0)
    heading = angle + (0.0 if direction > 0 else np.pi)
    return np.column_stack([start[0] + direction * forward, start[1] + direction * left, heading])


def _spots(spacing: float, least: float, travel: float, length: float, rng: np.random.Generator) -> F64:
    """Start positions, as distance from the lane's entry, of all that will be on the street during the drive."""
    if spacing <= 0:
        return np.zeros(0)
    count = int((travel + length + 2 * PACE.beyond_m) / spacing) + 1
    steps = least + rng.exponential(max(spacing - least, 0.1), size=count)
    return length + PACE.beyond_m - np.cumsum(steps)


def _motor_vehicle(rng: np.random.Generator) -> F64:
    kind = rng.uniform()
    if kind < 0.73:
        return shapes.car(rng.uniform(3.6, 4.8), rng.uniform(1.6, 1.85), rng.uniform(1.4, 1.8))
    if kind < 0.92:
        return shapes.van(rng.uniform(5.0, 6.5), 2.0, rng.uniform(2.0, 2.9))
    if kind < 0.97:
        return shapes.two_wheeler(1.6, motor=True)
    return shapes.bus()
