"""What a vehicle hears on DDS: LiDARs joined by /tf_static, and what its first seconds refuse."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from live.loopback_dds import LOOPBACK, domain_of
from mapvote.config import Settings
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.point_map import map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, MapvoteError, Scan
from mapvote.live.cdr import blank_message, to_cdr
from mapvote.live.dds import Network, SentTopic
from mapvote.live.drive import OneMap
from mapvote.live.hearing import Chosen, Clocks, Cloud, Hearing, Sweeps, choose_topics, matrix_of
from mapvote.live.outbox import Outbox
from mapvote.live.play import POINTS, POSES, cloud_message, odometry_message, transform_message
from mapvote.live.service import Plan, run
from mapvote.live.topics import CLOUD, ODOMETRY, TF
from streets import drive_along, path, street

pytest.importorskip("cyclonedds")
START = 1_700_000_000 * 10**9
STEP = 100_000_000


def joined(*clouds: tuple[int, int], together: int = 1) -> list[list[tuple[int, int]]]:
    """The scans that (LiDAR, milliseconds) in the order of receipt make, of which so many arrive together."""
    sweeps, came = Sweeps(1 + max(lidar for lidar, _ in clouds)), [Cloud(k, ms * 10**6, 0, b"") for k, ms in clouds]
    made = [scan for k in range(0, len(came), together) for scan in sweeps.add(came[k : k + together])]
    return [[(c.lidar, c.stamp_ns // 10**6) for c in scan] for scan in made]


def test_clouds_of_one_revolution_are_one_scan_in_the_order_of_lidars() -> None:
    assert joined((1, 0), (0, 3), (0, 100), (1, 104)) == [[(0, 3), (1, 0)], [(0, 100), (1, 104)]]


def test_a_lidar_that_leaves_out_a_revolution_holds_no_other_back_for_longer() -> None:
    assert joined((0, 0), (1, 2), (0, 100), (0, 200), (1, 202)) == [
        [(0, 0), (1, 2)],
        [(0, 100)],
        [(0, 200), (1, 202)],
    ]


def test_clouds_of_several_revolutions_that_a_busy_process_reads_at_once_are_joined_as_ever() -> None:
    clouds = [(lidar, ms + 2 * lidar) for lidar in (0, 1) for ms in (0, 100, 200)]
    assert joined(*clouds, together=6) == [[(0, ms), (1, ms + 2)] for ms in (0, 100, 200)]


@pytest.mark.parametrize("damage", [{"w": 0.0}, {"x": np.nan}, {"w": np.inf}])
def test_a_pose_that_is_none_is_refused(damage: dict[str, float]) -> None:
    identity = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    zero = SimpleNamespace(x=0.0, y=0.0, z=0.0)
    assert np.array_equal(matrix_of(zero, SimpleNamespace(**identity)), np.eye(4))
    with pytest.raises(MapvoteError, match="quaternion of zeros"):
        matrix_of(zero, SimpleNamespace(**identity | damage))


def clocks_of(*came: tuple[str, float, float, float]) -> str:
    """What is wrong after (pose or cloud, sent, stamp, arrived), each in seconds."""
    clocks = Clocks()
    for what, sent_s, stamp_s, now_s in came:
        (clocks.pose if what == "pose" else clocks.cloud)(int(sent_s * 1e9), int(stamp_s * 1e9), now_s)
    return clocks.trouble()


def test_stamps_that_differ_by_more_than_a_second_are_of_two_clocks() -> None:
    said = clocks_of(("pose", 100.0, 105.0, 7.0), ("cloud", 100.0, 100.0, 7.0))
    assert "+5.0 s" in said
    assert "two clocks" in said


def test_what_a_busy_process_reads_late_is_of_one_clock() -> None:
    late = [("pose", 100.0 + k, 100.0 + k, 30.0) for k in range(9)]
    assert clocks_of(*late, ("cloud", 102.0, 102.0, 30.0)) == ""


def test_stamps_of_one_clock_are_that_though_the_clocks_of_the_senders_differ() -> None:
    assert clocks_of(("pose", 940.0, 100.0, 7.0), ("cloud", 100.0, 100.0, 7.1)) == ""


def test_odometry_that_ended_says_nothing_of_clocks() -> None:
    assert clocks_of(("pose", 100.0, 100.0, 7.0), ("cloud", 100.0, 100.0, 7.0), ("cloud", 104.0, 104.0, 11.0)) == ""


class Sender:
    """The other side of the network."""

    def __init__(self, test: str) -> None:
        self.domain = domain_of(test)
        self._network = Network(self.domain)
        self._out: dict[str, Any] = {}

    def send(self, topic: str, kind: str, data: bytes) -> None:
        if topic not in self._out:
            self._out[topic] = self._network.publish(topic, kind, transient_local=kind == TF)
        self._out[topic].send(data)

    def begin(self, *topics: tuple[str, str]) -> None:
        for topic, kind in topics:
            self._out[topic] = self._network.publish(topic, kind)

    def until_read(self) -> None:
        _until(lambda: all(out.readers for out in self._out.values()))


def _until(true: Callable[[], object]) -> None:
    end = time.monotonic() + 60.0
    while not true():
        assert time.monotonic() < end, "nothing came in a minute"
        time.sleep(0.02)


def frames(**T_base_lidar: F64) -> bytes:
    """A /tf_static of LiDARs on base_link."""
    return to_cdr(
        TF, blank_message(TF, transforms=[transform_message(0, "base_link", f, T) for f, T in T_base_lidar.items()])
    )


def test_two_lidars_are_one_scan_in_the_frame_of_the_first_by_tf_static(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    sender, world = Sender("lidars"), np.random.default_rng(1).uniform((4, 4, 0), (30, 30, 5), (500, 3))
    T = {"left": from_xyz_rpy(1.0, 0.7, 1.9, 0.0, 0.1, 0.4), "right": from_xyz_rpy(1.0, -0.7, 1.9, 0.0, 0.0, -1.2)}
    sender.begin(("/left", CLOUD), ("/right", CLOUD), (POSES, ODOMETRY))
    sender.send("/tf_static", TF, frames(**T))
    network = Network(sender.domain)
    chosen = choose_topics(network, ["/left", "/right"], None, 60.0, lambda: False)
    assert chosen is not None
    hearing, scans = Hearing(network, chosen, SENSORS["hdl32e"]), list[list[Cloud]]()
    sender.until_read()
    for lidar, T_base_lidar in T.items():
        seen = transform(inverse(T_base_lidar), world).astype(np.float32)
        sender.send(f"/{lidar}", CLOUD, cloud_message(Scan(START, seen), lidar))

    def is_joined() -> bool:
        scans.extend(hearing.scans())
        return bool(scans and hearing.mounts())

    _until(is_joined)
    scan = hearing.waiting(scans[0]).read()
    assert np.abs(transform(T["left"], scan.points) - np.concatenate([world, world])).max() < 1e-4
    ((start, origin),) = scan.others
    assert start == len(world)
    assert np.allclose(transform(T["left"], origin[None])[0], T["right"][:3, 3])


def test_a_drive_to_which_no_cloud_comes_ends_after_the_idle_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    chosen = Chosen((SentTopic(POINTS, CLOUD, 1, True, False),), None)
    hearing = Hearing(Network(domain_of("idle")), chosen, SENSORS["hdl32e"])
    outbox = Outbox(tmp_path / "state", "car", say=lambda _: None)
    maps = OneMap(map_from_points(street(1)))
    assert run(Plan("car", "day", Settings(), idle_s=0.2), hearing, maps, outbox, lambda: False) is None
    outbox.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("late_ns", "wider", "said"), [(5 * 10**9, 1.0, "two clocks"), (0, 2.5, "fits the map nowhere")]
)
def test_a_drive_whose_first_seconds_show_an_error_ends_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, late_ns: int, wider: float, said: str
) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    sender, poses = Sender(f"checks {late_ns} {wider}"), path(46, speed_mps=5.0)
    scans = list(drive_along(poses, 1))
    sender.begin((POINTS, CLOUD), (POSES, ODOMETRY))
    sender.send("/tf_static", TF, frames(lidar=np.eye(4)))
    network = Network(sender.domain)
    chosen = choose_topics(network, [], None, 60.0, lambda: False)
    assert chosen is not None
    hearing = Hearing(network, chosen, SENSORS["hdl32e"])
    sender.until_read()
    for i, (scan, T) in enumerate(zip(scans, poses, strict=True)):
        ns = START + i * STEP
        sender.send(POSES, ODOMETRY, odometry_message(ns + late_ns, T))
        sender.send(POINTS, CLOUD, cloud_message(Scan(ns, scan.points, scan.time_s)))
    (tmp_path / "out").mkdir()
    outbox = Outbox(tmp_path / "state", "car", folder=tmp_path / "out", say=lambda _: None)
    plan, maps = Plan("car", "day", Settings(), idle_s=1.0), OneMap(map_from_points(street(1) * [1.0, wider, 1.0]))
    with pytest.raises(MapvoteError, match=f"the first seconds: .*{said}"):
        run(plan, hearing, maps, outbox, lambda: False)
    outbox.close()
    assert not list((tmp_path / "out").iterdir())
    assert not list((tmp_path / "state/car").glob("*.journal"))
