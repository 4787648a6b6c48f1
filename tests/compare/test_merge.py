"""Maps of one place become one map, or are refused with figures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from made_courts import made_court
from mapvote.compare.merge import merge_maps
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.point_map import SCANS, SOURCES, PointMap, all_points, map_from_points
from mapvote.core.types import F64, MapvoteError


def part(cloud: F64, low: float, high: float) -> F64:
    return cloud[(cloud[:, 0] > low) & (cloud[:, 0] < high)]


@pytest.mark.slow
def test_two_halves_in_frames_of_their_own_become_the_whole_with_one_point_a_voxel() -> None:
    T = from_xyz_rpy(30.0, -4.0, 2.0, yaw=1.2)
    west, east = part(made_court(), -40.0, 27.0), part(made_court(seed=2), -28.0, 40.0)
    merged = merge_maps([map_from_points(west), map_from_points(transform(inverse(T), east))])
    points = all_points(merged.point_map)
    assert np.abs(merged.T_first_each[1][:3, 3] - T[:3, 3]).max() < 0.25  # of an origin 30 m off
    assert np.ptp(points[:, 0]) > 65.0
    away = KDTree(made_court()).query(points)[0]
    assert np.median(away) < 0.12
    tiles = merged.point_map.tiles
    sources = np.concatenate([tiles[index].fields[SOURCES] for index in tiles])
    assert set(sources.tolist()) == {1, 2, 3}
    x = np.concatenate([tiles[index].points_map[:, 0] for index in tiles])
    assert (sources[x < -29.0] == 1).all()
    assert (sources[x > 28.0] == 2).all()
    voxels = np.unique(np.floor(points / 0.3).astype(int), axis=0)
    assert len(voxels) == len(points)


@pytest.mark.slow
def test_times_of_points_tell_no_frame() -> None:
    """Maps that state one frame share what separates them, whatever else one of them says."""
    first = map_from_points(made_court(), georeference={"crs": "EPSG:32633"})
    second = map_from_points(made_court(seed=2) + np.array([0.2, 0.0, 0.0]), georeference={"crs": "EPSG:32633"})
    timed = replace(second, georeference={**second.georeference, "gps_times": "adjusted standard"})
    elsewhere = replace(second, georeference={"crs": "EPSG:32632"})
    T, T_timed, T_elsewhere = (merge_maps([first, other]).T_first_each for other in (second, timed, elsewhere))
    assert np.array_equal(T_timed, T)
    assert not np.array_equal(T_elsewhere, T)


@pytest.mark.slow
def test_free_space_of_every_map_comes_along_and_a_point_of_any_map_wins_over_it() -> None:
    def knowing(point_map: PointMap) -> PointMap:
        every = {i: replace(t, free=~t.obstacle_words & np.uint64(0xFF0)) for i, t in point_map.tiles.items()}
        return replace(point_map, tiles=every)

    merged = merge_maps([knowing(map_from_points(made_court())), knowing(map_from_points(made_court((), seed=2)))])
    tiles = [tile for tile in merged.point_map.tiles.values() if tile.free is not None]
    assert tiles
    for tile in tiles:
        assert tile.free is not None
        assert not (tile.free & tile.obstacle_words).any()


@pytest.mark.slow
def test_noise_that_one_survey_hit_once_goes_when_the_other_passed_as_near_and_what_is_not_counted_stays() -> None:
    path = np.column_stack([np.arange(-25.0, 30.0, 0.5), np.full(110, -2.0), np.full(110, 2.0)])
    noise = np.array([[0.1, -6.0, 1.6], [5.2, -7.0, 1.9]])

    def counted(cloud: F64, times: int) -> PointMap:
        point_map = map_from_points(cloud)
        tiles = {}
        for index, tile in point_map.tiles.items():
            scans = np.full(len(tile.points), 9, dtype=np.uint8)
            scans[np.isin(tile.points_map[:, 2].astype(np.float32), noise[:, 2].astype(np.float32))] = times
            tiles[index] = replace(tile, fields={SCANS: scans})
        return replace(point_map, tiles=tiles, driven=(path,))

    def left(times: int) -> int:
        survey = counted(np.concatenate([made_court(()), noise]), times)
        merged = merge_maps([survey, counted(made_court((), seed=2), times)]).point_map
        return int((KDTree(all_points(merged)).query(noise)[0] < 0.15).sum())

    assert left(times=1) == 0
    assert left(times=0) == 2  # of an import: nobody counted


@pytest.mark.slow
def test_maps_that_contradict_each_other_are_refused_with_how_far_and_where() -> None:
    broken = made_court(seed=2)
    broken[broken[:, 1] > 4.0, 0] += 0.8
    with pytest.raises(MapvoteError, match=r"contradict each other: .* off by up to 0\.\d m"):
        merge_maps([map_from_points(made_court()), map_from_points(broken)])


def test_a_map_of_another_place_is_named() -> None:
    rng = np.random.default_rng(0)
    elsewhere = np.column_stack([rng.uniform(-30, 30, (9000, 2)), rng.normal(0, 0.01, 9000)])
    with pytest.raises(MapvoteError, match="map 2 cannot be registered to any of the others"):
        merge_maps([map_from_points(made_court()), map_from_points(elsewhere)])
