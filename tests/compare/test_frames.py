"""A comparison gives the same answer wherever a country's coordinates begin."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest

from command_line import typed
from made_courts import CARS, made_court
from mapvote.codec.ballot import decode
from mapvote.compare.merge import merge_maps
from mapvote.compare.register import Registered, register_maps
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.point_map import all_points, map_from_points
from mapvote.core.types import F64, MapvoteError
from mapvote.core.voxels import voxel_keys
from mapvote.doctor.map_fit import check_cloud_on_map
from mapvote.formats import read_map

SYSTEMS = {
    "local": (0.0, 0.0, 0.0),
    "UTM zone 33 north": (389_000.0, 5_820_000.0, 34.0),
    "Gauss-Krueger zone 4": (4_468_000.0, 5_333_000.0, 520.0),
    "Swiss LV95": (2_600_000.0, 1_200_000.0, 450.0),
    "south of the equator": (-7_045_000.0, -3_120_000.0, -28.0),
}


def error_m(registered: Registered, T_b_a: F64, cloud: F64) -> float:
    """Largest distance of the points of a from where they come back to, when b is a moved by T_b_a."""
    return float(np.linalg.norm(transform(registered.T_a_b @ T_b_a, cloud) - cloud, axis=1).max())


@pytest.mark.slow
@pytest.mark.parametrize("system", SYSTEMS)
def test_a_cloud_against_itself_is_not_shifted_in_any_coordinate_system_as_it_is_moved_or_turned(system: str) -> None:
    corner = np.array(SYSTEMS[system])
    cloud = made_court(spacing_m=0.3) + corner
    to, back = from_xyz_rpy(*corner), from_xyz_rpy(*-corner)
    motions = {
        "as it is": np.eye(4),
        "moved": from_xyz_rpy(130.0, -75.0, 4.0),
        "turned": to @ from_xyz_rpy(0.0, 0.0, 0.0, yaw=2.1) @ back,
        "moved and turned": to @ from_xyz_rpy(40.0, -25.0, 3.0, roll=0.01, yaw=0.7) @ back,
        "brought to local metres": back,
    }
    point_map = map_from_points(cloud)
    errors_m = {
        name: error_m(register_maps(point_map, map_from_points(transform(T, cloud))), T, cloud)
        for name, T in motions.items()
    }
    assert max(errors_m.values()) < 0.02, errors_m


def test_the_shift_is_told_in_the_middle_of_the_overlap_and_not_at_a_far_origin() -> None:
    cloud = made_court(spacing_m=0.3) + np.array(SYSTEMS["UTM zone 33 north"])
    point_map = map_from_points(cloud)
    said = register_maps(point_map, map_from_points(cloud)).told()[0]
    assert "B is moved by x 0.000, y 0.000, z 0.000 m, turned by 0.000 deg" in said
    assert "A's x 38" in said


@pytest.mark.slow
def test_maps_far_from_the_origin_are_adjusted_about_their_middles() -> None:
    corner = np.array(SYSTEMS["UTM zone 33 north"])
    T = from_xyz_rpy(*corner) @ from_xyz_rpy(20.0, -4.0, 2.0, yaw=1.2) @ from_xyz_rpy(*-corner)
    first, second = made_court(spacing_m=0.3) + corner, made_court(spacing_m=0.25, seed=2) + corner
    merged = merge_maps([map_from_points(first), map_from_points(transform(inverse(T), second))])
    off = transform(merged.T_first_each[1] @ inverse(T), second) - second
    assert np.abs(off).max() < 0.05
    points = all_points(merged.point_map)
    assert np.abs(points - points.mean(axis=0)).max() < 60.0


def test_a_point_beyond_all_voxels_is_refused_because_two_voxels_would_share_a_key() -> None:
    near = np.array([[0.0, 0.0, 0.0], [314_000.0, -314_000.0, 0.0]])
    assert len(set(voxel_keys(near, 0.0, 0.0).tolist())) == 2
    for far in ([315_000.0, 0.0, 0.0], [0.0, -5_820_000.0, 0.0], [np.nan, 0.0, 0.0]):
        with pytest.raises(MapvoteError, match="from the corner of the map's lattice"):
            voxel_keys(np.array([[1.0, 1.0, 1.0], far]), 0.0, 0.0)


def write_las(path: Path, points: F64) -> Path:
    header = laspy.LasHeader(point_format=0, version="1.4")
    header.offsets, header.scales = np.floor(points.min(axis=0)), [0.001] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(path)
    return path


@pytest.mark.slow
def test_every_verb_of_the_comparison_works_on_a_tile_of_a_state_survey(tmp_path: Path) -> None:
    corner = np.array(SYSTEMS["UTM zone 33 north"])
    old = write_las(tmp_path / "old.las", made_court() + corner)
    new = write_las(tmp_path / "new.las", made_court(CARS[1:], seed=2) + corner)
    said = typed("diff", old, new, "--out", tmp_path / "d.geojson", "--html", tmp_path / "d.html")
    assert "gone: 1 things" in said
    assert "new: 0 things" in said
    said = typed("vote", new, "--map", old, "--out", tmp_path / "new.ballot")
    assert "gone: 1 things" in said
    assert decode((tmp_path / "new.ballot").read_bytes()).tiles
    said = typed("merge", old, new, "--out", tmp_path / "merged")
    assert float(said.split(": ")[1].split(" m apart")[0]) < 0.05
    (told,) = check_cloud_on_map(read_map(old), read_map(new))
    assert told.severity == "note"
    assert "in the middle of the overlap" in told.what
