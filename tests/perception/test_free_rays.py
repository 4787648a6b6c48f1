"""Rays without return: where all below answers and nothing above does, they went into the sky."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.geometry import rows_from
from mapvote.core.grid import CELL_SIZE
from mapvote.core.sensors import SENSORS, Sensor
from mapvote.core.types import F32, F64, Bool
from mapvote.formats import open_drive
from mapvote.formats.drives.trajectory import read_poses
from mapvote.localisation.prepare import deskew, motion_at
from mapvote.perception.fans import FANS, Rays, follow_rays
from mapvote.perception.raycast import SECTORS, SKY_M, Sky
from mapvote_lab.simulation import simulate
from mapvote_lab.simulation.lidar import Caster
from mapvote_lab.simulation.scenario import load_scenario
from mapvote_lab.simulation.world import make_world

SENSOR = SENSORS["hdl32e"]
UP = np.array([0.0, 0.0, 1.0])
BEAMS = np.array(SENSOR.elevations_deg)


def directions(sensor: Sensor = SENSOR) -> tuple[F64, F64, F64]:
    """((rays, 3) of a whole turn, azimuths in degrees, elevations)."""
    azimuth, elevation = np.meshgrid(np.arange(0.0, 360.0, sensor.azimuth_step_deg), sensor.elevations_deg)
    a, e = np.radians(azimuth.ravel()), np.radians(elevation.ravel())
    return (
        np.column_stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)]),
        azimuth.ravel(),
        elevation.ravel(),
    )


def sky_of(answered: Bool, sensor: Sensor = SENSOR, up: F64 = UP, R: F64 | None = None) -> Rays:
    """What went into the sky if of all rays those ``answered``, from 20 m; the sensor turned by ``R`` (3, 3)."""
    rays = 20.0 * directions(sensor)[0][answered] @ (np.eye(3) if R is None else R).T
    return Sky(sensor).rays(up, follow_rays(np.ascontiguousarray(rays.T, dtype=np.float32), 0.45))


def azimuths_of(sky: Rays) -> F32:
    return np.asarray(np.degrees(np.arctan2(sky.y, sky.x)) % 360.0)


def elevations_of(sky: Rays) -> F32:
    return np.asarray(np.degrees(np.arctan(sky.slope * CELL_SIZE)))


def test_above_a_wall_all_round_every_beam_but_the_one_next_to_it_went_into_the_sky() -> None:
    _, _, elevation = directions()
    sky = sky_of(elevation < 3.0)
    free = BEAMS[BEAMS > 3.0]
    np.testing.assert_allclose(np.unique(elevations_of(sky).round(3)), np.sort(free)[1:], atol=0.01)
    assert len(sky.reach) == (len(free) - 1) * FANS // 2, "every second fan"
    assert (sky.reach == SKY_M).all()
    assert (sky.stop == SKY_M).all()


def test_beside_a_house_the_sky_begins_a_sector_later() -> None:
    _, azimuth, elevation = directions()
    house = (azimuth > 90.0) & (azimuth < 180.0)
    sky = azimuths_of(sky_of((elevation < 0.0) | house))
    wide = 360.0 / SECTORS
    assert not ((sky > 90.0 - wide) & (sky < 180.0 + wide)).any()
    assert (sky < 90.0 - 2.0 * wide).any()
    assert (sky > 180.0 + 2.0 * wide).any()


def test_a_beam_lost_here_and_there_is_not_the_sky() -> None:
    lost = np.random.default_rng(1).random(len(directions()[0])) < 0.5
    assert len(sky_of(~lost).reach) == 0


def test_where_hardly_anything_answered_nothing_is_told() -> None:
    _, azimuth, elevation = directions()
    packets = (azimuth > 40.0) & (azimuth < 80.0)
    sky = azimuths_of(sky_of((elevation < 0.0) & ~packets))
    assert not ((sky > 42.0) & (sky < 78.0)).any()
    assert len(sky_of(elevation < -25.0).reach) == 0, "the vehicle's own roof"


@given(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_the_rays_lean_as_the_sensor_does(roll_deg: float, pitch_deg: float) -> None:
    a, b = np.radians([roll_deg, pitch_deg])
    roll = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    pitch = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    R = pitch @ roll
    sky = sky_of(directions()[2] < 3.0, up=R @ UP, R=R)
    way = np.column_stack([sky.x, sky.y, sky.slope * CELL_SIZE])
    elevation = np.degrees(np.arcsin(way @ (R @ UP) / np.linalg.norm(way, axis=1)))
    nearest = np.abs(elevation[:, None] - BEAMS[BEAMS > 3.0]).min(axis=1)
    assert len(elevation) > 1000
    assert nearest.max() < 0.6, "less than half of what lies between two beams, and one is left out"


@pytest.mark.parametrize("sensor", [replace(SENSOR, rings=False), replace(SENSOR, elevations_deg=(0.0,))])
def test_of_a_sensor_whose_beams_nobody_knows_nothing_is_told(sensor: Sensor) -> None:
    answered = directions()[2] < 0.0
    rays = follow_rays(np.ascontiguousarray(20.0 * directions()[0][answered].T, dtype=np.float32), 0.45)
    assert len(Sky(sensor).rays(UP, rays).reach) == 0


WINDOW_M = 40.0


@pytest.mark.slow
def test_hardly_a_ray_into_the_sky_meets_anything_in_the_window(tmp_path: Path) -> None:
    simulate("corner", tmp_path / "corner", 5)
    world = make_world(load_scenario("corner", {}), 5)
    for number, vehicle in enumerate(("v1", "v2")):
        drive = open_drive(tmp_path / "corner" / vehicle)
        poses = read_poses(tmp_path / "corner" / "truth" / vehicle / "poses.txt")
        street, sky = Caster(*world.mesh(world.standing(number))), Sky(drive.sensor)
        reach = []
        for i in range(0, len(drive), 8):
            T = poses[i]
            points = deskew(drive.read_scan(i), motion_at(drive.stamps_ns, poses, i)) @ T[:3, :3].T + T[:3, 3]
            rays = sky.rays(T[:3, 2].copy(), follow_rays(rows_from(points, T[:3, 3].copy()), 0.45))
            way = np.column_stack([rays.x, rays.y, rays.slope * CELL_SIZE])
            length = np.linalg.norm(way, axis=1)
            starts = np.broadcast_to(T[:3, 3].astype(np.float32), way.shape).copy()
            ranges, _, _ = street.cast(starts, (way / length[:, None]).astype(np.float32))
            reach.append(ranges / length)
        met = np.concatenate(reach) < WINDOW_M
        assert len(met) > 200 * len(reach)
        assert met.mean() < 0.002
