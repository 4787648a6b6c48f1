"""The LiDAR against geometry worked out by other means."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.core.sensors import NAMED, SENSORS
from mapvote.core.types import F32, F64, Scan
from mapvote.formats.drives.sensor_estimate import estimate_sensor
from mapvote_lab.simulation import shapes
from mapvote_lab.simulation.lidar import Caster, SlicedCaster, Sweep, measure, sweep
from mapvote_lab.simulation.patterns import in_view
from mapvote_lab.simulation.truth import TRUTH_RULE, passed_surfaces


def at(T: F64) -> F64:
    return np.broadcast_to(T, (1, 4, 4)).astype(np.float64)


def box_ranges(origins: F64, directions: F64, low: F64, high: F64) -> F64:
    """Where rays (n, 3) enter the box, by the slab method (Kay and Kajiya 1986); inf where they miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - origins) / directions, (high - origins) / directions
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def test_rays_meet_boxes_where_the_slab_method_says() -> None:
    rng = np.random.default_rng(0)
    lows = np.column_stack([rng.uniform(-60, 60, (80, 2)), rng.uniform(-3, 4, 80)])
    highs = lows + rng.uniform(0.3, 8.0, (80, 3))
    away = (np.maximum(lows[:, :2], -highs[:, :2]).max(axis=1) > 1.0).nonzero()[0]
    boxes = [shapes.box(*np.column_stack([lows[i], highs[i]]).ravel()) for i in away]
    caster = Caster(shapes.join(boxes).astype(np.float32), np.repeat(np.arange(len(away)), 12).astype(np.int32))
    rays = sweep(SENSORS["hdl32e"], lambda t: at(np.eye(4)), 0.0, 0.3, distortion=False)
    ranges, objects, _ = caster.cast(rays.origins, rays.directions)
    each = np.stack(
        [box_ranges(rays.origins.astype(float), rays.directions.astype(float), lows[i], highs[i]) for i in away]
    )
    expected = each.min(axis=0)
    both = np.isfinite(expected) & np.isfinite(ranges)
    assert both.mean() > 0.1
    wrong = np.isfinite(expected) != np.isfinite(ranges)
    wrong[both] = np.abs(expected[both] - ranges[both]) > 0.01
    assert wrong.mean() < 0.001
    assert np.mean(objects[both] == each.argmin(axis=0)[both]) > 0.999


@pytest.mark.parametrize("name", ["vlp16", "hdl32e", "hdl64e"])
def test_a_sweep_fires_every_beam_at_every_azimuth_clockwise(name: str) -> None:
    sensor = SENSORS[name]
    rays = sweep(sensor, lambda t: at(np.eye(4)), 0.0, 0.5, distortion=False)
    assert len(rays.directions) == sensor.beams * sensor.azimuths
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1.0, atol=1e-6)
    elevations = np.degrees(np.arcsin(rays.directions[: sensor.beams, 2]))
    np.testing.assert_allclose(elevations, sensor.elevations_deg, atol=1e-4)
    azimuth = np.arctan2(rays.directions[:: sensor.beams, 1], rays.directions[:: sensor.beams, 0])
    assert np.all(np.diff(azimuth) < 0), "seen from above, the sensor turns clockwise"


def test_within_the_revolution_rays_leave_from_where_the_sensor_is() -> None:
    def moving(time_s: F64) -> F64:
        T = np.tile(np.eye(4), (len(time_s), 1, 1))
        T[:, 0, 3] = 11.0 * time_s
        return T

    sensor = SENSORS["hdl32e"]
    rays = sweep(sensor, moving, 2.0, 0.0, distortion=True)
    azimuth = np.arctan2(rays.directions_lidar[:, 1], rays.directions_lidar[:, 0])
    expected = 11.0 * (2.0 - azimuth / (2 * np.pi) / sensor.rate_hz)
    ahead = np.abs(azimuth) < 3.1  # -pi and pi are the same direction, fired at both ends
    np.testing.assert_allclose(rays.origins[ahead, 0], expected[ahead], atol=1e-4)


@pytest.mark.parametrize(("name", "rays_a_scan"), [("rosette70", 24_000), ("mems120", 75_000)])
def test_sensors_that_look_ahead_fire_in_their_field_of_view_and_time_and_on_no_rings(
    name: str, rays_a_scan: int
) -> None:
    sensor = NAMED[name]
    first, second = (sweep(sensor, lambda t: at(np.eye(4)), s, 0.3, distortion=False) for s in (0.0, 0.1))
    assert len(first.directions) == rays_a_scan
    np.testing.assert_allclose(np.linalg.norm(first.directions, axis=1), 1.0, atol=1e-6)
    assert in_view(sensor, first.directions).mean() > 0.99
    azimuth = np.degrees(np.arctan2(first.directions[:, 1], first.directions[:, 0]))
    elevation = np.degrees(np.arcsin(first.directions[:, 2]))
    wide_deg = 120.0 if name == "mems120" else 70.4
    assert np.ptp(azimuth) == pytest.approx(wide_deg, abs=0.5)
    assert np.ptp(elevation) == pytest.approx(sensor.fov_top_deg - sensor.fov_bottom_deg, abs=0.5)
    assert np.all(np.diff(first.time_s) >= 0)
    assert 0.0 <= first.time_s[0] < first.time_s[-1] <= 1.0 / sensor.rate_hz
    found = estimate_sensor([Scan(0, 20.0 * first.directions), Scan(1, 20.0 * second.directions)], sensor.rate_hz)
    assert not found.sensor.rings
    repeated = np.einsum("ij,ij->i", first.directions, second.directions) > np.cos(np.radians(0.1))
    assert (repeated.mean() < 0.05) == (name == "rosette70")


def test_a_body_that_moves_is_met_where_it_is_when_the_ray_leaves() -> None:
    boxes = [shapes.box(4.0 + k, 5.0 + k, -9, 9, -9, 9).astype(np.float32) for k in range(3)]
    slices = [Caster(box, np.full(len(box), 7, np.int32)) for box in boxes]
    ahead = np.tile(np.array([[1.0, 0.0, 0.0]], np.float32), (6, 1))
    rays = Sweep(np.zeros((6, 3), np.float32), ahead, ahead, np.arange(6.0), 1)
    caster = SlicedCaster(slices, np.array([0, 2, 4]))
    ranges, objects, _ = caster.cast(rays.origins, rays.directions)
    assert ranges.tolist() == [4.0, 4.0, 5.0, 5.0, 6.0, 6.0]
    assert (objects == 7).all()
    np.testing.assert_allclose(np.abs(caster.normals(rays, np.array([5, 0, 3]))), np.tile([1.0, 0.0, 0.0], (3, 1)))


def test_ranges_carry_two_centimetres_of_noise_and_some_returns_are_lost() -> None:
    sensor = SENSORS["hdl32e"]
    rng = np.random.default_rng(2)
    ranges = np.full(50_000, 20.0, dtype=np.float32)
    ones: F32 = np.ones_like(ranges)
    noisy, kept = measure(sensor, ranges, ones, rng)
    assert np.std(noisy - ranges) == pytest.approx(0.02, rel=0.05)
    assert 0.98 < kept.mean() < 1.0
    _, far = measure(sensor, np.full_like(ranges, 80.0), 0.05 * ones, rng)
    assert far.mean() < 0.95, "a grazed road far away often gives nothing back"
    _, beyond = measure(sensor, np.full_like(ranges, 101.0), ones, rng)
    _, close = measure(sensor, np.full_like(ranges, 0.5), ones, rng)
    assert not beyond.any()
    assert not close.any()


def test_a_ray_passes_each_wall_of_a_demolished_house_behind_which_it_goes_on() -> None:
    walls = shapes.join([shapes.box(5.0, 5.1, -9, 9, -9, 9), shapes.box(8.0, 8.1, -9, 9, -9, 9)]).astype(np.float32)
    gone = Caster(walls, np.zeros(len(walls), dtype=np.int32))
    ranges = np.array([4.0, 5.1 + TRUTH_RULE.beyond_m / 2, 6.0, 20.0], dtype=np.float32)
    directions = np.tile(np.array([[1.0, 0.0, 0.0]], np.float32), (4, 1))
    passed = passed_surfaces(gone, np.zeros((4, 3), np.float32), directions, ranges)
    np.testing.assert_allclose(np.sort(passed[:, 0]), [5.0, 5.0, 5.0, 5.1, 5.1, 8.0, 8.1], atol=1e-4)
