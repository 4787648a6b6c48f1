"""The doctor looks at a bag (topics and rates, clocks, whether /tf_static joins poses and LiDAR), a ballot, a store."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import sqlalchemy as sa

from bag_recorder import START, Recorder
from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.codec.ballot import encode
from mapvote.core import geometry
from mapvote.core.types import F64, CellState
from mapvote.doctor.bags import check_bag
from mapvote.doctor.diagnosis import check_ballot
from mapvote.formats.drives.options import drive_options, mount_of
from mapvote_server.store import schema
from mapvote_server.store.keys import issue
from mapvote_server.store.store import Store
from mapvote_server.stores import check_store

T_BASE_LIDAR = geometry.from_xyz_rpy(1.2, 0.0, 1.8, 0.01, 0.02, np.pi / 2)
SAME, GONE = int(CellState.UNCHANGED_OCCUPIED), int(CellState.CHANGED_EMPTY)


def told_of_bag(
    path: Path, *, T: F64 | None = T_BASE_LIDAR, poses_later_s: float = 0.0, tick_ns: int = 10**8, **said: Any
) -> str:
    """Findings on a bag of six clouds of /points, odometry at 50 Hz, and the LiDAR's mount."""
    recorder = Recorder(path)
    if T is not None:
        recorder.static({"lidar": T})
    kind, g, t = "nav_msgs/msg/Odometry", "geometry_msgs/msg/", recorder.types
    pose = t[g + "Pose"](t[g + "Point"](0.0, 0.0, 0.0), t[g + "Quaternion"](0.0, 0.0, 0.0, 1.0))
    zero = t[g + "Vector3"](0.0, 0.0, 0.0)
    twist = t[g + "TwistWithCovariance"](t[g + "Twist"](zero, zero), np.zeros(36))
    for i in range(-2, 30):
        ns = START + i * 2 * 10**7 + int(poses_later_s * 1e9)
        known = t[g + "PoseWithCovariance"](pose, np.zeros(36))
        recorder.write("/odom", kind, ns, t[kind](recorder.header(ns, "map"), "base_link", known, twist))
    for i in range(6):
        recorder.cloud("/points", "lidar", START + i * tick_ns, np.eye(3))
    recorder.bag.close()
    return " | ".join(f"{f.severity}: {f.what} -> {f.mend}" for f in check_bag(path, **said))


def test_topics_rates_and_the_mount_are_told(tmp_path: Path) -> None:
    said = told_of_bag(tmp_path / "b")
    assert "/points: 6 messages of sensor_msgs/msg/PointCloud2, 10.0 Hz" in said
    assert "other topics: /tf_static (1)" in said
    assert "warning: no prior is chosen, but there are poses: /odom -> --prior /odom" in said
    assert "-> --mount 1.200,0.000,1.800,0.573,1.146,90.000" in said
    mount = said.split("--mount ")[1].split()[0]
    assert pytest.approx(T_BASE_LIDAR, abs=1e-3) == mount_of(drive_options(tmp_path, mount=mount), None, "here")
    assert "warning" not in told_of_bag(tmp_path / "c", prior="/odom", mount="1,0,0,0,0,0")


@pytest.mark.parametrize(
    ("how", "name"),
    [
        ({"T": None}, "warning: /odom tracks base_link, the scans are of lidar; /tf_static holds no"),
        ({"poses_later_s": 60.0}, "error: /odom has no pose at the time of 100% of the scans"),
        ({"tick_ns": 0}, "warning: /points has 5 stamps that an earlier message has too"),
    ],
)
def test_faults_of_a_bag_are_named(tmp_path: Path, how: dict[str, Any], name: str) -> None:
    assert name in told_of_bag(tmp_path / "b", **how)


def test_a_bag_cut_off_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"\x89MCAP0\r\n")
    assert [f.severity for f in check_bag(tmp_path / "x.mcap")] == ["error"]


def told(fill: int = SAME, **said: Any) -> list[str]:
    ballot = make_ballot(two_walls(), {(0, 0): Say(states_plane({(3, 4): GONE}, fill=fill))})
    return [f.what for f in check_ballot(encode(msgspec.structs.replace(ballot, **said)))]


def test_a_sound_ballot_is_not_blamed() -> None:
    assert told() == []


@pytest.mark.parametrize(
    ("said", "name"),
    [
        ({"end_ns": 0}, "its drive ends before it begins"),
        ({"scans_localised": 3}, "only 3 of 10 scans were localised"),
        ({"median_sigma_m": 0.4}, "the sigma of the vehicle's position was 0.40 m"),
        ({"prior_misfit_m": 2.0, "prior_sigma_m": 0.1}, "2.0 m off the localised path"),
        ({"tiles": []}, "votes on no tile"),
        ({"fill": GONE}, "judges changed"),
    ],
)
def test_faults_of_a_ballot_are_named(said: dict[str, Any], name: str) -> None:
    assert any(name in what for what in told(**said)), told(**said)


def test_a_ballot_cut_off_is_an_error() -> None:
    data = encode(make_ballot(two_walls(), {(0, 0): Say(states_plane())}))
    assert [f.severity for f in check_ballot(data[:-9])] == ["error"]


def test_a_store_is_read_to_the_last_byte(tmp_path: Path) -> None:
    store = Store.create(f"sqlite:///{tmp_path}/s.db", two_walls())
    try:
        assert any("no operator has a valid key" in f.what for f in check_store(store))
        issue(store, "boss", "operator")
        found = check_store(store)
        assert not [f for f in found if f.severity == "error"]
        assert any("version 1: 2 tiles, 0 ballots" in f.what for f in found)
        with store.database.writing() as connection:
            connection.execute(sa.update(schema.blobs).values(data=b"damaged"))
        errors = [f for f in check_store(store) if f.severity == "error"]
        assert any("damaged: plane" in f.what for f in errors)
        assert all("mapvote check STORE --mend" in f.mend for f in errors[:3])
    finally:
        store.close()
