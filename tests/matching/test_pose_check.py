"""Whether a pose can be trusted: what fits there, against what should fit there, and what fits elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.types import F64
from mapvote.matching.ndt_map import NDT_WINDOW, NdtMap, build_ndt
from mapvote.matching.ndt_voxels import Level
from mapvote.matching.pose_check import POSE_CHECK, Judge, Verdict, height_above_lowest, stands_above_ground

HERE = np.eye(4)
ALL_POINTS = replace(POSE_CHECK, points=10**6)
NOISE_M = 0.05
TWELVE_UP = np.array([0.0, 0.0, 12.0])


def one_level(points: F64, size: float, half_m: float = 24.0) -> NdtMap:
    """A map of voxels of one size, ``half_m`` along x and y to all sides of its middle."""
    level = Level(size, floor_m=0.1, points_m=0.1, iterations=10)
    ndt_map = NdtMap(np.zeros(3), (level,), replace(NDT_WINDOW, half_window_m=half_m))
    ndt_map.enter(points)
    return ndt_map


def clusters(seed: int, n: int, noise_m: float = 0.0) -> F64:
    """Points of nine slanted ellipsoids, each in the middle of a voxel of 3 m, three voxels apart, 4.5 m up."""
    shapes, rng = np.random.default_rng(5), np.random.default_rng(seed)
    out = []
    for x in (-9.0, 0.0, 9.0):
        for y in (-9.0, 0.0, 9.0):
            spread = np.diag([0.42, 0.35, 0.38]) @ np.linalg.cholesky(correlations(shapes))
            points = rng.normal(size=(n, 3)) @ spread.T
            inside = np.abs(points).max(axis=1) < 1.45
            out.append(points[inside] + rng.normal(0, noise_m, (inside.sum(), 3)) + [x + 1.5, y + 1.5, 4.5])
    return np.concatenate(out)


def correlations(rng: np.random.Generator) -> F64:
    """(3, 3) of three strongly correlated numbers."""
    a, b, c = rng.choice([-0.85, 0.85], 3) * rng.uniform(0.8, 1.0, 3)
    way = np.array([[1.0, a, b], [0.0, 0.5, c], [0.0, 0.0, 0.45]])
    covariance = way @ way.T
    scale = 1.0 / np.sqrt(np.diag(covariance))
    return np.asarray(covariance * scale[:, None] * scale[None, :])


def with_ground(points: F64) -> F64:
    """The same, over a road: of the road itself nothing is looked at."""
    x, y = np.meshgrid(np.arange(-13.5, 15.0, 1.5), np.arange(-13.5, 15.0, 1.5))
    return np.concatenate([points, np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])])


def far_map() -> NdtMap:
    return one_level(clusters(1, 3000), 3.0)


def test_a_scan_drawn_from_the_map_itself_fits_as_the_map_leads_to_expect() -> None:
    """E exp(-u' C u / 2) over u ~ N(0, S) is det(I + S C)^-1/2: here it is measured with 20,000 points."""
    scan = with_ground(clusters(2, 2500, NOISE_M))
    for T in (HERE, from_xyz_rpy(2.0, -1.0, 0.5, 0.0, 0.0, 0.7)):
        points = transform(inverse(T), scan)
        assert Judge(NOISE_M, ALL_POINTS).fit(far_map(), points, T) == pytest.approx(1.0, abs=0.02)


def test_more_noise_than_the_sensor_has_fits_worse_than_expected() -> None:
    noisy = with_ground(clusters(2, 2500, 0.4))
    assert Judge(NOISE_M, ALL_POINTS).fit(far_map(), noisy, HERE) < 0.8
    assert Judge(0.4, ALL_POINTS).fit(far_map(), noisy, HERE) == pytest.approx(1.0, abs=0.04)


def test_points_where_the_map_has_never_been_count_only_as_unknown() -> None:
    """Half of the scan stands 12 m above everything: the fit of the other half is what it was, unless more must be
    known. A scan that meets nothing of the map fits nowhere."""
    cloud, judge = clusters(2, 2500, NOISE_M), Judge(NOISE_M, ALL_POINTS)
    scan = with_ground(np.concatenate([cloud, cloud + TWELVE_UP]))
    verdict = judge.judge(far_map(), scan, HERE)
    assert verdict.known == pytest.approx(0.5)
    assert verdict.fit == pytest.approx(1.0, abs=0.02)
    for least, fits in ((0.49, True), (0.5, True), (0.51, False)):
        strict = Judge(NOISE_M, replace(ALL_POINTS, min_known=least))
        assert (strict.fit(far_map(), scan, HERE) > 0.9) == fits
    lost = judge.judge(far_map(), with_ground(cloud + TWELVE_UP), HERE)
    assert (lost.fit, lost.known) == (0.0, 0.0)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_known_is_the_share_of_points_in_or_beside_a_voxel_of_the_map(seed: int) -> None:
    """Looked up in a set of voxels, up to one voxel before the edge of the window."""
    rng = np.random.default_rng(seed)
    mapped = rng.uniform(-8.0, 8.0, (25, 3))
    ndt_map = one_level(mapped, 1.0, half_m=8.0)
    filled = {tuple(voxel) for voxel in np.floor(mapped).astype(int).tolist()}
    points = rng.uniform((-10.0, -10.0, 2.0), (10.0, 10.0, 9.0), (300, 3))
    ways = [(0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    known = 0
    for x, y, z in np.floor(points).astype(int).tolist():
        inside = -8 < x < 7 and -8 < y < 7
        known += inside and any((x + i, y + j, z + k) in filled for i, j, k in ways)
    x, y = np.meshgrid(np.arange(-12.0, 13.0), np.arange(-12.0, 13.0))
    scan = np.concatenate([points, np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -20.0)])])
    verdict = Judge(NOISE_M, ALL_POINTS).judge(ndt_map, scan, HERE)
    assert verdict.known == pytest.approx(known / len(points))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_heights_are_above_the_lowest_point_of_nine_cells_of_3_m(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform((-130.0, -130.0, -2.0), (130.0, 130.0, 6.0), (400, 3))
    points[:200, :2] = rng.uniform(-120.0, -100.0, (200, 2)) * rng.choice([-1.0, 1.0], (200, 2))
    cells = np.floor(points[:, :2] / 3.0).astype(int)
    inside = ((cells >= -40) & (cells < 40)).all(axis=1)
    expected = np.full(len(points), -np.inf)
    for i in np.flatnonzero(inside):
        near = inside & (np.abs(cells - cells[i]).max(axis=1) <= 1)
        expected[i] = points[i, 2] - points[near, 2].min()
    np.testing.assert_array_equal(height_above_lowest(points), expected)


def test_standing_voxels_are_found_plumb_however_the_sensor_is_tilted() -> None:
    road = np.column_stack([np.linspace(-20, 20, 81), np.zeros(81), np.zeros(81)])
    post = np.array([[5.0, 0.5, 0.59], [5.0, 0.5, 0.61], [5.0, 0.5, 3.0]])
    T = from_xyz_rpy(3.0, 1.0, 1.8, 0.0, 0.3, 0.0)
    lidar = transform(inverse(T), np.concatenate([road, post]))
    assert stands_above_ground(lidar, T).nonzero()[0].tolist() == [82, 83]


@pytest.mark.parametrize(
    ("fit", "known", "lead", "holds"),
    [(1.0, 1.0, 1.0, True), (0.6, 0.3, 0.05, True), (0.59, 1, 1, False), (1, 0.29, 1, False), (1, 1, 0.04, False)],
)
def test_a_verdict_speaks_for_a_pose_if_fit_knowledge_and_lead_are_all_good_enough(
    fit: float, known: float, lead: float, holds: bool
) -> None:
    assert Judge(NOISE_M).holds(Verdict(fit, known, lead, None)) == holds


def box(x: float, y: float, side: float = 1.5, height: float = 4.0) -> F64:
    """The four walls of a box, points every 0.2 m."""
    along = np.arange(0.0, side, 0.2)
    z = np.arange(0.2, height, 0.2)
    walls = [np.column_stack([np.repeat(along, len(z)), np.full(len(along) * len(z), end)]) for end in (0.0, side)]
    sides = [*walls, *(wall[:, ::-1] for wall in walls)]
    points = np.concatenate([np.column_stack([side, np.tile(z, len(along))]) for side in sides])
    return np.asarray(points + np.array([x, y, 0.0]))


def place() -> F64:
    """A square with houses of all sizes around it: no part of it is like another."""
    rng = np.random.default_rng(4)
    spots = [(12, 3), (8, -14), (-3, 11), (-14, -5), (-9, 16), (17, 15), (2, -19), (20, -8), (-20, 6)]
    houses = [box(x, y, rng.uniform(1.0, 5.0), rng.uniform(2.0, 7.0)) for x, y in spots]
    return np.concatenate([*houses, road(rng, 30.0, 30.0)])


def road(rng: np.random.Generator, half_x_m: float, half_y_m: float) -> F64:
    """Eight points per square metre."""
    n = int(32 * half_x_m * half_y_m)
    return np.column_stack([rng.uniform(-1, 1, (n, 2)) * [half_x_m, half_y_m], rng.normal(0, 0.02, n)])


@pytest.fixture(scope="module")
def square() -> NdtMap:
    return build_ndt(place(), np.zeros(3))


def seen_from(T: F64, seed: int = 3) -> F64:
    rng = np.random.default_rng(seed)
    points = place()[rng.random(len(place())) < 0.4]
    return transform(inverse(T), points + rng.normal(0, 0.02, points.shape))


JUDGE = Judge(0.02, replace(POSE_CHECK, points=3000))
TRUTH = from_xyz_rpy(0.5, -0.4, 1.8, 0.0, 0.0, 0.3)


@pytest.mark.parametrize("quick", [False, True])
def test_the_right_place_leads_clearly(square: NdtMap, quick: bool) -> None:
    found = JUDGE.judge(square, seen_from(TRUTH), TRUTH, quick)
    assert JUDGE.holds(found)
    assert found.fit == pytest.approx(JUDGE.fit(square, seen_from(TRUTH), TRUTH))
    assert 0.75 < found.fit < 1.3
    assert found.known > 0.95
    assert found.lead > 0.3
    few = Judge(0.02, replace(POSE_CHECK, points=400)).judge(square, seen_from(TRUTH), TRUTH, quick)
    assert few.fit == pytest.approx(found.fit, abs=0.1)
    assert few.lead > 0.2, "by a handful of points, too"


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize(
    "wrong",
    [(6.0, 0.0, 0.0), (-9.0, 0.0, 0.0), (0.0, 7.0, 0.0), (0.0, -5.0, 0.0), (0.0, 0.0, np.pi), (-4.0, 0.0, np.pi)],
)
def test_from_a_wrong_place_the_right_one_is_seen_along_and_across_the_street_and_turned_about(
    square: NdtMap, wrong: tuple[float, float, float], quick: bool
) -> None:
    told = TRUTH @ from_xyz_rpy(wrong[0], wrong[1], 0.0, 0.0, 0.0, wrong[2])
    found = JUDGE.judge(square, seen_from(TRUTH), told, quick)
    assert found.lead < -0.3
    assert not JUDGE.holds(found)
    assert found.T_map_lidar_other is not None
    away = inverse(TRUTH) @ found.T_map_lidar_other
    assert np.abs(away - np.eye(4)).max() < 0.05


@pytest.mark.parametrize("quick", [False, True])
def test_a_pose_that_has_not_settled_yields_to_the_one_beside_it_and_a_settled_one_does_not(
    square: NdtMap, quick: bool
) -> None:
    """Two fixes nearer than 1.5 m are one place: only a better one, and more than 0.2 m off, is another."""
    off = JUDGE.judge(square, seen_from(TRUTH), TRUTH @ from_xyz_rpy(0.8, 0.0, 0.0), quick)
    assert off.lead < 0.0
    assert off.T_map_lidar_other is not None
    assert np.linalg.norm((off.T_map_lidar_other - TRUTH)[:3, 3]) < 0.05
    near = JUDGE.judge(square, seen_from(TRUTH), TRUTH @ from_xyz_rpy(0.1, 0.0, 0.0), quick)
    assert near.lead > 0.0


@pytest.mark.parametrize("quick", [False, True])
def test_no_place_leads_on_a_street_that_repeats_itself(quick: bool) -> None:
    boxes = np.concatenate([box(x, y) for x in np.arange(-45.0, 45.0, 6.0) for y in (-8.0, 8.0)])
    street = np.concatenate([boxes, road(np.random.default_rng(1), 45.0, 10.0)])
    ndt_map = build_ndt(street, np.zeros(3))
    near = street[np.abs(street[:, 0]) < 20.0]
    found = JUDGE.judge(ndt_map, transform(inverse(from_xyz_rpy(0, 0, 1.8)), near), from_xyz_rpy(0, 0, 1.8), quick)
    assert found.fit > 0.75
    assert abs(found.lead) < 0.05
    assert not JUDGE.holds(found)
    assert found.T_map_lidar_other is not None
    houses_on = found.T_map_lidar_other[0, 3] / 6.0
    assert houses_on == pytest.approx(round(houses_on), abs=0.05)
    assert round(houses_on) != 0
