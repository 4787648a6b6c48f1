"""Names of files in whatever case: no map and no drive loses a part of itself to a capital letter."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from mapvote.core.point_map import all_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64
from mapvote.formats import DriveWriter, is_cloud, open_drive, read_map, write_pcd
from mapvote.formats.listing import entry, files_like
from mapvote.formats.maps.autoware import write_autoware
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.las import write_las
from mapvote.formats.maps.ply import write_ply


def points(n: int = 400, seed: int = 0) -> F64:
    return np.random.default_rng(seed).uniform([1, 1, 0], [39, 39, 6], (n, 3))


def shout(file: Path) -> None:
    file.rename(file.with_name(file.name.upper()))


@pytest.mark.parametrize("suffix", [".pcd", ".las", ".laz", ".ply"])
def test_one_file_is_a_map_under_any_suffix(tmp_path: Path, suffix: str) -> None:
    write = {".pcd": write_pcd, ".ply": write_ply}.get(suffix, write_las)
    write(tmp_path / f"a{suffix}", Cloud(points()))
    shout(tmp_path / f"a{suffix}")
    assert is_cloud(tmp_path / f"A{suffix.upper()}")
    assert read_map(tmp_path / f"A{suffix.upper()}").n_points == 400


def test_no_tile_is_left_out(tmp_path: Path) -> None:
    for i, suffix in enumerate((".pcd", ".PCD", ".Pcd")):
        write_pcd(tmp_path / f"{i}_0{suffix}", Cloud(points() + np.array([40.0 * i, 0, 0])))
    assert read_map(tmp_path).n_points == 1200
    write_autoware(tmp_path / "autoware", Cloud(points()))
    shout(next((tmp_path / "autoware/pointcloud_map.pcd").iterdir()))
    assert read_map(tmp_path / "autoware").n_points == 400


def written_drive(folder: Path, n: int = 12) -> None:
    writer = DriveWriter(folder, "car-7", SENSORS["vlp16"], start_ns=10**18).open()
    for i in range(n):
        writer.write_scan(i, (points(300, i) + np.array([3.0, 0, 0])).astype(np.float32))
    prior = np.tile(np.eye(4), (n, 1, 1))
    prior[:, 0, 3] = np.arange(n)
    writer.close(10**18 + np.arange(n) * 10**8, prior)


def test_no_scan_and_no_word_about_a_drive_is_left_out(tmp_path: Path) -> None:
    """Scans, times, prior and drive.toml of a KITTI folder; every second one in capitals."""
    written_drive(tmp_path / "d")
    right = open_drive(tmp_path / "d")
    scans = [scan.points for scan in right]
    for file in sorted((tmp_path / "d/velodyne").iterdir())[::2]:
        shout(file)
    for name in ("times.txt", "prior.txt", "drive.toml"):
        shout(tmp_path / "d" / name)
    drive = open_drive(tmp_path / "d")
    assert len(drive) == 12
    assert drive.vehicle == "car-7"
    assert np.array_equal(drive.stamps_ns, right.stamps_ns)
    assert right.T_map_lidar_prior is not None
    assert np.array_equal(drive.T_map_lidar_prior, right.T_map_lidar_prior)  # type: ignore[arg-type]
    assert all(np.array_equal(drive.read_scan(i).points, scans[i]) for i in range(12))


@pytest.mark.parametrize("suffix", ["pcd", "ply", "las", "npy", "bin"])
def test_no_scan_of_a_folder_is_left_out(tmp_path: Path, suffix: str) -> None:
    for i in range(6):
        name = f"{i:03d}.{suffix.upper() if i % 2 else suffix}"
        cloud = points(300, i)
        if suffix == "npy":
            with (tmp_path / name).open("wb") as file:
                np.save(file, cloud)
        elif suffix == "bin":
            np.column_stack([cloud, cloud[:, 0]]).astype("<f4").tofile(tmp_path / name)
        else:
            {"pcd": write_pcd, "ply": write_ply, "las": write_las}[suffix](tmp_path / name, Cloud(cloud))
    assert len(open_drive(tmp_path, rate_hz=10.0)) == 6


def test_a_bag_is_found_under_any_suffix(tmp_path: Path) -> None:
    from mapvote.formats.drives.bag_files import is_bag, mend_of

    for name in ("a.BAG", "b.MCAP", "c.DB3"):
        (tmp_path / name).write_bytes(b"")
        assert is_bag(tmp_path / name)
    shutil.rmtree(tmp_path)
    tmp_path.mkdir()
    (tmp_path / "a.db3.ZSTD").write_bytes(b"")
    assert "zstd" in mend_of(tmp_path)


def test_the_exact_name_comes_first_and_nothing_else_is_found(tmp_path: Path) -> None:
    (tmp_path / "gps").mkdir()
    for name in ("INS.CSV", "ins.csv", ".hidden.csv", "ins.csv.bak"):
        (tmp_path / "gps" / name).write_text(name)
    assert entry(tmp_path, "gps/ins.csv") == tmp_path / "gps/ins.csv"
    assert entry(tmp_path, "GPS/Ins.csv").read_text() == "INS.CSV"
    assert entry(tmp_path, "gps/none.csv") == tmp_path / "gps/none.csv"
    assert [file.name for file in files_like(tmp_path, "gps/*.csv")] == ["INS.CSV", "ins.csv"]
    assert files_like(tmp_path / "nowhere", "*.csv") == []
    assert all_points(read_map(written(tmp_path))).shape == (400, 3)


def written(folder: Path) -> Path:
    write_pcd(folder / "x.PCD", Cloud(points()))
    return folder / "x.PCD"
