"""PCD, LAS, PLY and Autoware: what goes out comes back, what is broken is named."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pypcd4 import PointCloud

from hand_made import save_pcd
from mapvote.core.point_map import all_fields, all_points, lattice_of, map_from_points
from mapvote.core.types import F64, MapvoteError
from mapvote.formats import export_map, read_map, stream_cloud, write_map, write_pcd
from mapvote.formats.maps.autoware import lay_version, stream_autoware, write_autoware
from mapvote.formats.maps.cloud import Cloud, CloudPieces, joined
from mapvote.formats.maps.las import write_las
from mapvote.formats.maps.pcd import read_pcd_table
from mapvote.formats.maps.ply import write_ply

ENCODINGS = "ascii", "binary", "binary_compressed"
UTM = np.array([367_123.0, 3_951_876.0, 40.0])


def points(n: int = 500, seed: int = 0) -> F64:
    return np.random.default_rng(seed).uniform([-60, -60, -2], [60, 60, 12], (n, 3))


def by_row(p: NDArray[np.floating]) -> NDArray[np.floating]:
    return p[np.lexsort(p.T)]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_pcd_longer_than_its_header_says_is_refused_and_blank_lines_are_not(tmp_path: Path, encoding: str) -> None:
    two = b"1 2 3\n" * 2 if encoding == "ascii" else b"\1" * 24
    for more, whole in ((two, False), (b"\n\n", True)):
        save_pcd(tmp_path / "a.pcd", points().astype(np.float32), encoding)
        with (tmp_path / "a.pcd").open("ab") as file:
            file.write(more)
        for read in (read_map, read_pcd_table):
            if whole:
                read(tmp_path / "a.pcd")
            else:
                with pytest.raises(MapvoteError, match="its header says 500 points, but data for 2 more follow"):
                    read(tmp_path / "a.pcd")


def test_padding_between_fields_and_the_zeros_that_old_pcl_lets_follow_are_no_points(tmp_path: Path) -> None:
    kinds = [("xyz", "<f4", 3), ("_1", "u1", 4), ("intensity", "<f4"), ("ring", "<u2"), ("_2", "u1", 10)]
    table = np.ones(40, dtype=kinds)
    table["xyz"] = points(40)
    head = (
        b"VERSION 0.7\nFIELDS x y z _ intensity ring _\nSIZE 4 4 4 1 4 2 1\nTYPE F F F U F U U\nCOUNT 1 1 1 4 1 1 10\n"
        b"WIDTH 40\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 40\nDATA binary\n"
    )
    (tmp_path / "a.pcd").write_bytes(head + table.tobytes() + bytes(4096 - len(head)))
    assert np.array_equal(joined(stream_cloud(tmp_path / "a.pcd")).points, table["xyz"])
    assert len(read_pcd_table(tmp_path / "a.pcd")) == 40


def test_autoware_tiles_that_nobody_lists_are_said_aloud_but_those_kept_for_a_running_stack(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    lay_version(tmp_path / "live", CloudPieces.of(Cloud(points())), 1)
    lay_version(tmp_path / "live", CloudPieces.of(Cloud(points(400))), 2)
    list(stream_autoware(tmp_path / "live"))
    assert not caplog.records
    (tmp_path / "live" / "pointcloud_map.pcd" / "extra.pcd").write_bytes(b"")
    list(stream_autoware(tmp_path / "live"))
    assert "lists no corner of 1 of the PCD files there (first: extra.pcd): they are left out" in caplog.text


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_pcd_is_read_in_every_encoding(tmp_path: Path, encoding: str, kind: type) -> None:
    before: NDArray[np.floating] = points().astype(kind)
    save_pcd(tmp_path / "a.pcd", before, encoding)
    after = joined(stream_cloud(tmp_path / "a.pcd")).points
    assert after.dtype == before.dtype
    assert np.allclose(after, before, rtol=1e-6) if encoding == "ascii" else np.array_equal(after, before)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_pcl_reads_what_is_written(tmp_path: Path, kind: type) -> None:
    before: NDArray[np.floating] = points().astype(kind)
    brightness = np.arange(500, dtype=np.uint16)
    write_pcd(tmp_path / "a.pcd", Cloud(before, fields={"intensity": brightness}), double=kind is np.float64)
    after = PointCloud.from_path(tmp_path / "a.pcd")
    assert np.array_equal(after.numpy(("x", "y", "z")), before)
    assert np.array_equal(after.numpy(("intensity",))[:, 0], brightness)


everyone = st.tuples(st.integers(1, 50), st.integers(0, 2**31), st.floats(-4e6, 4e6))


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(everyone)
def test_autoware_round_trip_is_exact_in_float32(tmp_path: Path, case: tuple[int, int, float]) -> None:
    n, seed, far = case
    before = points(n, seed) + np.array([far / 100, -far / 100, 0.0])
    write_autoware(tmp_path / "a", Cloud(before))
    assert np.array_equal(
        by_row(joined(list(stream_autoware(tmp_path / "a"))).points), by_row(before.astype(np.float32))
    )


def test_autoware_metadata_is_what_its_loader_reads(tmp_path: Path) -> None:
    write_autoware(tmp_path / "a", Cloud(np.array([[1205.0, 2501.0, 0.0], [-0.5, 3.0, 1.0]])))
    metadata = yaml.safe_load((tmp_path / "a" / "pointcloud_map_metadata.yaml").read_text())
    assert metadata == {
        "x_resolution": 20.0,
        "y_resolution": 20.0,
        "-20_0.pcd": [-20, 0],
        "1200_2500.pcd": [1200, 2500],
    }
    tile = PointCloud.from_path(tmp_path / "a" / "pointcloud_map.pcd" / "1200_2500.pcd")
    assert tile.numpy(("x", "y", "z")).tolist() == [[1205.0, 2501.0, 0.0]]


def test_autoware_tiles_that_lie_are_named(tmp_path: Path) -> None:
    write_autoware(tmp_path / "a", Cloud(points()))
    file = tmp_path / "a" / "pointcloud_map_metadata.yaml"
    good = file.read_text()
    file.write_text(good.replace("[-20, 0]", "[980, 0]"))
    with pytest.raises(MapvoteError, match=r"-20_0\.pcd: .* outside its square"):
        read_map(tmp_path / "a")
    file.write_text(good + "7_7.pcd: [7, 7]\n")
    with pytest.raises(MapvoteError, match=r"7_7\.pcd: missing"):
        read_map(tmp_path / "a")
    for text in ("tiles: 3\n", "[1, 2]\n", "x_resolution: 20\ny_resolution: 20\n", "a: [\n"):
        file.write_text(text)
        with pytest.raises(MapvoteError, match="metadata"):
            read_map(tmp_path / "a")


def test_float32_at_utm_coordinates_is_said_aloud(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        write_pcd(tmp_path / "near.pcd", Cloud(points()))
    assert caplog.text == ""
    with caplog.at_level(logging.WARNING):
        write_pcd(tmp_path / "far.pcd", Cloud(points() + UTM))
    assert "rounded by up to 125.0 mm" in caplog.text


@pytest.mark.parametrize("name", ["m.las", "m.laz", "m.ply"])
def test_a_utm_map_survives_a_round_trip(tmp_path: Path, name: str) -> None:
    cloud = points(3000) + UTM
    before = map_from_points(cloud, lattice=lattice_of(cloud), georeference={"crs": "EPSG:32654"})
    export_map(before, tmp_path / name)
    after = read_map(tmp_path / name)
    assert after.lattice == before.lattice
    assert np.abs(all_points(after) - all_points(before)).max() < 1e-4
    write_map(after, tmp_path / "m")
    assert np.array_equal(all_points(read_map(tmp_path / "m")), all_points(after))
    if name != "m.ply":
        assert after.georeference["crs"] == "EPSG:32654"


@pytest.mark.parametrize(("name", "write"), [("m.pcd", write_pcd), ("m.las", write_las), ("m.ply", write_ply)])
def test_a_map_comes_back_with_its_fields(tmp_path: Path, name: str, write: Any) -> None:
    """The same points from every format; a LAS holds them to 0.05 mm, a PCD and a map as float32."""
    brightness = np.arange(500, dtype=np.uint16)
    write(tmp_path / name, Cloud(points(), fields={"intensity": brightness}))
    read = read_map(tmp_path / name)
    columns = all_fields(read)
    order = np.argsort(columns["intensity"])
    assert np.abs(all_points(read)[order] - points()).max() < 1e-4
    assert np.array_equal(columns["intensity"][order], brightness)


def test_truncated_files_are_named(tmp_path: Path) -> None:
    for name, write in (("a.ply", write_ply), ("a.las", write_las), ("a.laz", write_las), ("a.pcd", write_pcd)):
        file = tmp_path / name
        write(file, Cloud(points()))
        for keep in (0.5, 0.01):
            data = file.read_bytes()
            file.write_bytes(data[: int(keep * len(data))])
            with pytest.raises(MapvoteError, match=name):
                read_map(file)


def test_a_folder_of_pcd_tiles_in_any_tiling_is_a_map_and_with_stamps_it_is_a_drive(tmp_path: Path) -> None:
    points = np.random.default_rng(1).uniform((-233.4, -754.6, 0.3), (-160.0, -700.0, 4.0), (500, 3))
    of_tile = np.floor((points[:, :2] - (-233.49335, -754.68726)) / 25.0).astype(int)
    for x, y in np.unique(of_tile, axis=0):
        write_pcd(tmp_path / f"{x}_{y}.pcd", Cloud(points[(of_tile == (x, y)).all(axis=1)]))
    read = all_points(read_map(tmp_path))
    assert len(list(tmp_path.iterdir())) > 3
    assert np.allclose(read[np.lexsort(read.T)], points[np.lexsort(points.T)], atol=1e-4)
    (tmp_path / "times.txt").write_text("0.0\n" * 9)
    with pytest.raises(MapvoteError, match="a map is one of"):
        read_map(tmp_path)


def test_nan_points_of_a_map_are_dropped_and_counted_or_refused(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cloud = points()
    cloud[:3] = np.nan
    write_ply(tmp_path / "a.ply", Cloud(cloud))
    with caplog.at_level(logging.WARNING):
        assert len(all_points(read_map(tmp_path / "a.ply"))) == 497
    assert "dropped 3 of 500" in caplog.text
    cloud[:100] = np.nan
    write_ply(tmp_path / "a.ply", Cloud(cloud))
    with pytest.raises(MapvoteError, match="100 of 500 points are not finite"):
        read_map(tmp_path / "a.ply")


def test_an_empty_map_and_a_file_without_z_are_named(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", Cloud(np.zeros((0, 3))))
    flat = PointCloud.from_points(points()[:, :2].astype(np.float32), ("x", "y"), (np.float32, np.float32))
    flat.save(tmp_path / "a.pcd")
    for name, said in (("a.ply", "holds no points"), ("a.pcd", "no field z among x, y")):
        with pytest.raises(MapvoteError, match=said):
            read_map(tmp_path / name)


@pytest.mark.parametrize(("name", "package", "extra"), [("a.las", "laspy", "las"), ("a.ply", "plyfile", "ply")])
def test_a_missing_package_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str, extra: str
) -> None:
    (tmp_path / name).write_bytes(b"anything")
    for module in [m for m in sys.modules if m.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MapvoteError, match=rf"needs the package {package}; .*mapvote\[{extra}\]"):
        read_map(tmp_path / name)


def test_nothing_is_left_behind_where_it_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(MapvoteError, match="cannot be written"):
        write_pcd(tmp_path / "file" / "a.pcd", Cloud(points()))
    with pytest.raises(MapvoteError, match=r"no format for \.abc"):
        export_map(map_from_points(points()), tmp_path / "a.abc")
    assert os.listdir(tmp_path) == ["file"]
