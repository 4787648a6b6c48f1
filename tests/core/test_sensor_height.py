"""Path and ground agree in one figure, the height of the sensor, or somebody is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.sensor_height import check_heights, two_levels
from mapvote.core.types import F64


def street() -> PointMap:
    xy = np.random.default_rng(0).uniform((-10.0, -10.0), (90.0, 10.0), (60_000, 2))
    return map_from_points(np.column_stack([xy, 0.02 * xy[:, 0]]))


def path(height: float, length: float = 80.0) -> F64:
    x = np.arange(0.0, length, 1.0)
    return np.column_stack([x, np.zeros(len(x)), 0.02 * x + height])


def test_on_sound_ground_the_sensor_keeps_its_height_and_beyond_the_map_nothing_is_known() -> None:
    heights = check_heights(street(), path(1.73))
    assert abs(heights.median_m - 1.73) < 0.02
    assert abs(heights.worst_off_m) < 0.05
    assert heights.complaint == ""
    assert "1.73 m over the ground" in str(heights)
    assert "unknown under" in str(check_heights(street(), path(1.73, 120.0)))
    off = check_heights(street(), path(1.73) + np.array([1000.0, 0.0, 0.0]))
    assert off.complaint == "the map has no ground under the path"


def test_a_stretch_where_the_ground_sank_is_named_with_its_place() -> None:
    sunk = {}
    for index, tile in street().tiles.items():
        x = tile.window.x0 + 0.3 * np.arange(256)
        sunk[index] = replace(tile, ground_z=np.where((x > 40) & (x < 50), tile.ground_z - 4.0, tile.ground_z))
    heights = check_heights(replace(street(), tiles=sunk), path(1.73))
    assert abs(heights.median_m - 1.73) < 0.02
    assert abs(heights.worst_off_m - 4.0) < 0.05
    assert 40 < heights.worst_xy[0] < 50
    assert 0.1 < heights.off_share < 0.15
    assert "disagree by more than 0.3 m along" in heights.complaint


def test_a_drive_over_a_bridge_that_it_passed_below_is_two_levels() -> None:
    below = path(0.0)
    above = np.column_stack([np.full(60, 40.0), np.arange(-30.0, 30.0), np.full(60, 6.8)])
    x, y, apart = two_levels(np.vstack([below, above])) or (0.0, 0.0, 0.0)
    assert abs(apart - 6.0) < 0.05
    assert abs(x - 40.0) < 1.0
    assert abs(y) < 1.0
    assert two_levels(below) is None
    assert two_levels(np.vstack([below, below + np.array([0.0, 0.2, 0.05])])) is None
