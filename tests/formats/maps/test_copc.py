"""COPC as other software reads it: laspy's reader, copclib's, and a viewer that asks for ranges of bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import copclib
import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.types import F64, MapvoteError
from mapvote.formats import export_map, read_map
from mapvote.formats.geo.frame import MapFrame
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.copc import OCTREE, write_copc
from mapvote.formats.maps.las import write_las

STEP_M = 1e-4


def street(n: int, length_m: float, seed: int = 1) -> F64:
    """Ground and two walls along x."""
    rng = np.random.default_rng(seed)
    x, side = rng.uniform(0.0, length_m, n), rng.integers(0, 3, n)
    y = np.where(side == 0, rng.uniform(-10, 10, n), np.where(side == 1, -10.0, 10.0))
    z = np.where(side == 0, 0.0, rng.uniform(0, 9, n)) + rng.normal(0, 0.02, n)
    return np.column_stack([x, y, z])


def in_order(points: F64) -> F64:
    steps = np.round(points / STEP_M).astype(np.int64)
    return np.asarray(steps[np.lexsort(steps.T)] * STEP_M)


def read(file: Path) -> laspy.ScaleAwarePointRecord:
    with laspy.CopcReader.open(file) as reader:
        return reader.query()


def entries(file: Path) -> list[copclib.Node]:
    nodes = copclib.FileReader(str(file)).GetAllNodes()
    return sorted(nodes, key=lambda node: (node.key.d, node.key.x, node.key.y, node.key.z))


def test_a_second_library_reads_all_points_fields_and_the_coordinate_system(tmp_path: Path) -> None:
    rng, points = np.random.default_rng(2), street(60_000, 400.0)
    fields: dict[str, NDArray[Any]] = {
        "intensity": rng.integers(0, 60_000, len(points)).astype(np.uint16),
        "classification": rng.integers(0, 20, len(points)).astype(np.uint8),
        "votes": rng.integers(0, 9, len(points)).astype(np.uint16),
    }
    cloud = Cloud(points, frame=MapFrame("EPSG:32654", (300_000.0, 3_900_000.0, 0.0)), fields=fields)
    write_copc(tmp_path / "a.copc.laz", cloud)
    write_las(tmp_path / "a.laz", cloud)
    plain, ours = laspy.read(tmp_path / "a.laz"), read(tmp_path / "a.copc.laz")
    by_place = [np.lexsort([p.X, p.Y, p.Z]) for p in (plain, ours)]
    for name in ("x", "y", "z", "intensity", "classification", "votes", "return_number"):
        a, b = (np.asarray(p[name])[order] for p, order in zip((plain, ours), by_place, strict=True))
        np.testing.assert_allclose(b, a, atol=0.5 * STEP_M)
    with laspy.CopcReader.open(tmp_path / "a.copc.laz") as reader:
        assert reader.header.parse_crs().to_epsg() == 32654
        np.testing.assert_allclose(reader.header.mins, plain.header.mins, atol=STEP_M)
        np.testing.assert_allclose(reader.header.maxs, plain.header.maxs, atol=STEP_M)
        assert reader.header.point_count == len(points)


@settings(max_examples=25)
@given(n=st.integers(1, 400), spread_m=st.sampled_from([0.0, 1e-3, 5.0, 3e4]), seed=st.integers(0, 99))
def test_any_cloud_comes_back_whole(
    tmp_path_factory: pytest.TempPathFactory, n: int, spread_m: float, seed: int
) -> None:
    points = np.random.default_rng(seed).normal(0.0, 1.0, (n, 3)) * [spread_m, spread_m, 0.1 * spread_m] + [3, -7, 40]
    file = tmp_path_factory.mktemp("copc") / "a.copc.laz"
    write_copc(file, Cloud(points))
    found = read(file)
    np.testing.assert_allclose(
        in_order(np.column_stack([found.x, found.y, found.z])), in_order(points), atol=2 * STEP_M
    )


def test_every_node_holds_points_of_its_cube_and_one_a_voxel_unless_it_is_the_last(tmp_path: Path) -> None:
    file = tmp_path / "a.copc.laz"
    write_copc(file, Cloud(street(300_000, 900.0)))
    reader = copclib.FileReader(str(file))
    info = reader.copc_config.copc_info
    low = np.array([info.center_x, info.center_y, info.center_z]) - info.halfsize
    nodes = entries(file)
    keys = {(n.key.d, n.key.x, n.key.y, n.key.z) for n in nodes}
    assert sum(node.point_count for node in nodes) == 300_000
    assert {node.key.d for node in nodes} >= {0, 1, 2, 3}
    for node in nodes:
        points = reader.GetPoints(node)
        xyz = np.column_stack([points.x, points.y, points.z]) - low
        side = 2.0 * info.halfsize / 2**node.key.d
        cube = np.array([node.key.x, node.key.y, node.key.z])
        assert (xyz >= cube * side - STEP_M).all()
        assert (xyz < (cube + 1) * side + STEP_M).all()
        children = [(node.key.d + 1, *(2 * cube + [i, j, k])) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        if any(tuple(int(v) for v in child) in keys for child in children):
            voxels = np.unique(np.floor(xyz / (side / 2**OCTREE.voxel_levels) + 1e-9), axis=0)
            assert len(voxels) >= 0.99 * node.point_count  # all but what lies on a voxel's border, to the step


def test_export_writes_a_map_as_copc_and_import_reads_it(tmp_path: Path) -> None:
    point_map: PointMap = map_from_points(street(20_000, 200.0))
    name, _ = export_map(point_map, tmp_path / "map.copc.laz")
    assert name == "COPC"
    assert read_map(tmp_path / "map.copc.laz").n_points == point_map.n_points
    assert set(np.unique(read(tmp_path / "map.copc.laz").classification)) == {1, 2}


def test_degrees_and_uncompressed_copc_are_refused_with_the_way_out(tmp_path: Path) -> None:
    georeference = {"crs": "EPSG:32654", "offset": "300000,3900000,0"}
    point_map = map_from_points(street(2_000, 50.0), georeference=georeference)
    with pytest.raises(MapvoteError, match="name a projection"):
        export_map(point_map, tmp_path / "a.copc.laz", crs="EPSG:4326")
    with pytest.raises(MapvoteError, match=r"name it a\.copc\.laz"):
        export_map(point_map, tmp_path / "a.copc.las")
    assert list(tmp_path.iterdir()) == []
