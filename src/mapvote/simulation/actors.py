"""Traffic: cars, two-wheelers and pedestrians on plausible paths, all of which move (paper V)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapvote.core.types import F32, F64, I32
from mapvote.simulation import shapes
from mapvote.simulation.scenario import LANES, Scenario
from mapvote.simulation.terrain import KERB_M, Terrain

_BEYOND_M = 90.0
"""Bodies drive on beyond the ends of the street, as far as a ray reaches."""


@dataclass(frozen=True)
class Actor:
    """A body that moves at constant speed along x or y, weaving a little."""

    triangles: F64
    """(n, 3, 3) in its own frame: x forward, foot at z = 0."""
    start: tuple[float, float]
    heading: float
    speed: float
    weave_m: float
    weave_rate: float

    def poses(self, time_s: F64) -> tuple[F64, F64, F64]:
        """(x, y, yaw), each (n,), at ``time_s`` (n,) from the start of the drive."""
        along = self.speed * time_s
        aside = self.weave_m * np.sin(self.weave_rate * time_s)
        tilt = self.weave_m * self.weave_rate * np.cos(self.weave_rate * time_s) / max(self.speed, 0.5)
        c, s = np.cos(self.heading), np.sin(self.heading)
        return self.start[0] + c * along - s * aside, self.start[1] + s * along + c * aside, self.heading + tilt


@dataclass(frozen=True)
class Traffic:
    """All moving bodies of one drive."""

    actors: tuple[Actor, ...]
    terrain: Terrain

    def mesh(self, stamp_s: float, T_map_lidar: F64, rate_hz: float | None, reach_m: float) -> tuple[F32, I32]:
        """Triangles (n, 3, 3) near the sensor and the actor each belongs to, (n,).

        With ``rate_hz`` each body stands where it is when the turning sensor looks at it (plan's de-skew rule);
        None = all at the stamp.
        """
        parts, owners = [], []
        origin, forward = T_map_lidar[:2, 3], np.arctan2(T_map_lidar[1, 0], T_map_lidar[0, 0])
        for index, actor in enumerate(self.actors):
            x, y, yaw = (float(v[0]) for v in actor.poses(np.array([stamp_s])))
            dx, dy = x - origin[0], y - origin[1]
            if dx * dx + dy * dy > reach_m * reach_m:
                continue
            if rate_hz is not None:
                bearing = (np.arctan2(dy, dx) - forward + np.pi) % (2.0 * np.pi) - np.pi
                x, y, yaw = (float(v[0]) for v in actor.poses(np.array([stamp_s - bearing / (2 * np.pi * rate_hz)])))
            parts.append(shapes.place(actor.triangles, x, y, float(self.terrain.height(x, y)), yaw).astype(np.float32))
            owners.append(np.full(len(actor.triangles), index, dtype=np.int32))
        if not parts:
            return np.zeros((0, 3, 3), dtype=np.float32), np.zeros(0, dtype=np.int32)
        return np.concatenate(parts), np.concatenate(owners)


def make_traffic(
    scenario: Scenario, terrain: Terrain, lane: str, duration_s: float, rng: np.random.Generator
) -> Traffic:
    """Traffic met by a vehicle that drives in ``lane`` from its end of the street, for ``duration_s``."""
    axis, length, own = terrain.axis_y, scenario.length_m, scenario.speed_kmh / 3.6
    actors: list[Actor] = []
    for name, (direction, offset) in LANES.items():
        speed = own if name == lane else own * rng.uniform(0.75, 1.2)
        entry = 0.0 if direction > 0 else length
        for gap in _gaps(scenario.traffic.car_spacing_m, 11.0, speed * duration_s, length, rng):
            body = _motor_vehicle(rng)
            if name == lane and -13.0 < gap < 15.0:
                continue  # room for the vehicle itself, which enters at gap 0
            start = (entry + direction * gap, axis + offset + rng.normal(0.0, 0.15))
            actors.append(_actor(body, start, direction, speed, 0.12, rng))
    for direction in (1, -1):
        for gap in _gaps(scenario.traffic.two_wheeler_spacing_m, 4.0, 7.0 * duration_s, length, rng):
            entry = 0.0 if direction > 0 else length
            start = (entry + direction * gap, axis + direction * (KERB_M - 2.5 + rng.uniform(-0.15, 0.15)))
            actors.append(
                _actor(shapes.two_wheeler(rng.uniform(1.6, 1.8)), start, direction, rng.uniform(4, 7), 0.1, rng)
            )
        for gap in _gaps(scenario.traffic.pedestrian_spacing_m, 1.5, 1.5 * duration_s, length, rng):
            for way in (1, -1):
                start = (length - gap if way < 0 else gap, axis + direction * (KERB_M + rng.uniform(1.7, 2.9)))
                walker = shapes.pedestrian(rng.uniform(1.5, 1.85))
                actors.append(_actor(walker, start, way, rng.uniform(0.9, 1.6), 0.15, rng))
    if scenario.crossing_m is not None:
        actors += _crossing(scenario, axis, duration_s, rng)
    return Traffic(tuple(actors), terrain)


def _gaps(spacing: float, least: float, travel: float, length: float, rng: np.random.Generator) -> F64:
    """Start positions along a lane, as distance from its entry: all that will be on the street during the drive."""
    if spacing <= 0:
        return np.zeros(0)
    count = int((travel + length + 2 * _BEYOND_M) / spacing) + 1
    steps = least + rng.exponential(max(spacing - least, 0.1), size=count)
    return length + _BEYOND_M - np.cumsum(steps)


def _motor_vehicle(rng: np.random.Generator) -> F64:
    kind = rng.uniform()
    if kind < 0.7:
        return shapes.car(rng.uniform(3.6, 4.8), rng.uniform(1.6, 1.85), rng.uniform(1.4, 1.8))
    if kind < 0.9:
        return shapes.van(rng.uniform(5.0, 6.5), 2.0, rng.uniform(2.0, 2.9))
    if kind < 0.95:
        return shapes.two_wheeler(1.6, motor=True)
    return shapes.bus()


def _actor(
    body: F64, start: tuple[float, float], direction: int, speed: float, weave: float, rng: np.random.Generator
) -> Actor:
    heading = 0.0 if direction > 0 else np.pi
    return Actor(body, start, heading, speed, weave, rng.uniform(0.3, 0.8))


def _crossing(scenario: Scenario, axis: float, duration_s: float, rng: np.random.Generator) -> list[Actor]:
    """Vehicles and pedestrians of the street that crosses, which have green when the main street's gaps allow."""
    assert scenario.crossing_m is not None
    actors = []
    speed = scenario.speed_kmh / 3.6 * 0.6
    for direction in (1, -1):
        for offset in (1.75, 5.25):
            for gap in _gaps(2.0 * scenario.traffic.car_spacing_m, 12.0, speed * duration_s, 2 * _BEYOND_M, rng):
                start = (scenario.crossing_m - direction * offset, axis + direction * (gap - _BEYOND_M))
                body = _motor_vehicle(rng)
                actors.append(Actor(body, start, direction * 0.5 * np.pi, speed, 0.1, rng.uniform(0.3, 0.8)))
    return actors
