"""False returns of a real LiDAR, against the physics that they model."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.core.sensors import SENSORS
from mapvote.core.types import F32, F64
from mapvote_lab.simulation import shapes
from mapvote_lab.simulation.drives import _stage
from mapvote_lab.simulation.flaws import FLAW_SIZES, Hits, Kinds, chance_of, mixed, spoil
from mapvote_lab.simulation.lidar import Caster, Sweep, measure, sweep
from mapvote_lab.simulation.scenario import Flaws, load_scenario

SENSOR = SENSORS["hdl32e"]
NONE = Flaws(reflection_share=0, mixed_share=0, wet_share=0, glass_share=0, dark_share=0)
WALL_X = 20.0


def yard() -> tuple[Caster, Sweep, Hits]:
    """A flat road (body 0) that ends at a wall (body 1), 20 m ahead of a sensor 1.9 m above the road."""
    road = np.array([[[-90, -90, 0], [90, -90, 0], [90, 90, 0]], [[-90, -90, 0], [90, 90, 0], [-90, 90, 0]]], "f4")
    wall = shapes.box(WALL_X, WALL_X + 1.0, -90.0, 90.0, -1.0, 12.0)
    owners = np.array([0, 0, *[1] * len(wall)], dtype=np.int32)
    caster = Caster(np.concatenate([road, wall]).astype(np.float32), owners)
    T = np.eye(4)[None].copy()
    T[0, 2, 3] = 1.9
    rays = sweep(SENSOR, lambda t: T, 0.0, 0.0, distortion=False)
    ranges, objects, cosine = caster.cast(rays.origins, rays.directions)
    return caster, rays, Hits(ranges, objects, cosine, np.zeros(len(ranges), dtype=np.bool_))


def spoiled(flaws: Flaws, glazed: bool = False, tails: F64 | None = None, seed: int = 0) -> tuple[F32, F64, F64, Hits]:
    """(ranges reported, points (n, 3) of the false ones, points of the lost ones, the truth) of the yard."""
    caster, rays, hits = yard()
    kinds = Kinds(np.array([False, glazed]), np.array([False, False]), seed=3)
    nothing = Caster(np.zeros((0, 3, 3), "f4"), np.zeros(0, np.int32))
    tails = np.zeros((0, 3)) if tails is None else tails
    ranges, false, lost = spoil(
        rays, hits, kinds, (caster, nothing), tails, SENSOR, flaws, np.random.default_rng(seed)
    )  # fmt: skip
    points = rays.origins + np.where(np.isfinite(ranges), ranges, 0.0)[:, None] * rays.directions
    return ranges, points[false].astype(np.float64), points[lost].astype(np.float64), hits


def test_without_flaws_the_sensor_reports_the_truth() -> None:
    ranges, false, lost, hits = spoiled(NONE)
    np.testing.assert_array_equal(ranges, hits.ranges)
    assert len(false) == len(lost) == 0


@pytest.mark.parametrize(("sigma_m", "noise"), [(None, SENSOR.range_sigma_m), (0.0, 0.0), (0.05, 0.05)])
def test_ranges_are_as_noisy_as_the_scenario_says_or_else_the_model(sigma_m: float | None, noise: float) -> None:
    sensor = _stage(load_scenario("corner", {"flaws": {"range_sigma_m": sigma_m}}), 1).sensor
    assert sensor.range_sigma_m == noise
    ranges = np.full(20_000, 20.0, dtype=np.float32)
    noisy, _ = measure(sensor, ranges, np.ones_like(ranges), np.random.default_rng(1))
    assert np.std(noisy - ranges) == pytest.approx(noise, rel=0.05)


def test_a_wet_road_mirrors_the_wall_below_itself() -> None:
    """The image of a wall in a horizontal mirror stands on its head at the same place."""
    flaws = NONE.model_copy(update={"reflection_share": 0.002, "wet_share": 1.0})
    _, images, _, hits = spoiled(flaws)
    asked = 0.002 * np.count_nonzero(np.isfinite(hits.ranges))
    assert 0.9 * asked < len(images) <= asked + 1
    np.testing.assert_allclose(images[:, 0], WALL_X, atol=0.05)
    assert (images[:, 2] < 0.0).all()
    assert images[:, 2].min() > -12.1


def test_glass_shows_the_road_before_it_behind_it() -> None:
    """The image in an upright mirror lies as far behind it as the thing before it, at the same height."""
    flaws = NONE.model_copy(update={"reflection_share": 0.002, "glass_share": 1.0})
    _, images, lost, _ = spoiled(flaws, glazed=True)
    assert len(images) > 20
    assert (images[:, 0] > WALL_X).all()
    np.testing.assert_allclose(images[:, 2], 0.0, atol=0.05)
    np.testing.assert_allclose(lost[:, 0], WALL_X, atol=0.01)
    assert len(lost) > 1000, "glass returns almost nothing"


def test_a_wet_road_returns_nothing_under_a_flat_angle_and_all_below_the_sensor() -> None:
    _, _, lost, hits = spoiled(NONE.model_copy(update={"wet_share": 1.0}))
    flat = hits.cosine < 0.25
    assert 0.85 < len(lost) / np.count_nonzero((hits.objects == 0) & flat) < 0.95
    assert (np.hypot(lost[:, 0], lost[:, 1]) > 1.9 * np.tan(np.arccos(0.25)) - 0.1).all()


def test_at_an_edge_a_beam_reports_a_range_between_the_two_within_a_pulse_only() -> None:
    ranges = np.repeat(np.array([10.0, 10.8, 30.0], "f4"), 2)  # two beams: 0.8 m apart, then 19 m
    changed = ranges.copy()
    edge = mixed(changed, 2, 1.0, np.random.default_rng(1))
    assert edge.tolist() == [True, True, False, False, False, False]
    assert ((changed[:2] > 10.0) & (changed[:2] < 10.8)).all()
    np.testing.assert_array_equal(changed[2:], ranges[2:])
    assert FLAW_SIZES.pulse_m < 19.0


def test_rain_ends_its_share_of_the_rays_near_the_sensor_and_never_lengthens_one() -> None:
    ranges, drops, _, hits = spoiled(NONE.model_copy(update={"rain": 0.1}))
    assert 0.05 < len(drops) / len(ranges) < 0.1, "some drops lie behind what the ray meets first"
    assert (ranges <= hits.ranges).all()
    assert np.median(np.linalg.norm(drops - [0, 0, 1.9], axis=1)) < 6.0


def test_exhaust_is_seen_where_it_hangs() -> None:
    plume = np.array([[8.0, 1.0, 0.5]])
    _, seen, _, _ = spoiled(NONE.model_copy(update={"exhaust": 1.0}), tails=plume)
    assert len(seen) > 20
    assert (np.linalg.norm(seen - plume, axis=1) < 0.75).all()


def test_wet_places_are_the_same_in_every_scan_and_others_with_another_seed() -> None:
    cells = np.array([[x, y] for x in range(100) for y in range(100)], dtype=np.float64)
    first, again, other = chance_of(cells, 1), chance_of(cells, 1), chance_of(cells, 2)
    np.testing.assert_array_equal(first, again)
    assert abs(np.corrcoef(first, other)[0, 1]) < 0.05
    np.testing.assert_allclose(np.histogram(first, 10, (0, 1))[0] / len(first), 0.1, atol=0.02)
