"""Scans without a point: a driver that started before its sensor, a recorder that was stopped, a disk that was full."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from faults import Recording
from mapvote.core.types import F64, MapvoteError
from mapvote.formats import open_drive
from recorded_bags import write_bag

N = 6
T_MAP_LIDAR: F64 = np.tile(np.eye(4), (N, 1, 1))
T_MAP_LIDAR[:, 0, 3] = np.arange(N)


def points(i: int) -> F64:
    rng = np.random.default_rng(i)
    return np.column_stack([rng.uniform(3.0, 30.0, (500, 3)), rng.uniform(0.0, 0.1, (500, 2))])


def kitti(folder: Path, empty: set[int]) -> Path:
    (folder / "velodyne").mkdir(parents=True)
    for i in range(N):
        rows = points(i)[: 0 if i in empty else None, :4]
        (folder / "velodyne" / f"{i:06}.bin").write_bytes(rows.astype("<f4").tobytes())
    np.savetxt(folder / "prior.txt", T_MAP_LIDAR[:, :3].reshape(N, 12))
    np.savetxt(folder / "times.txt", np.arange(N) / 10)
    return folder


def pcd(folder: Path, empty: set[int]) -> Path:
    folder.mkdir(parents=True)
    for i in range(N):
        rows = points(i)[: 0 if i in empty else None, :3]
        head = f"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(rows)}\nHEIGHT 1\n"
        data = head + f"POINTS {len(rows)}\nDATA binary\n"
        (folder / f"{i:06}.pcd").write_bytes(data.encode() + rows.astype("<f4").tobytes())
    np.savetxt(folder / "prior.txt", T_MAP_LIDAR[:, :3].reshape(N, 12))
    np.savetxt(folder / "times.txt", np.arange(N) / 10)
    return folder


def bag(folder: Path, empty: set[int]) -> Path:
    pytest.importorskip("rosbags")
    scans = [points(i)[: 0 if i in empty else None] for i in range(N)]
    return write_bag(Recording(scans, T_MAP_LIDAR, np.arange(N) / 10), folder)


LAYOUTS = {"KITTI": kitti, "PCD": pcd, "bag": bag}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("empty", [{0}, {2, 3}, {N - 1}])
def test_scans_without_points_are_left_out_and_named(
    layout: str, empty: set[int], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        drive = open_drive(LAYOUTS[layout](tmp_path / "drive", empty), prior="/odom" if layout == "bag" else None)
    kept = [i for i in range(N) if i not in empty]
    assert f"{len(empty)} of {N} scans hold no point and are left out" in caplog.text
    assert [sentence.partition(":")[0] for sentence in drive.left_out] == [
        f"{len(empty)} of {N} scans hold no point and are left out"
    ]
    assert drive.T_map_lidar_prior is not None
    assert drive.T_map_lidar_prior[:, 0, 3].round(6).tolist() == kept
    assert ((drive.stamps_ns - drive.stamps_ns[0]) // 10**8).tolist() == [i - kept[0] for i in kept]
    for k, i in enumerate(kept):
        np.testing.assert_allclose(drive.read_scan(k).points, points(i)[:, :3], atol=1e-4)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_drive_without_any_point_is_refused(layout: str, tmp_path: Path) -> None:
    with pytest.raises(MapvoteError, match=f"none of its {N} scans holds a point"):
        open_drive(LAYOUTS[layout](tmp_path / "drive", set(range(N))))


@pytest.mark.parametrize("layout", ["KITTI", "PCD"])
@pytest.mark.parametrize("packed", [True, False])
def test_scans_that_are_compressed_or_folders_are_named(
    layout: str, packed: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = LAYOUTS[layout](tmp_path / "drive", set())
    suffix = {"KITTI": ".bin", "PCD": ".pcd"}[layout]
    room = folder / "velodyne" if layout == "KITTI" else folder
    name = f"{N:06}{suffix}" + (".gz" if packed else "")
    (room / name).touch() if packed else (room / name).mkdir()
    with caplog.at_level(logging.WARNING):
        assert len(open_drive(folder).stamps_ns) == N
    assert f"1 scans are compressed or folders: left out ({name})" in caplog.text


@pytest.mark.parametrize("name", ["drive.toml", "prior.txt", "times.txt"])
@pytest.mark.parametrize("is_link", [True, False])
def test_a_folder_or_a_link_to_nothing_is_no_missing_file(name: str, is_link: bool, tmp_path: Path) -> None:
    folder = kitti(tmp_path / "drive", set())
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(tmp_path / "moved") if is_link else (folder / name).mkdir()
    with pytest.raises(MapvoteError, match=f"{name}: is {'a link to nothing' if is_link else 'no file'}"):
        open_drive(folder)
