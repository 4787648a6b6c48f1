"""Moving-object removal (paper II, [9]) in a street of boxes cast by plane arithmetic, with exact labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapvote.config import MovingSettings, VotingSettings
from mapvote.core.grid import CELL_SIZE, Lattice, window_around
from mapvote.core.sensors import SENSORS, Sensor
from mapvote.core.types import F64, Bool
from mapvote.perception import moving_objects
from mapvote.perception.moving_kernels import voxels
from mapvote.perception.moving_objects import REACH_M, MovingFilter

LIDAR_HEIGHT = 1.9
Box = tuple[float, float, float, float, float]
"""x0, y0, x1, y1 and top, standing on the ground z = 0."""

WALLS: list[Box] = [(-80.0, 8.0, 120.0, 9.0, 6.0), (-80.0, -9.0, 10.0, -8.0, 4.0), (25.0, -30.0, 26.0, -8.0, 5.0)]
PARKED: list[Box] = [(x, 5.5, x + 4.4, 7.3, 1.5) for x in (-20.0, -5.0, 2.0, 20.0)]
POLES: list[Box] = [(x, -6.0, x + 0.15, -5.85, 5.0) for x in (-15.0, 5.0, 18.0)]


def coarse(name: str) -> Sensor:
    """The named sensor with fewer azimuths, to keep tests short."""
    return replace(SENSORS[name], azimuth_step_deg=0.6)


def cast(sensor: Sensor, origin: F64, boxes: list[Box], rng: np.random.Generator) -> tuple[F64, np.ndarray]:
    """(points (n, 3), index of the box hit or -1 for the ground) of one instantaneous revolution."""
    azimuth = np.radians(np.arange(0.0, 360.0, sensor.azimuth_step_deg))
    elevation = np.radians(np.array(sensor.elevations_deg))
    a, e = (m.ravel() for m in np.meshgrid(azimuth, elevation))
    d = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        best = np.where(d[:, 2] < 0, -origin[2] / d[:, 2], np.inf)
        which = np.full(len(d), -1)
        for index, (x0, y0, x1, y1, top) in enumerate(boxes):
            near = (np.array([x0, y0, 0.0]) - origin) / d
            far = (np.array([x1, y1, top]) - origin) / d
            enter, leave = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
            hit = (enter < leave) & (enter > 0) & (enter < best)
            best[hit], which[hit] = enter[hit], index
    seen = best < 60.0
    ranges = best[seen] + rng.normal(0.0, sensor.range_sigma_m, int(seen.sum()))
    return origin + ranges[:, None] * d[seen], which[seen]


class Street:
    """Our vehicle drives east at 10 m/s; everything else as the test says."""

    def __init__(self, sensor: Sensor, rate_hz: float, seconds: float, movers: list[tuple[Box, float]]) -> None:
        rng = np.random.default_rng(1)
        fixed = WALLS + PARKED + POLES
        self.scans: list[tuple[F64, F64, Bool, int]] = []
        self.truth: list[Bool] = []
        for t in np.arange(0.0, seconds, 1.0 / rate_hz):
            origin = np.array([10.0 * t - 10.0, 0.0, LIDAR_HEIGHT])
            now = [(x0 + v * t, y0, x1 + v * t, y1, top) for (x0, y0, x1, y1, top), v in movers]
            points, which = cast(sensor, origin, fixed + now, rng)
            self.scans.append((points, origin, points[:, 2] > 0.3, round(t * 1e9)))
            self.truth.append(which >= len(fixed))

    def run(self, sensor: Sensor, settings: MovingSettings) -> list[Bool]:
        moving = MovingFilter(sensor, settings)
        masks = []
        for points, origin, obstacle, stamp_ns in self.scans:
            masks += moving.push(points, origin, obstacle, stamp_ns)
        return masks + moving.flush()

    def score(self, masks: list[Bool]) -> tuple[float, float]:
        """(precision, recall) over all obstacle points."""
        found = np.concatenate(masks)
        truth = np.concatenate([t & s[2] for t, s in zip(self.truth, self.scans, strict=True)])
        return float((found & truth).sum() / max(found.sum(), 1)), float((found & truth).sum() / max(truth.sum(), 1))


ONCOMING: tuple[Box, float] = ((30.0, 2.6, 34.4, 4.4, 1.5), -11.0)
AHEAD: tuple[Box, float] = ((2.0, -1.0, 6.4, 0.8, 1.5), 10.0)
WALKER: tuple[Box, float] = ((4.0, -5.0, 4.5, -4.5, 1.8), 1.4)


@pytest.mark.parametrize(
    ("sensor_name", "rate_hz"),
    [
        ("vlp16", 10.0),
        ("hdl32e", 2.0),
        *(
            pytest.param(name, rate_hz, marks=pytest.mark.slow)
            for name, rate_hz in (
                ("vlp16", 2.0),
                ("vlp16", 5.0),
                ("hdl32e", 5.0),
                ("hdl32e", 10.0),
                ("hdl64e", 2.0),
                ("hdl64e", 5.0),
                ("hdl64e", 10.0),
            )
        ),
    ],
)
def test_movers_are_found_and_nothing_else_at_any_rate_and_number_of_beams(sensor_name: str, rate_hz: float) -> None:
    sensor = coarse(sensor_name)
    street = Street(sensor, rate_hz, 4.0, [ONCOMING, AHEAD, WALKER])
    precision, recall = street.score(street.run(sensor, MovingSettings()))
    assert precision >= 0.97
    assert recall >= 0.60


@pytest.mark.parametrize("x", [0.01, 0.15, 0.29])
def test_whatever_can_vote_is_looked_at_up_to_the_corners_of_the_local_grid(x: float) -> None:
    grid = window_around(Lattice(), x, x, VotingSettings().window_m)
    rows, cols = np.array([0, 0, grid.rows, grid.rows]), np.array([0, grid.cols, 0, grid.cols])
    corners = np.column_stack([grid.x0 + CELL_SIZE * cols, grid.y0 + CELL_SIZE * rows, np.ones(4)])
    origin = np.array([x, x, LIDAR_HEIGHT])
    assert np.linalg.norm(corners - origin, axis=1).max() > 56.5
    voxel_of, _ = voxels(corners, np.ones(4, np.bool_), origin, REACH_M, CELL_SIZE)
    assert (voxel_of >= 0).all()


def test_what_comes_into_view_is_not_moving() -> None:
    """A street without movers: walls appear from behind corners and parked cars, and all of it stays."""
    sensor = coarse("hdl32e")
    street = Street(sensor, 10.0, 3.0, [])
    found = np.concatenate(street.run(sensor, MovingSettings()))
    assert found.mean() < 1e-3


def test_a_car_that_waits_is_static_once_its_arrival_is_older_than_the_window() -> None:
    sensor = coarse("hdl32e")
    street = Street(sensor, 10.0, 3.0, [((6.0, -4.0, 10.4, -2.2, 1.5), 0.0)])
    assert not any(mask.mean() > 1e-3 for mask in street.run(sensor, MovingSettings()))


def test_a_scan_is_decided_within_the_look_ahead_and_no_later_scan_changes_it() -> None:
    sensor = coarse("hdl32e")
    settings = MovingSettings(lookahead_s=0.5)
    street = Street(sensor, 10.0, 2.5, [ONCOMING])
    whole = street.run(sensor, settings)
    moving = MovingFilter(sensor, settings)
    decided = 0
    for newest, (points, origin, obstacle, stamp_ns) in enumerate(street.scans):
        for mask in moving.push(points, origin, obstacle, stamp_ns):
            assert newest - decided <= 5
            np.testing.assert_array_equal(mask, whole[decided])
            decided += 1
    assert decided + len(moving.flush()) == len(street.scans)


def test_nothing_older_than_the_window_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = coarse("hdl32e")
    monkeypatch.setattr(moving_objects, "PAST_S", 1.0)
    settings = MovingSettings(lookahead_s=0.5)
    street = Street(sensor, 10.0, 2.5, [ONCOMING])
    whole = street.run(sensor, settings)
    street.scans = street.scans[5:]
    late = street.run(sensor, settings)
    for index in range(10, len(late)):  # a second of history behind it
        np.testing.assert_array_equal(late[index], whole[index + 5])


def test_only_obstacle_points_are_called_moving_and_an_empty_scan_is_no_trouble() -> None:
    sensor = coarse("hdl32e")
    street = Street(sensor, 10.0, 2.0, [ONCOMING])
    _, origin, _, stamp_ns = street.scans[7]
    street.scans[7] = (np.zeros((0, 3)), origin, np.zeros(0, dtype=bool), stamp_ns)
    masks = street.run(sensor, MovingSettings())
    assert masks[7].shape == (0,)
    assert not any((masks[i] & ~street.scans[i][2]).any() for i in range(len(street.scans)))
    assert MovingFilter(sensor, MovingSettings()).flush() == []


def test_stamps_must_increase() -> None:
    moving = MovingFilter(coarse("hdl32e"), MovingSettings())
    scan = (np.zeros((0, 3)), np.zeros(3), np.zeros(0, dtype=bool))
    moving.push(*scan, 5)
    with pytest.raises(ValueError, match="stamps must increase"):
        moving.push(*scan, 5)
