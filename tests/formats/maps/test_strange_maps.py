"""Map files with what no map can hold: read right, or refused with cause and mend."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapvote.core.point_map import all_points
from mapvote.core.types import F64, MapvoteError
from mapvote.doctor.diagnosis import diagnose
from mapvote.formats import import_cloud
from mapvote.formats.maps.cloud import Cloud, CloudPieces
from mapvote.formats.maps.las import write_las
from mapvote.formats.registry import WRITERS

POINTS = np.random.default_rng(8).uniform([0, 0, 0], [30, 30, 4], (2000, 3))


def written(file: Path, points: F64) -> Path:
    WRITERS[file.suffix].write(file, CloudPieces.of(Cloud(points)))
    return file


def test_a_header_of_ply_may_hold_any_letters(tmp_path: Path) -> None:
    file = written(tmp_path / "map.ply", POINTS)
    file.write_bytes(file.read_bytes().replace(b"comment mapvote", "comment Stra\xdfe".encode("latin-1"), 1))
    read = all_points(import_cloud(file)[0])
    np.testing.assert_allclose(np.sort(read, axis=0), np.sort(POINTS, axis=0), atol=1e-5)


def test_a_number_that_is_no_coordinate_is_left_out(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[7] = 1e30
    assert len(all_points(import_cloud(written(tmp_path / "map.ply", points))[0])) == len(POINTS) - 1


def test_points_without_a_number_are_one_error(tmp_path: Path) -> None:
    with pytest.raises(MapvoteError, match="2000 of 2000 points are not finite"):
        import_cloud(written(tmp_path / "map.ply", POINTS * np.nan))


def test_metres_from_the_centre_of_the_earth_are_named(tmp_path: Path) -> None:
    file = written(tmp_path / "map.ply", POINTS[:, [2, 0, 1]] + [4_146_000.0, 612_000.0, 4_791_000.0])
    with pytest.raises(MapvoteError, match=r"metres from the Earth's centre; if so: .*EPSG:4978"):
        import_cloud(file)


@pytest.mark.parametrize("scale", [0.0, float("nan"), float("inf")])
def test_a_las_header_without_a_scale_is_refused(tmp_path: Path, scale: float) -> None:
    file = written(tmp_path / "map.las", POINTS)
    data = bytearray(file.read_bytes())
    data[131:139] = np.float64(scale).tobytes()
    file.write_bytes(bytes(data))
    with pytest.raises(MapvoteError, match="its header scales x, y, z by"):
        import_cloud(file)


def test_a_text_file_is_called_no_ballot(tmp_path: Path) -> None:
    file = tmp_path / "map.xyz"
    file.write_text("1 2 3\n")
    (finding,) = diagnose(file).findings
    assert "of no known kind (.xyz)" in finding.what


def test_a_folder_of_las_tiles_is_one_map_and_a_folder_of_las_scans_is_none(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    tile = rng.uniform(0.0, 30.0, (4_000, 3)) * [1.0, 1.0, 0.001]
    for folder, step_m in (("tiles", 30.0), ("scans", 1.0)):
        (tmp_path / folder).mkdir()
        for k, name in enumerate(("r0_c0.las", "r0_c1.laz", "r1_c0.LAS")):
            write_las(tmp_path / folder / name, Cloud(tile + np.array([step_m * k, 0.0, 0.0])))
    assert import_cloud(tmp_path / "tiles")[0].n_points == 12_000
    with pytest.raises(MapvoteError):
        import_cloud(tmp_path / "scans")


@pytest.mark.parametrize("beside", ["1_0.las", "1_0.pcd.gz", "1_0.PCD"])
def test_tiles_of_another_kind_beside_tiles_are_an_error_and_no_part_of_a_map(tmp_path: Path, beside: str) -> None:
    written(tmp_path / "0_0.pcd", POINTS)
    other = tmp_path / beside
    other.mkdir() if beside.endswith("PCD") else other.write_bytes(b"any")
    with pytest.raises(MapvoteError, match=f"{beside} would not be read beside 0_0.pcd"):
        import_cloud(tmp_path)
    other.rename(tmp_path / "note.txt")
    assert len(all_points(import_cloud(tmp_path)[0])) == len(POINTS)
