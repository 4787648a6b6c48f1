"""The height of the sensor over the road comes from the points on the driven track."""

from __future__ import annotations

import numpy as np

from mapvote.core.types import F64
from mapvote.slam.road_prior import road_under


def driven(length_m: float, height: float = 1.73, grade: float = 0.0) -> F64:
    """(n, 4, 4) a metre apart along x."""
    T = np.tile(np.eye(4), (int(length_m), 1, 1))
    T[:, 0, 3] = np.arange(len(T))
    T[:, 2, 3] = height + grade * T[:, 0, 3]
    return T


def track(rng: np.random.Generator, count: int, z: float, spread: float, length_m: float = 60.0) -> F64:
    xy = np.column_stack([rng.uniform(0, length_m, count), rng.uniform(-0.7, 0.7, count)])
    return np.column_stack([xy, rng.uniform(z - spread, z + spread, count)])


def test_reflections_and_the_car_ahead_do_not_change_the_height_of_the_sensor() -> None:
    rng = np.random.default_rng(0)
    road, below, car = track(rng, 800, 0.0, 0.02), track(rng, 200, -3.0, 2.5), track(rng, 400, 0.8, 0.6)
    found = road_under(driven(60.0), np.ones(60, np.bool_), np.vstack([road, below, car]))
    assert abs(found.sensor_height_m - 1.73) < 0.02
    assert found.measured_share > 0.95
    np.testing.assert_allclose(found.points_map[:, 2], 0.0, atol=0.02)


def test_on_a_hill_the_road_climbs_with_the_path() -> None:
    rng = np.random.default_rng(1)
    cloud = track(rng, 2000, 0.0, 0.02)
    cloud[:, 2] += 0.1 * cloud[:, 0]
    found = road_under(driven(60.0, grade=0.1), np.ones(60, np.bool_), cloud)
    np.testing.assert_allclose(found.points_map[:, 2], 0.1 * found.points_map[:, 0], atol=0.02)


def test_where_no_scan_was_registered_there_is_no_witness() -> None:
    registered = np.ones(60, np.bool_)
    registered[20:40] = False
    found = road_under(driven(60.0), registered, track(np.random.default_rng(2), 3000, 0.0, 0.02))
    assert not ((found.points_map[:, 0] > 19.01) & (found.points_map[:, 0] < 39.99)).any()


def test_a_path_without_measured_road_says_so_instead_of_guessing() -> None:
    cloud = track(np.random.default_rng(3), 300, 0.0, 0.02, length_m=8.0)
    found = road_under(driven(60.0), np.ones(60, np.bool_), cloud)
    assert len(found.points_map) == 0
    assert found.measured_share < 0.3
    assert np.isnan(road_under(driven(60.0), np.ones(60, np.bool_), cloud + 50.0).sensor_height_m)
