"""Points without times of a sensor that leans: azimuths count about the axis that its rings lie about."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from faults import Recording
from mapvote.core.geometry import exp, from_xyz_rpy, inverse, transform
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64
from mapvote.doctor.scans import Looking, cheap_checks
from mapvote.formats import open_drive
from mapvote.formats.drives.ring_axis import level_by_axis, ring_axis

HDL = SENSORS["hdl32e"]


def _scan(seed: int) -> F64:
    """(n, 4) walls and a road around the sensor, firing by firing, in its own frame."""
    rng = np.random.default_rng(seed)
    azimuth = np.repeat(np.radians(np.arange(0, 360, 0.8)), HDL.beams)
    elevation = np.tile(np.radians(HDL.elevations_deg), 450)
    reach = 12.0 + 6.0 * np.sin(3.0 * azimuth) + rng.normal(0, 0.02, len(azimuth))
    reach = np.where(elevation < 0, np.minimum(reach, 1.8 / np.sin(np.maximum(-elevation, 1e-3))), reach)
    flat = np.cos(elevation)
    directions = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    return np.column_stack([reach[:, None] * directions, np.full(len(azimuth), 0.5)])


def _written(folder: Path, turned: F64, mounted: F64, named: bool) -> Path:
    """A drive whose points were ``turned`` (4, 4) after the scan, of a sensor ``mounted`` (4, 4) on the vehicle."""
    T = np.array([exp(k * np.array([3.0, 0, 0, 0, 0, 0.05])) for k in range(4)]) @ mounted @ inverse(turned)
    scans = [_scan(k) for k in range(4)]
    points = [np.column_stack([transform(turned, s[:, :3]), s[:, 3]]) for s in scans]
    toml = {"motion_compensated": False} | ({"sensor": "hdl32e"} if named else {})
    Recording(points, T, np.linspace(0.0, 0.3, 4), toml).write(folder)
    return folder


def mount(roll: float, pitch: float, yaw: float) -> F64:
    return from_xyz_rpy(0, 0, 0, *np.radians([roll, pitch, yaw]))


@pytest.mark.parametrize(
    ("rpy", "named"),
    [
        *(((r, p, y), True) for r, p, y in ((180, 0, 0), (0, 180, 0), (90, 0, 0), (0, 0, 135), (135, -90, 45))),
        *(((r, p, y), False) for r, p, y in ((180, 0, 0), (0, 180, 0), (0, 0, 135))),
    ],
)
def test_points_that_were_turned_keep_their_times(tmp_path: Path, rpy: tuple[int, int, int], named: bool) -> None:
    sound = open_drive(_written(tmp_path / "sound", np.eye(4), np.eye(4), named))
    turned = open_drive(_written(tmp_path / "turned", mount(*rpy), np.eye(4), named))
    expected, found = sound.read_scan(1).time_s, turned.read_scan(1).time_s
    assert expected is not None
    assert found is not None
    apart = np.abs(found - expected)
    assert np.median(apart) < 1e-5
    assert (np.minimum(apart, 0.1 - apart) < 1e-4).all()  # at the seam a point may be the first or the last


@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(10, 0), (0, -6), (4, 7)])
def test_points_that_were_tilted_keep_their_times(tmp_path: Path, roll_deg: int, pitch_deg: int) -> None:
    """But for one constant: two small turns about x and y are a little turn about z, too."""
    sound = open_drive(_written(tmp_path / "sound", np.eye(4), np.eye(4), False))
    turned = open_drive(_written(tmp_path / "tilted", mount(roll_deg, pitch_deg, 0), np.eye(4), False))
    expected, found = sound.read_scan(1).time_s, turned.read_scan(1).time_s
    assert expected is not None
    assert found is not None
    apart = (found - expected + 0.05) % 0.1 - 0.05
    assert abs(np.median(apart)) < 1e-4
    assert np.abs(apart - np.median(apart)).max() < 1e-4


def test_a_sensor_that_hangs_upside_down_turns_about_its_own_axis(tmp_path: Path) -> None:
    sound = open_drive(_written(tmp_path / "sound", np.eye(4), np.eye(4), True))
    hanging = open_drive(_written(tmp_path / "hanging", np.eye(4), mount(180, 0, 0), True))
    expected, found = sound.read_scan(1).time_s, hanging.read_scan(1).time_s
    assert expected is not None
    assert found is not None
    assert np.array_equal(found, expected)


def test_a_named_sensor_whose_points_were_turned_over_is_no_other_one(tmp_path: Path) -> None:
    drive = open_drive(_written(tmp_path / "turned", mount(180, 0, 0), np.eye(4), True))
    found = cheap_checks(drive, Looking(drive).look(range(4)))
    assert not [finding.what for finding in found if "beams" in finding.what]


@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(0, 0), (10, 0), (-3, 8), (0.7, -0.4)])
def test_the_axis_of_the_rings_of_tilted_points_is_found(roll_deg: float, pitch_deg: float) -> None:
    turned = mount(roll_deg, pitch_deg, 0.0)
    axis = ring_axis(transform(turned, _scan(3)[:, :3]))
    assert np.degrees(np.arccos(np.clip(axis @ turned[:3, 2], -1.0, 1.0))) < 0.15
    assert np.allclose(level_by_axis(axis) @ axis, [0.0, 0.0, 1.0], atol=1e-12)
    assert np.allclose(level_by_axis(axis) @ level_by_axis(axis).T, np.eye(3), atol=1e-12)
