"""A scan is de-skewed and thinned; in the rain it is judged by what stands, not by the drops."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapvote.core.geometry import exp, inverse, transform
from mapvote.core.types import Bool, Scan
from mapvote.matching.ndt_map import build_ndt
from mapvote.matching.ndt_voxels import LEVELS
from mapvote.matching.pose_check import Judge
from mapvote.matching.prepare import deskew, solid_sample, thin_for_levels, twist_between

BEAMS, AZIMUTHS = 32, 1800
HERE = np.eye(4)


def room(seed: int, rain: float) -> tuple[NDArray[np.float32], Bool]:
    """(what a sensor 1.9 m above a road sees between walls and poles, which of it are drops); 2 cm of noise."""
    rng = np.random.default_rng(seed)
    elevation = np.repeat(np.radians(np.linspace(-24.0, 8.0, BEAMS)), AZIMUTHS)
    azimuth = np.tile(np.arange(AZIMUTHS) * 2.0 * np.pi / AZIMUTHS, BEAMS)
    ways = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    reach = np.full(len(ways), 60.0)
    for axis, at in ((0, 12.0), (0, -17.0), (1, 9.0), (1, -6.5), (2, -1.9)):
        hit = at / np.where(ways[:, axis] * at > 0.0, ways[:, axis], np.nan)
        reach = np.fmin(reach, hit)
    for x, y in ((5.0, 3.0), (-8.0, -4.0)):
        beside = np.abs(ways[:, 0] * y - ways[:, 1] * x) / np.hypot(ways[:, 0], ways[:, 1]) < 0.1
        before = beside & (ways[:, 0] * x + ways[:, 1] * y > 0.0)
        reach[before] = np.fmin(reach[before], np.hypot(x, y) / np.cos(elevation[before]))
    drop = 1.0 + rng.exponential(5.0, len(ways))
    drops = (rng.random(len(ways)) < rain) & (drop < reach)
    reach = np.where(drops, drop, reach + rng.normal(0.0, 0.02, len(ways)))
    seen = reach < 50.0
    return (ways * reach[:, None])[seen].astype(np.float32), drops[seen]


def kept(points: NDArray[np.float32], sample: NDArray[np.float64], of: Bool) -> float:
    """Share of ``of`` the points, a point a voxel, that is in the sample."""
    whole = {tuple(p) for p in points[of].tolist()}
    return len(whole & {tuple(p) for p in sample.astype(np.float32).tolist()}) / max(len(whole), 1)


@pytest.mark.parametrize("rain", [0.05, 0.1, 0.2])
def test_drops_leave_a_scan_and_what_stands_stays(rain: float) -> None:
    points, drops = room(1, rain)
    sample = solid_sample(points, 0.05)
    assert kept(points, sample, drops) < 0.1  # but for drops right before a surface
    dry, none = room(1, 0.0)
    _, first = np.unique(np.floor(dry / 0.05), axis=0, return_index=True)
    everything = {tuple(p) for p in dry[first].tolist()}
    left = {tuple(p) for p in solid_sample(dry, 0.05).astype(np.float32).tolist()}
    assert len(left) > 0.97 * len(everything)
    assert not none.any()


def test_a_right_pose_fits_in_the_rain_as_it_does_in_the_dry() -> None:
    street = build_ndt(room(2, 0.0)[0].astype(np.float64))
    judge = Judge(0.02)
    dry, wet = (judge.fit(street, solid_sample(room(seed, rain)[0], 0.2), HERE) for seed, rain in ((3, 0.0), (4, 0.1)))
    assert dry == pytest.approx(1.0, abs=0.1)
    assert wet > dry - 0.08


def test_a_scan_without_any_point_has_an_empty_sample() -> None:
    assert solid_sample(np.empty((0, 3), np.float32), 0.2).shape == (0, 3)


def test_each_level_gets_one_point_a_voxel_and_no_beam_is_left_out() -> None:
    beams = np.repeat(np.arange(32.0), 3000).reshape(32, 3000).T.ravel()  # firing by firing
    turn = np.repeat(np.linspace(0.0, 2 * np.pi, 3000), 32)
    points = np.stack([20 * np.cos(turn), 20 * np.sin(turn), beams], axis=1)
    for few, level in zip(thin_for_levels(points), LEVELS, strict=True):
        assert len(np.unique(few[2])) == 32
        voxels = np.floor(few / np.float32(level.points_m))
        assert len(np.unique(voxels, axis=1).T) == few.shape[1]


@settings(max_examples=25, deadline=None)
@given(st.floats(-15, 15), st.floats(-3, 3), st.floats(-0.6, 0.6), st.integers(0, 2**31))
def test_deskew_undoes_the_motion_of_a_scan(speed: float, sideways: float, yaw_rate: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    still = rng.uniform(-50, 50, (200, 3))
    time_s = rng.uniform(-0.05, 0.05, 200).astype(np.float32)
    twist = np.array([speed, sideways, 0.1, 0.02, -0.03, yaw_rate])
    moments = zip(time_s.astype(np.float64), still, strict=True)
    seen = np.array([transform(inverse(exp(t * twist)), point[None])[0] for t, point in moments])
    points = deskew(Scan(0, seen.astype(np.float32), time_s), twist)
    np.testing.assert_allclose(points, still, atol=2e-3)
    np.testing.assert_allclose(twist_between(np.eye(4), exp(0.1 * twist), 0.1), twist, atol=1e-9)
