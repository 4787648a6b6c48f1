"""The doctor looks at a bag: topics and rates, clocks, and whether /tf_static joins poses and LiDAR."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bag_recorder import START, Recorder
from mapvote.core import geometry
from mapvote.core.types import F64
from mapvote.doctor import Finding
from mapvote.doctor.diagnosis import check_bag

T_BASE_LIDAR = geometry.from_xyz_rpy(1.2, 0.0, 1.8, 0.01, 0.02, np.pi / 2)


def bag(path: Path, *, T: F64 | None = T_BASE_LIDAR, poses_later_s: float = 0.0, tick_ns: int = 10**8) -> Path:
    recorder = Recorder(path)
    if T is not None:
        recorder.static({"lidar": T})
    odometry(recorder, poses_later_s)
    for i in range(6):
        recorder.cloud("/points", "lidar", START + i * tick_ns, np.eye(3))
    recorder.bag.close()
    return path


def odometry(recorder: Recorder, later_s: float) -> None:
    kind, g = "nav_msgs/msg/Odometry", "geometry_msgs/msg/"
    t: dict[str, Any] = recorder.types
    pose = t[g + "Pose"](t[g + "Point"](0.0, 0.0, 0.0), t[g + "Quaternion"](0.0, 0.0, 0.0, 1.0))
    zero = t[g + "Vector3"](0.0, 0.0, 0.0)
    twist = t[g + "TwistWithCovariance"](t[g + "Twist"](zero, zero), np.zeros(36))
    for i in range(-2, 30):
        ns = START + i * 2 * 10**7 + int(later_s * 1e9)
        said = t[g + "PoseWithCovariance"](pose, np.zeros(36))
        recorder.write("/odom", kind, ns, t[kind](recorder.header(ns, "map"), "base_link", said, twist))


def told(found: list[Finding]) -> str:
    return " | ".join(f"{f.severity}: {f.what} -> {f.mend}" for f in found)


def test_topics_rates_and_the_mount_are_told(tmp_path: Path) -> None:
    said = told(check_bag(bag(tmp_path / "b")))
    assert "/points: 6 messages of sensor_msgs/msg/PointCloud2, 10.0 Hz" in said
    assert "other topics: /tf_static (1)" in said
    assert "warning: no prior is chosen, but there are poses: /odom -> --prior /odom" in said
    assert "-> --mount 1.200,0.000,1.800,0.573,1.146,90.000" in said
    assert "warning" not in told(check_bag(tmp_path / "b", prior="/odom", mount="1,0,0,0,0,0"))


def test_the_mount_that_is_told_is_the_one_that_was_written(tmp_path: Path) -> None:
    from mapvote.formats.drives.options import drive_options, mount_of

    said = told(check_bag(bag(tmp_path / "b")))
    mount = said.split("--mount ")[1].split()[0]
    T = mount_of(drive_options(tmp_path / "b", mount=mount), None, "here")
    assert pytest.approx(T_BASE_LIDAR, abs=1e-3) == T


@pytest.mark.parametrize(
    ("how", "name"),
    [
        ({"T": None}, "warning: /odom tracks base_link, the scans are of lidar; nothing in /tf_static says"),
        ({"poses_later_s": 60.0}, "error: /odom has no pose at the time of 100% of the scans"),
        ({"tick_ns": 0}, "error: /points: stamps do not go forward, 5 times"),
    ],
)
def test_what_is_wrong_with_a_bag_is_named(tmp_path: Path, how: dict[str, Any], name: str) -> None:
    assert name in told(check_bag(bag(tmp_path / "b", **how)))


def test_a_bag_cut_off_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"\x89MCAP0\r\n")
    assert [f.severity for f in check_bag(tmp_path / "x.mcap")] == ["error"]
