"""Bags of recordings that were not stopped properly: no metadata.yaml, a wrong one, an MCAP that is cut off."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import StoragePlugin

from bag_recorder import START, Recorder
from mapvote.core.types import MapvoteError
from mapvote.doctor.bags import check_bag
from mapvote.formats import open_drive

N = 12
STORAGES = [StoragePlugin.MCAP, StoragePlugin.SQLITE3]


def recorded(folder: Path, storage: StoragePlugin = StoragePlugin.MCAP, first: int = 0, points: int = 400) -> Path:
    """A folder with N clouds from the ``first`` on, and its metadata.yaml."""
    recorder = Recorder(folder, storage)
    rng = np.random.default_rng(first)
    for i in range(first, first + N):
        recorder.cloud("/points", "lidar", START + i * 10**8, rng.uniform(3, 40, (points, 3)))
    recorder.bag.close()
    return folder


@pytest.mark.parametrize("storage", STORAGES)
def test_a_folder_of_pieces_without_metadata_is_one_drive(
    tmp_path: Path, storage: StoragePlugin, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    for piece in (10, 2, 0):
        (file,) = [f for f in recorded(tmp_path / f"p{piece}", storage, piece * N).iterdir() if f.suffix != ".yaml"]
        file.rename(folder / f"bag_{piece}{file.suffix.upper()}")
    with caplog.at_level(logging.WARNING):
        drive = open_drive(folder, sensor="hdl32e")
    assert "no metadata.yaml; read without it: bag_0" in caplog.text
    assert drive.stamps_ns.tolist() == [
        START + i * 10**8 for piece in (0, 2, 10) for i in range(piece * N, piece * N + N)
    ]
    assert len(drive.read_scan(2 * N).points) == 400


def test_several_recordings_in_a_folder_are_a_choice(tmp_path: Path) -> None:
    for name in ("monday", "friday"):
        recorded(tmp_path / name).joinpath(f"{name}.mcap").rename(tmp_path / f"{name}.mcap")
    folder = tmp_path / "both"
    folder.mkdir()
    for name in ("monday", "friday"):
        (tmp_path / f"{name}.mcap").rename(folder / f"{name}.mcap")
    with pytest.raises(MapvoteError, match=r"several recordings and no metadata\.yaml; give one of: friday"):
        open_drive(folder)
    (folder / "drive.toml").write_text("sensor = 'vlp16'\nvehicle = 'car_7'\n")
    drive = open_drive(folder / "monday.mcap")  # drive.toml lies beside a bag of one file
    assert (drive.sensor.name, drive.vehicle) == ("vlp16", "car_7")


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize(
    "change",
    [
        {"storage_identifier": ""},
        {"relative_file_paths": ["renamed_0.mcap"]},
        {"relative_file_paths": None},
        {"topics_with_message_count": ...},
    ],
)
def test_metadata_that_no_reader_can_use_is_named_and_done_without(
    tmp_path: Path, storage: StoragePlugin, change: dict[str, object], caplog: pytest.LogCaptureFixture
) -> None:
    file = recorded(tmp_path / "bag", storage) / "metadata.yaml"
    table = yaml.safe_load(file.read_text())
    for key, value in change.items():
        table["rosbag2_bagfile_information"][key] = value
        if value is ...:
            del table["rosbag2_bagfile_information"][key]
    file.write_text(yaml.safe_dump(table))
    with caplog.at_level(logging.WARNING):
        assert len(open_drive(tmp_path / "bag", sensor="hdl32e")) == N
    assert "metadata.yaml" in caplog.text
    assert "read without it: bag." in caplog.text


@pytest.mark.parametrize("share", [0.999, 0.75, 0.5])
def test_an_mcap_that_is_cut_off_is_read_up_to_the_cut(tmp_path: Path, share: float) -> None:
    whole = recorded(tmp_path / "bag", points=30_000) / "bag.mcap"
    scans = list(open_drive(whole, sensor="hdl32e"))
    data = whole.read_bytes()
    whole.write_bytes(data[: int(share * len(data))])
    found = [f for f in check_bag(tmp_path / "bag") if f.severity == "warning"]
    assert "bytes are an incomplete record and left out. `mcap recover" in found[0].what
    drive = open_drive(tmp_path / "bag", sensor="hdl32e")
    assert share * N - 4 <= len(drive) <= share * N + 1
    for scan, sound in zip(drive, scans, strict=False):
        assert scan.stamp_ns == sound.stamp_ns
        assert np.array_equal(scan.points, sound.points)


def test_an_mcap_without_a_whole_record_is_one_error_that_names_its_mend(tmp_path: Path) -> None:
    file = recorded(tmp_path / "bag") / "bag.mcap"
    data = file.read_bytes()
    for end, name in ((20, "cut off before its first whole record"), (60, r"no topic of|mcap recover \S+bag.mcap")):
        file.write_bytes(data[:end])
        with pytest.raises(MapvoteError, match=name):
            open_drive(file)


def test_a_ros1_bag_that_is_still_recorded_is_named(tmp_path: Path) -> None:
    file = tmp_path / "x.bag.active"
    file.write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(MapvoteError, match=r"rosbag reindex \S+x\.bag\.active"):
        open_drive(file)
