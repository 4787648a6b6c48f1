"""Scans become a map that holds what stands, near and far, and nothing of what drove ahead of the surveyor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapvote.config import Settings
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.point_map import all_points, map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, Drive, Scan
from mapvote.slam.accumulate import Layer

AHEAD_M = 60.0
WALL_X = 100.0


def sheet(x: F64, y: F64, z: F64) -> F64:
    return np.stack(np.meshgrid(x, y, z), axis=-1).reshape(-1, 3)


def scene(sensor_x: float) -> F64:
    """A road to a wall across its end, and the back of a van that keeps 60 m ahead of the sensor."""
    road = sheet(np.arange(-20.0, WALL_X, 0.5), np.arange(-8.0, 8.0, 0.5), np.zeros(1))
    wall = sheet(np.array([WALL_X]), np.arange(-8.0, 8.0, 0.3), np.arange(0.1, 6.0, 0.3))
    back = sheet(np.array([sensor_x + AHEAD_M]), np.arange(-1.0, 1.1, 0.25), np.arange(0.4, 2.6, 0.25))
    rest = np.concatenate([road, wall])
    hidden = (rest[:, 0] > sensor_x + AHEAD_M) & (np.abs(rest[:, 1]) < 1.7) & (rest[:, 2] < 2.6)
    return np.concatenate([rest[~hidden], back])


@pytest.fixture(scope="module")
def laid() -> F64:
    """The points of the map of a drive of three seconds at 10 m/s behind the van (at 89 m when it ends)."""
    poses = np.array([from_xyz_rpy(x, 0.0, 1.8, 0.0, 0.0, 0.0) for x in np.arange(30.0)])
    stamps_ns = np.arange(1, 31) * 100_000_000

    def read_scan(i: int) -> Scan:
        return Scan(int(stamps_ns[i]), transform(inverse(poses[i]), scene(float(i))).astype(np.float32))

    drive = Drive(Path("behind"), "survey", "behind", SENSORS["hdl32e"], stamps_ns, read_scan)
    draft = map_from_points(np.concatenate([scene(float(x)) for x in range(30)]))
    layer = Layer(draft, Settings())
    layer.lay(drive, poses, np.ones(30, np.bool_), lambda: None)
    return all_points(layer.finish())


def test_a_van_that_is_never_nearer_than_60_m_leaves_no_trail(laid: F64) -> None:
    trail = (laid[:, 0] > 61.0) & (laid[:, 0] < 87.5) & (np.abs(laid[:, 1]) < 1.5) & (laid[:, 2] > 0.3)
    assert not trail.any()


def test_a_wall_that_is_never_nearer_than_70_m_stays_and_returns_from_farther_than_80_m_do_not_count(laid: F64) -> None:
    wall = laid[np.abs(laid[:, 0] - WALL_X) < 0.2]
    assert len(wall) > 700  # of 54 x 20 voxels, less what the van hid
    assert laid[:, 0].min() > -20.5
    far = Settings().model_copy(update={"mapping": Settings().mapping.model_copy(update={"reach_m": 65.0})})
    layer = Layer(map_from_points(scene(0.0)), far)
    poses = np.eye(4)[None].repeat(2, axis=0)
    poses[:, 2, 3] = 1.8
    scan = transform(inverse(poses[0]), scene(0.0)).astype(np.float32)
    drive = Drive(
        Path("still"), "survey", "still", SENSORS["hdl32e"], np.array([1, 2]), lambda i: Scan(i + 1, scan)
    )  # fmt: skip
    layer.lay(drive, poses, np.ones(2, np.bool_), lambda: None)
    assert np.hypot(*all_points(layer.finish())[:, :2].T).max() <= 65.0


@pytest.mark.parametrize("drop", [True, False])
def test_what_one_scan_of_many_met_stays_out_of_the_map_unless_strays_are_kept(drop: bool) -> None:
    mapping = Settings().mapping.model_copy(update={"drop_strays": drop})
    poses = np.array([from_xyz_rpy(x, 0.0, 1.8, 0.0, 0.0, 0.0) for x in np.arange(60.0)])
    road = sheet(np.arange(-20.0, 80.0, 0.5), np.arange(-8.0, 8.0, 0.5), np.zeros(1))
    layer = Layer(map_from_points(road), Settings().model_copy(update={"mapping": mapping}))
    stray = np.array([[30.1, 5.1, 2.0]])

    def read_scan(i: int) -> Scan:
        points = np.concatenate([road, stray]) if i == 50 else road
        return Scan(i, transform(inverse(poses[i]), points).astype(np.float32))

    drive = Drive(Path("once"), "survey", "once", SENSORS["hdl32e"], np.arange(60), read_scan)
    layer.lay(drive, poses, np.ones(60, np.bool_), lambda: None)
    assert (all_points(layer.finish())[:, 2] > 1.0).any() != drop


def test_what_drove_past_a_parked_car_leaves_no_trail_beside_it() -> None:
    """Hits on the car strike the voxels next to it too; seen through they are by all scans but the two that met it."""
    poses = np.array([from_xyz_rpy(x, 0.0, 1.8, 0.0, 0.0, 0.0) for x in np.arange(40.0)])
    road = sheet(np.arange(-20.0, 60.0, 0.5), np.arange(-8.0, 8.0, 0.5), np.zeros(1))
    house = sheet(np.arange(-20.0, 60.0, 0.3), np.array([8.0]), np.arange(0.15, 6.0, 0.3))
    heights = np.arange(0.5, 1.5, 0.1)
    parked = sheet(np.arange(20.0, 24.0, 0.1), np.array([5.0]), heights)
    passing = sheet(np.arange(20.0, 24.0, 0.1), np.array([4.65]), heights)
    street = np.concatenate([road, house, parked])
    layer = Layer(map_from_points(np.concatenate([street, passing])), Settings())

    def read_scan(i: int) -> Scan:
        points = np.concatenate([street, passing]) if 15 <= i < 17 else street
        return Scan(i, transform(inverse(poses[i]), points).astype(np.float32))

    drive = Drive(Path("past"), "survey", "past", SENSORS["hdl32e"], np.arange(40), read_scan)
    layer.lay(drive, poses, np.ones(40, np.bool_), lambda: None)
    points = all_points(layer.finish())
    standing = points[(points[:, 2] > 0.3) & (points[:, 0] > 20.5) & (points[:, 0] < 23.5)]
    assert not (np.abs(standing[:, 1] - 4.65) < 0.1).any()
    assert (np.abs(standing[:, 1] - 5.0) < 0.1).sum() > 30
