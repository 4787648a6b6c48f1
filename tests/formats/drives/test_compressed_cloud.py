"""Clouds of point_cloud_transport: zstd and zlib lose nothing; other formats are refused by name, with the mend."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bag_recorder import CLOUD, START, Recorder
from mapvote.codec.planes import zstd
from mapvote.core.types import MapvoteError
from mapvote.formats import open_drive
from mapvote.formats.drives.compressed_cloud import definition_of_compressed, one_of_each_cloud
from mapvote.formats.drives.point_fields import point_cloud_table
from mapvote.formats.drives.ros_types import COMPRESSED
from mapvote.live.choice import Wish, lack_of_clouds
from mapvote.live.dds import PublishedTopic
from mapvote.live.messages import blank_message, cloud_of, from_cdr, to_cdr

pytest.importorskip("rosbags")
POINTS = np.random.default_rng(3).uniform(5.0, 40.0, (300, 3)).astype("<f4")
FORMATS: dict[str, Callable[[bytes], bytes]] = {"zstd": zstd.compress, "zlib": gzip.compress, "ZLIB ": zlib.compress}


def compressed(form: str, data: bytes, ns: int = START) -> Any:
    """The message as the plug-ins make it: the members of a PointCloud2 but for its data."""
    cloud = vars(cloud_of({axis: POINTS[:, k] for k, axis in enumerate("xyz")}, ns, "lidar"))
    members = {name: value for name, value in cloud.items() if name not in ("data", "__msgtype__")}
    return blank_message(COMPRESSED, **members, compressed_data=np.frombuffer(data, np.uint8), format=form)


def bag_of(folder: Path, clouds: Mapping[str, tuple[str, bytes]], scans: int) -> Path:
    """Compressed clouds by topic: (format, data) of each."""
    recorder = Recorder(folder)
    recorder.register({COMPRESSED: definition_of_compressed()})
    for ns in START + np.arange(scans) * 10**8:
        for topic, (form, data) in clouds.items():
            recorder.write_raw(topic, COMPRESSED, int(ns), to_cdr(COMPRESSED, compressed(form, data, int(ns))))
    recorder.bag.close()
    return folder


@pytest.mark.parametrize("form", FORMATS)
def test_a_bag_of_compressed_clouds_is_the_drive_of_the_plain_ones(tmp_path: Path, form: str) -> None:
    drive = open_drive(
        bag_of(tmp_path / "bag", {"/points/x": (form, FORMATS[form](POINTS.tobytes()))}, 3), sensor="hdl32e"
    )
    assert len(drive) == 3
    for scan in drive:
        assert np.array_equal(scan.points, POINTS)


def test_a_driver_that_sends_one_cloud_in_several_formats_is_one_lidar(tmp_path: Path) -> None:
    clouds = {"/points/draco": ("draco", b"DRACO"), "/points/zstd": ("zstd", zstd.compress(POINTS.tobytes()))}
    drive = open_drive(bag_of(tmp_path / "bag", clouds, 2), sensor="hdl32e")
    assert np.array_equal(drive.read_scan(0).points, POINTS)
    both = {"/points/zstd": COMPRESSED, "/points": CLOUD, "/rear/zlib": COMPRESSED, "/rear/zstd": COMPRESSED}
    assert one_of_each_cloud(both) == ["/points", "/rear/zstd"]


@pytest.mark.parametrize(
    ("form", "data", "said"),
    [
        ("draco", b"DRACO", r"compressed by draco: send zstd or zlib, or .*republish .*in_transport:=draco"),
        ("cloudini/v1", b"", r"compressed by cloudini/v1"),
        ("", b"", r"compressed by an unnamed method: .*in_transport:=FORMAT"),
        ("zstd", zstd.compress(POINTS.tobytes())[:-9], r"cut off|do not decompress"),
        ("zstd", b"no zstd at all", r"do not decompress by zstd"),
        ("zlib", gzip.compress(POINTS.tobytes(), mtime=0)[:100], r"cut off"),
        ("zlib", gzip.compress(bytes(10**7), mtime=0), r"more than 3600 bytes after zlib"),
        ("zstd", zstd.compress(bytes(10**7)), r"more than 3600 bytes after zstd"),
        ("zstd", b"", r"0 bytes after zstd|do not decompress"),
    ],
)
def test_a_cloud_that_cannot_be_read_says_why(form: str, data: bytes, said: str) -> None:
    with pytest.raises(MapvoteError, match=f"^/points: .*({said})"):
        point_cloud_table("/points", compressed(form, data))


def test_a_live_driver_that_sends_zstd_is_heard_and_one_that_sends_draco_alone_is_told_what_to_do() -> None:
    zstd_topic = PublishedTopic("/points/zstd", COMPRESSED, 1, True, False)
    draco = PublishedTopic("/points/draco", COMPRESSED, 1, True, False)
    assert lack_of_clouds([zstd_topic, draco], Wish(), 0) == ""
    assert lack_of_clouds([zstd_topic], Wish(("/points/zstd",)), 0) == ""
    for wish in (Wish(), Wish(("/points/draco",))):
        assert "compressed by draco: send zstd" in lack_of_clouds([draco], wish, 0)
    message = compressed("zstd", zstd.compress(POINTS.tobytes()))
    table = point_cloud_table("/points", from_cdr(COMPRESSED, to_cdr(COMPRESSED, message)))
    assert np.array_equal(np.column_stack([table[axis] for axis in "xyz"]), POINTS)
