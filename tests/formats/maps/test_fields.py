"""Fields of an imported map stay with their points through import, update and export."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapvote.core import points as attributes
from mapvote.core.columns import flat_cells
from mapvote.core.point_map import all_fields
from mapvote.core.points import FIELDS, Field
from mapvote.formats import export_map, import_cloud, read_map, write_map
from mapvote.formats.maps import field_names
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.las import write_las
from mapvote.fusion.edit import add_points, delete_points


def las(n: int, seed: int) -> tuple[NDArray[np.float64], dict[str, NDArray[Any]]]:
    rng = np.random.default_rng(seed)
    points = np.round(rng.uniform([-90, -90, 0], [90, 90, 6], (n, 3)), 3)
    fields: dict[str, NDArray[Any]] = {
        "intensity": rng.integers(0, 65536, n).astype(np.uint16),
        "classification": rng.choice([1, 2, 5, 6], n).astype(np.uint8),
        "gps_time": rng.uniform(0, 1e9, n),
        "red": rng.integers(0, 65536, n).astype(np.uint16),
        "green": rng.integers(0, 65536, n).astype(np.uint16),
        "blue": rng.integers(0, 65536, n).astype(np.uint16),
    }
    return points, fields


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(1, 60), st.integers(0, 2**31), st.sampled_from([".las", ".laz"]))
def test_every_field_comes_back_from_las_through_a_map(tmp_path: Path, n: int, seed: int, suffix: str) -> None:
    points, fields = las(n, seed)
    write_las(tmp_path / f"a{suffix}", Cloud(points, fields=fields))
    point_map, _ = import_cloud(tmp_path / f"a{suffix}")
    write_map(point_map, tmp_path / "m")
    again = read_map(tmp_path / "m")
    export_map(again, tmp_path / f"b{suffix}")
    back = laspy.read(tmp_path / f"b{suffix}")
    found = {
        tuple(np.round([x, y, z], 3) + 0.0): i for i, (x, y, z) in enumerate(zip(back.x, back.y, back.z, strict=True))
    }
    for i, p in enumerate(points):
        j = found[tuple((p + 0.0).tolist())]
        assert all(back[name][j] == column[i] for name, column in fields.items())


def test_fields_survive_an_edit_for_every_point_that_stays(tmp_path: Path) -> None:
    points, fields = las(400, 1)
    write_las(tmp_path / "a.las", Cloud(points, fields=fields))
    point_map, _ = import_cloud(tmp_path / "a.las")
    tile = point_map.tiles[0, 0]
    before = {tuple(p): tile.fields["intensity"][i] for i, p in enumerate(tile.points.tolist())}
    edited, gone = delete_points(tile, np.full((256, 256), 2**64 - 1, dtype=np.uint64))
    new = np.array([[5.0, 5.0, 40.0]], dtype=np.float32)
    cells = flat_cells(edited.window, new)
    bright = {"intensity": np.array([51], dtype=np.uint8)}
    edited, came = add_points(edited, new, bright, cells, np.zeros(1, dtype=np.int32), 1)
    assert gone > 0
    assert came == 1
    for i, p in enumerate(edited.points[:-1].tolist()):
        assert edited.fields["intensity"][i] == before[tuple(p)]
    assert edited.fields["intensity"][-1] == 0.2 * 65535
    assert edited.fields["red"][-1] == 0


def test_noise_is_dropped_and_ground_classes_are_ground(tmp_path: Path) -> None:
    """A terrace: 3 m above the street, which the file classifies as ground, and a ditch that it calls noise."""
    x, y = np.meshgrid(np.arange(0, 30, 0.3), np.arange(0, 30, 0.3))
    flat = np.column_stack([x.ravel(), y.ravel(), np.where(x.ravel() > 15, 3.0, 0.0)])
    noise = np.column_stack([flat[:50, :2], np.full(50, -6.0)])
    classes = np.concatenate([np.full(len(flat), 2), np.full(50, 7)]).astype(np.uint8)
    write_las(tmp_path / "a.las", Cloud(np.concatenate([flat, noise]), fields={"classification": classes}))
    point_map, told = import_cloud(tmp_path / "a.las")
    assert any("50 points that the file marks as noise" in line for line in told)
    ground = point_map.tiles[0, 0].ground_z
    assert ground[20, 80] == pytest.approx(3.0, abs=0.05)
    assert ground[20, 20] == pytest.approx(0.0, abs=0.05)


def test_a_map_without_classes_leaves_with_ground_and_returns(tmp_path: Path) -> None:
    from mapvote.core.point_map import map_from_points

    x, y = np.meshgrid(np.arange(0, 20, 0.3), np.arange(0, 20, 0.3))
    street = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    pole = np.column_stack([np.full(20, 9.0), np.full(20, 9.0), np.linspace(1, 5, 20)])
    point_map = map_from_points(np.concatenate([street, pole]), georeference={"crs": "EPSG:32654"})
    export_map(point_map, tmp_path / "a.laz")
    back = laspy.read(tmp_path / "a.laz")
    high = np.asarray(back.z) > 0.5
    assert set(np.asarray(back.classification)[high].tolist()) == {1}
    assert set(np.asarray(back.classification)[~high].tolist()) == {2}
    assert set(np.asarray(back.number_of_returns).tolist()) == {1}
    assert back.header.parse_crs().to_epsg() == 32654
    assert all_fields(read_map(tmp_path / "a.laz"))["classification"].dtype == np.uint8


@pytest.mark.parametrize("suffix", [".las", ".laz", ".pcd", ".ply"])
def test_an_attribute_of_another_distribution_stays_through_import_and_export(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    points, fields = las(200, 5)
    heat = np.linspace(-20.0, 60.0, 200).astype(np.float32)
    write_las(tmp_path / "a.las", Cloud(points, fields={**fields, "heat": heat}))
    point_map, told = import_cloud(tmp_path / "a.las")
    assert "heat" not in point_map.field_names
    assert any(line.startswith("dropped fields: ") and line.endswith(", heat") for line in told)
    every = {**FIELDS, "heat": Field("<f4", spellings=("heat",))}
    for module in (attributes, field_names):
        monkeypatch.setattr(module, "point_fields", lambda: every)
    point_map, told = import_cloud(tmp_path / "a.las")
    assert not any("heat" in line for line in told)
    export_map(point_map, tmp_path / f"b{suffix}")
    back = all_fields(read_map(tmp_path / f"b{suffix}"))
    assert back["heat"].dtype == np.float32
    assert sorted(back["heat"].tolist()) == sorted(heat.tolist())
    assert sorted(zip(back["heat"].tolist(), back["intensity"].tolist(), strict=True)) == sorted(
        zip(heat.tolist(), fields["intensity"].tolist(), strict=True)
    )
