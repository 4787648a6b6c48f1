"""The doctor looks at a map by itself: units, axes, layers that occur twice, holes, rounding."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from faults import UP, kinds_of, moved, serious, sound_street, verdict
from hand_made import save_pcd
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.types import F64
from mapvote.doctor.diagnosis import diagnose
from mapvote.doctor.map_points import check_cloud, in_memory
from mapvote.doctor.maps import check_map, examine_points
from mapvote.formats import write_map
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.las import write_las

Change = Callable[[F64], F64]


@pytest.fixture(scope="module")
def points() -> F64:
    return sound_street((0, 100), (-25, 25), 50, (8, 22), longest=10, slope=0.01)


@pytest.fixture(scope="module")
def sound(points: F64) -> PointMap:
    return map_from_points(points)


def test_a_sound_map_is_not_blamed(points: F64, sound: PointMap) -> None:
    assert serious([*check_cloud(in_memory(points)), *check_map(sound)]) == []


BY_ITSELF = [
    "in centimetres", "in millimetres", "in kilometres", "upside down, turned over", "upside down, z negated", "y up",
    "rounded to 0.5 m", "one point in a hundred", "with strays", "5 % outliers 200 m up", "flat", "joined with itself",
    "twice, 0.5 m apart", "twice, 0.6 m apart", "twice, 2.2 m apart", "points that scatter by 0.25 m",
    "pitched by 3 deg", "twice, 0.6 m apart + pitched by 3 deg",
]  # fmt: skip


@pytest.mark.parametrize("kind", BY_ITSELF)
def test_faults_of_a_map_are_named_without_a_drive_one_and_two(points: F64, kind: str) -> None:
    rights, change = kinds_of("maps")[kind]
    found = examine_points("map", Cloud(change(points)))[0]
    assert verdict(rights, found) == "right", found


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda p: p[:, [2, 1, 0]], r"error: .*axis \+x points up"),
        (lambda p: np.concatenate([p, [[9e5, 0, 0]]]), "warning: 1 of 105001 points lie far off all others"),
        (lambda p: p[:10], "warning: .*only 10 points"),
        (lambda p: np.concatenate([p, moved(z=0.6)(p)]), r"error: the road occurs twice, 0\.6"),
        (lambda p: np.concatenate([p, moved(x=3.0, y=-1.0)(p)]), r"twice, shifted by 3\.2 m \(x [+-]3.0, y [+-]1.0\)"),
        (moved(pitch=3.0), r"lean by (2\.9|3\.[01]) deg"),
        (
            lambda p: p + [0, 0, 200.0] * (np.arange(len(p)) % 20 == 0)[:, None],
            r"error: 5\.0% of the points lie more than 100 m above the ground",
        ),
        (moved(x=367_000.0, y=3_951_000.0, z=20.0), "warning: .*does not name its coordinate system"),
        (lambda p: np.concatenate([p, moved(x=260.0, z=2.6)(p)]), "warning: .*missing between others"),
    ],
)
def test_faults_of_points_and_of_their_map_are_measured(points: F64, change: Change, name: str) -> None:
    changed = change(points)
    found = [*check_cloud(in_memory(changed)), *check_map(map_from_points(changed))]
    assert any(re.search(name, f"{f.severity}: {f.what}") for f in found), found


def test_a_map_of_walls_alone_has_no_axis_that_points_up(points: F64) -> None:
    rng = np.random.default_rng(1)
    x, z = rng.uniform(0, 60, 20_000), rng.uniform(0, 6, 20_000)
    walls = np.column_stack([x, np.where(rng.random(20_000) < 0.5, -8.0, 8.0), z])
    assert not [what for what in serious(check_cloud(in_memory(walls))) if "up" in what]


def test_house_fronts_behind_each_other_are_not_taken_for_the_ground() -> None:
    """Two blocks and a row of houses before them: along y more points lie on the last front than on the ground."""
    rng = np.random.default_rng(2)
    n = 12_000
    ground = np.column_stack([rng.uniform(0, 150, n // 3), rng.uniform(0, 90, n // 3), rng.normal(0, 0.02, n // 3)])
    fronts = [(0, 150, 85), (0, 60, 40), (0, 60, 5)]
    walls = [
        np.column_stack([rng.uniform(a, b, n), rng.normal(y, 0.02, n), rng.uniform(0, 20, n)]) for a, b, y in fronts
    ]
    houses = np.concatenate([ground, *walls])
    assert not [what for what in serious(check_cloud(in_memory(houses))) if "up" in what]


@pytest.mark.parametrize("share", [0.001, 0.5])
def test_points_that_are_not_finite_are_counted_or_an_error(tmp_path: Path, points: F64, share: float) -> None:
    broken = points.astype(np.float32)
    broken[: int(share * len(points))] = np.nan
    save_pcd(tmp_path / "m.pcd", broken, "binary")
    found = diagnose(tmp_path / "m.pcd").findings
    assert any(f"{int(share * len(points))} of {len(points)} points are not finite" in f.what for f in found)
    assert any(f.severity == "error" for f in found) == (share > 0.05)


def test_a_las_whose_scales_are_no_numbers_is_an_error(tmp_path: Path, points: F64) -> None:
    write_las(tmp_path / "m.las", Cloud(points))
    data = bytearray((tmp_path / "m.las").read_bytes())
    data[131:155] = struct.pack("<3d", *[np.nan] * 3)
    (tmp_path / "m.las").write_bytes(data)
    errors = [f.what for f in diagnose(tmp_path / "m.las").findings if f.severity == "error"]
    assert len(errors) == 1
    assert "its header scales x, y, z by (nan, nan, nan): no coordinates" in errors[0]


def test_examine_takes_map_folders_and_ballots(tmp_path: Path, sound: PointMap) -> None:
    write_map(sound, tmp_path / "m")
    found = diagnose(tmp_path / "m").findings
    assert serious(found) == []
    assert any("local metres" in f.what for f in found)
    (tmp_path / "b.ballot").write_bytes(b"no ballot")
    assert [f.severity for f in diagnose(tmp_path / "b.ballot").findings] == ["error"]


def city(seed: int = 3) -> tuple[F64, NDArray[np.uint8]]:
    """Houses of 4 by 4 m with flat roofs, 6 m apart, as an aircraft sees them: dense roofs, fronts, little of the
    ground between; ASPRS classes 2 (ground) and 6 (building)."""
    rng = np.random.default_rng(seed)
    corner = 6.0 * np.stack(np.meshgrid(np.arange(14), np.arange(14)), axis=-1).reshape(-1, 2)
    roofs, fronts, ground = (corner[rng.integers(0, len(corner), n)] for n in (60_000, 180_000, 20_000))
    along = rng.uniform(0, 4, (len(fronts), 2))
    side = rng.integers(0, 2, len(fronts))
    along[np.arange(len(fronts)), side] = 4.0 * rng.integers(0, 2, len(fronts))
    points = np.concatenate([
        np.column_stack([roofs + rng.uniform(0, 4, roofs.shape), rng.normal(12, 0.02, len(roofs))]),
        np.column_stack([fronts + along, rng.uniform(0.3, 12, len(fronts))]),
        np.column_stack([ground + rng.uniform([4.5, 0], [5.5, 6], ground.shape), rng.normal(0, 0.02, len(ground))]),
    ])  # fmt: skip
    return points, np.repeat([6, 6, 2], [len(roofs), len(fronts), len(ground)]).astype(np.uint8)


def test_the_classification_says_which_way_is_up() -> None:
    """In a city of flat roofs the sheet of points is above; the file says where the ground is."""
    points, classes = city()
    guessed = serious(check_cloud(in_memory(points)))
    assert any(re.search(UP, what) for what in guessed), "else the case is none"
    fields = {"classification": classes}
    assert not [what for what in serious(examine_points("city", Cloud(points, fields=fields))[0]) if " up" in what]
    turned = examine_points("city", Cloud(points * [1, -1, -1], fields=fields))[0]
    assert any(re.search(UP, what) for what in serious(turned))
