"""Differences between two clouds: by geometry alone where neither knows free space."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from made_courts import CARS, court_clouds, made_court
from mapvote.compare.cloud_changes import (
    CloudChange,
    compare_cells,
    difference_geojson,
    difference_page,
    differences,
)
from mapvote.compare.register import brought_into
from mapvote.core.geometry import from_xyz_rpy, transform
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.formats import read_map

NEW = (-2.0, -8.0, 2.0, -6.2, 1.5)


def compare(map_a: PointMap, map_b: PointMap) -> list[CloudChange]:
    moved, registered = brought_into(map_a, map_b)
    return differences(compare_cells(map_a, moved, registered))


def at(found: list[CloudChange], x: float, y: float) -> list[str]:
    return [d.kind for d in found if d.box[0] - 0.5 < x < d.box[2] + 0.5 and d.box[1] - 0.5 < y < d.box[3] + 0.5]


@pytest.mark.slow
def test_a_car_that_left_and_one_that_came_are_found_and_nothing_else_is() -> None:
    before = map_from_points(made_court())
    after = transform(from_xyz_rpy(12.0, 3.0, 1.0, yaw=2.0), made_court((*CARS[1:], NEW), seed=2))
    found = compare(before, map_from_points(after))
    assert at(found, -17.8, -16.1) == ["gone"]
    assert at(found, 0.0, -7.1) == ["new"]
    assert len([d for d in found if d.kind != "not seen"]) == 2
    gone = next(d for d in found if d.kind == "gone")
    assert 1.3 < gone.height_m < 1.7
    assert gone.confidence > 0.5


def test_two_surveys_of_one_world_differ_in_nothing() -> None:
    assert differences(compare_cells(map_from_points(made_court()), map_from_points(made_court(seed=2)))) == []


def test_a_car_where_the_other_survey_has_no_ground_is_not_seen_by_it_rather_than_gone() -> None:
    cloud = made_court(CARS[1:], seed=2)
    hidden = (np.abs(cloud[:, 0] + 17.8) < 4.0) & (np.abs(cloud[:, 1] + 16.1) < 3.0)
    found = differences(compare_cells(map_from_points(made_court()), map_from_points(cloud[~hidden])))
    assert set(at(found, -17.8, -16.1)) == {"not seen"}


def knowing_free(point_map: PointMap, word: int) -> PointMap:
    free = np.uint64(word)
    return replace(
        point_map, tiles={i: replace(t, free=free & ~t.obstacle_words) for i, t in point_map.tiles.items()}
    )  # fmt: skip


@pytest.mark.parametrize(("free", "kinds"), [(0x1FF, {"gone"}), (1 << 40, {"not seen"})])
def test_free_space_that_a_map_knows_decides_and_its_ground_does_not(free: int, kinds: set[str]) -> None:
    before, after = map_from_points(made_court()), map_from_points(made_court(CARS[1:], seed=2))
    assert set(at(differences(compare_cells(before, knowing_free(after, free))), -17.8, -16.1)) == kinds


def test_an_object_below_which_the_maps_own_rays_passed_is_no_change() -> None:
    rng = np.random.default_rng(5)
    low, high = (-18.0, -16.0, 2.2), (-15.0, -14.5, 2.6)
    hanging = rng.uniform(low, high, (600, 3)) - [0.0, 0.0, 0.25]
    awning = map_from_points(np.concatenate([made_court(()), hanging]))
    without = map_from_points(made_court((), seed=2))
    assert at(differences(compare_cells(awning, without)), -16.5, -15.2) == ["gone"]
    assert at(differences(compare_cells(knowing_free(awning, 0x1FF), without)), -16.5, -15.2) == []


def test_the_page_holds_the_largest_and_the_footprints_are_closed_rings_in_metres() -> None:
    before, after = map_from_points(made_court()), map_from_points(made_court(CARS[1:], seed=2))
    found = differences(compare_cells(before, after))
    assert "gone at -18, -16" in difference_page("court", found, before, after)
    feature = difference_geojson(found, before.lattice, {}, [])["features"][0]
    ring = np.array(feature["geometry"]["coordinates"][0][0])
    assert (ring[0] == ring[-1]).all()
    assert np.abs(ring.mean(axis=0) - [-17.8, -16.1]).max() < 1.0


def agreed_changes(folder: Path, session: str) -> tuple[list[CloudChange], list[str]]:
    found = compare(read_map(folder / "gtmap.pcd"), read_map(folder / f"{session}.pcd"))
    boxes = {"car": (-3.65, -0.4, "gone"), "structure": (21.7, -28.0, "new"), "thing": (-5.3, 11.9, "new")}
    return found, [name for name, (x, y, kind) in boxes.items() if kind in at(found, x, y)]


@pytest.mark.slow
def test_each_session_alone_shows_the_three_changes_of_the_court_and_no_drift_as_change() -> None:
    folder = court_clouds()
    for session in ("robot1", "robot2", "robot3"):
        found, boxes = agreed_changes(folder, session)
        assert boxes == ["car", "structure", "thing"], session
    assert [d for d in found if d.kind != "not seen" and d.box[3] < -45.0] == []  # robot3's, the last
