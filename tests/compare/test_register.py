"""Clouds are registered without a prior, and what is bent is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from made_courts import made_court
from mapvote.compare.register import parts_of, register_maps
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.point_map import PointMap, all_points, map_from_points
from mapvote.core.types import F64, MapvoteError
from mapvote.doctor.diagnosis import diagnose
from mapvote.formats import write_pcd
from mapvote.formats.maps.cloud import Cloud


@pytest.fixture(scope="module")
def court() -> F64:
    return made_court()


@pytest.mark.parametrize("yaw_deg", [101.0, -163.0])
def test_a_cloud_turned_by_any_yaw_and_moved_far_off_is_found(court: F64, yaw_deg: float) -> None:
    T = from_xyz_rpy(340.0, -1200.0, 55.0, roll=0.01, yaw=np.radians(yaw_deg))
    found = register_maps(map_from_points(court), map_from_points(transform(inverse(T), made_court(seed=2))))
    off = transform(found.T_a_b @ inverse(T), court) - court
    assert np.linalg.norm(off, axis=1).max() < 0.15
    assert np.median(np.linalg.norm(off, axis=1)) < 0.08
    assert not found.bent
    assert found.fit.sigma_m < 0.05


def drifted() -> tuple[PointMap, F64]:
    """A court with many posts, and a later cloud of it whose part north of y = 6 m is 0.8 m too far east."""
    places = np.random.default_rng(5).uniform((-30.0, -22.0, 0.8), (31.0, 23.0, 4.0), (150, 3))
    posts = tuple((x, y, x + 0.3, y + 0.3, height) for x, y, height in places.tolist())
    cloud = made_court(posts, seed=3)
    cloud[cloud[:, 1] > 6.0, 0] += 0.8
    return map_from_points(made_court(posts, seed=2)), cloud


@pytest.mark.slow
def test_the_drifted_part_of_a_session_is_named_with_how_far_it_is_off_and_can_be_moved_back(tmp_path: Path) -> None:
    straight, cloud = drifted()
    bent = map_from_points(cloud)
    found = register_maps(straight, bent)
    assert found.bent[0].name.startswith("north of y = ")
    assert found.bent[0].most_m == pytest.approx(0.8, abs=0.1)
    write_pcd(tmp_path / "session.pcd", Cloud(cloud))
    said = [one.what for one in diagnose(tmp_path / "session.pcd", point_map=straight).findings]
    assert any(one.startswith(f"bent: {found.bent[0].name} this session is off by") for one in said)
    moved = register_maps(straight, bent, unbend=True)
    assert moved.unbent
    before = all_points(bent)
    assert np.median(np.abs(moved.points - before + [0.8, 0.0, 0.0])[before[:, 1] > 6.0, 0]) < 0.25


@pytest.mark.slow
def test_a_difference_that_half_a_degree_at_the_path_explains_is_no_bend() -> None:
    straight, cloud = drifted()
    for from_path_m, is_bent in ((10.0, True), (150.0, False)):
        path = np.array([[0.0, -from_path_m, 2.0]])
        assert bool(register_maps(straight, replace(map_from_points(cloud), driven=(path,))).bent) == is_bent


def test_a_group_of_patches_that_a_line_divides_from_the_others_is_named_by_the_line() -> None:
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(-30.0, 31.0, 15.0), np.arange(-90.0, 31.0, 15.0)))
    centre = np.column_stack([x, y, np.zeros(len(x))])
    assert [name for name, _ in parts_of(centre, y < -50.0)] == ["south of y = -52 m"]
    apart = (y < -50.0) | ((np.abs(x) < 20.0) & (np.abs(y) < 1.0))
    assert [name for name, _ in parts_of(centre, apart)][1].startswith("in x -30 to 30, y -15 to 15")


def test_two_planes_of_ground_cannot_be_registered() -> None:
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-30, 30, (20_000, 2)), rng.normal(0, 0.01, 20_000)])
    with pytest.raises(MapvoteError, match="holds nothing but ground"):
        register_maps(map_from_points(ground), map_from_points(ground))
