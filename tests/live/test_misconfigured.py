"""Ways to misconfigure a drive: each is told within ten seconds, in words that name it, by the waits of the product."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from mapvote.config import Settings
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F32, MapvoteError, Scan
from mapvote.formats.drives.ros_types import CLOUD, GNSS, IMU, ODOMETRY, TF
from mapvote.formats.geo.frame import MapFrame
from mapvote.live.choice import Voice, Wish, choose_topics
from mapvote.live.dds import Network
from mapvote.live.messages import blank_message, header_of, to_cdr
from mapvote.live.names import ros_names
from mapvote.live.outbox import Outbox
from mapvote.live.play import cloud_message, frames_message, odometry_message
from mapvote.live.road_map import OneMap
from mapvote.live.service import Plan, run
from mapvote.live.subscriptions import Subscriptions
from mapvote.warmup import warm_vehicle
from receiver_messages import fix_message
from streets import drive_along, path, street

pytest.importorskip("cyclonedds")
LONGEST_S = 10.0
"""Silence that the owner of a vehicle may meet."""
UTM = MapFrame("EPSG:32632", (457_000.0, 5_428_000.0, 0.0))
POINTS = np.random.default_rng(1).uniform((4, 4, 0), (30, 30, 5), (3000, 3)).astype(np.float32)
Send = Callable[[int, int], dict[str, bytes]]
"""Messages of the n-th tenth of a second, at a stamp: messages by topic."""


@dataclass
class Heard:
    """The sentences that a drive says, and when."""

    wanted: str
    start_s: float = field(default_factory=time.monotonic)
    sentences: list[tuple[float, str]] = field(default_factory=list)

    def say(self, text: str) -> None:
        self.sentences.append((time.monotonic() - self.start_s, text))

    def ended(self) -> bool:
        return any(self.wanted in text for _, text in self.sentences) or time.monotonic() > self.start_s + 40.0


class LogTo(logging.Handler):
    """Hands warnings on."""

    def __init__(self, say: Callable[[str], None]) -> None:
        super().__init__(logging.WARNING)
        self._say = say

    def emit(self, record: logging.LogRecord) -> None:
        self._say(record.getMessage())


@contextmanager
def sending(domain: int, topics: dict[str, str], send: Send) -> Iterator[None]:
    """The other side of the network: ten times a second."""
    network = Network(domain)
    out = {topic: network.publish(topic, kind, transient_local=kind == TF) for topic, kind in topics.items()}
    stopped = threading.Event()

    def loop() -> None:
        n = 0
        while not stopped.wait(0.1):
            for topic, data in send(n, time.time_ns()).items():
                out[topic].send(data)
            n += 1

    thread = threading.Thread(target=loop)
    thread.start()
    yield
    stopped.set()
    thread.join()


@cache
def roads() -> dict[str, PointMap]:
    return {"this road": map_from_points(street(1)), "another road": map_from_points(street(2) * [1.0, 2.5, 1.0])}


@cache
def scans() -> list[F32]:
    return [scan.points for scan in drive_along(path(100, start_x=-40.0, speed_mps=5.0), 1)]


def cloud(n: int, ns: int, frame: str = "lidar") -> bytes:
    return cloud_message(Scan(ns, POINTS), frame)


def driven(n: int, ns: int) -> bytes:
    return cloud_message(Scan(ns, scans()[n % 100]), "base_link")


def pose(n: int, ns: int) -> bytes:
    return odometry_message(ns, path(100, start_x=-40.0, speed_mps=5.0)[n % 100])


def no_pose(n: int, ns: int) -> bytes:
    return to_cdr(ODOMETRY, blank_message(ODOMETRY, header=header_of(ns, "odom")))


CLOUDS_AND_POSES = {"/points": CLOUD, "/odom": ODOMETRY}
MOUNT = frames_message(0, {"lidar": from_xyz_rpy(1.0, 0.0, 1.8)})


@dataclass(frozen=True)
class Fault:
    """One way to misconfigure a drive."""

    said: str
    """Part of the sentence that must be heard."""
    topics: dict[str, str] = field(default_factory=dict)
    send: Send = lambda n, ns: {}
    wish: Wish = field(default_factory=Wish)
    road: str = "this road"


FAULTS = {
    "nobody sends, or in another domain": Fault("ROS_DOMAIN_ID"),
    "no LiDAR": Fault("no sensor_msgs/msg/PointCloud2", {"/odom": ODOMETRY}, lambda n, ns: {"/odom": pose(n, ns)}),
    "--points mistyped": Fault(
        "--points /points", {"/points": CLOUD}, lambda n, ns: {"/points": cloud(n, ns)}, Wish(("/point",))
    ),
    "--odometry mistyped": Fault(
        "--odometry /odom",
        CLOUDS_AND_POSES,
        lambda n, ns: {"/points": cloud(n, ns), "/odom": pose(n, ns)},
        Wish((), "/odon"),
    ),
    "--points of no cloud": Fault("not read for --points", {"/imu": IMU}, lambda n, ns: {}, Wish(("/imu",))),
    "another namespace": Fault(
        "below /car1",
        {"/car2/points": CLOUD},
        lambda n, ns: {"/car2/points": cloud(n, ns)},
        Wish(names=ros_names("/car1")),
    ),
    "the LiDAR is off": Fault("is the LiDAR on", {"/points": CLOUD}),
    "odometry is not started": Fault(
        "/odom is announced but sends nothing",
        CLOUDS_AND_POSES | {"/tf_static": TF},
        lambda n, ns: {"/points": cloud(n, ns), "/tf_static": MOUNT},
    ),
    "odometry sends quaternions of zeros": Fault(
        "quaternion of zeros", CLOUDS_AND_POSES, lambda n, ns: {"/points": cloud(n, ns), "/odom": no_pose(n, ns)}
    ),
    "no frames": Fault(
        "no frames join lidar to base_link",
        CLOUDS_AND_POSES,
        lambda n, ns: {"/points": cloud(n, ns), "/odom": pose(n, ns)},
    ),
    "a second LiDAR without a frame": Fault(
        "no frames join right to left",
        {"/left": CLOUD, "/right": CLOUD, "/odom": ODOMETRY},
        lambda n, ns: {"/left": cloud(n, ns, "left"), "/right": cloud(n, ns, "right"), "/odom": pose(n, ns)},
        Wish(("/left", "/right")),
    ),
    "odometry by another clock": Fault(
        "two clocks",
        CLOUDS_AND_POSES,
        lambda n, ns: {"/points": driven(n, ns), "/odom": pose(n, ns + 5 * 10**9)},
    ),
    "the map of another road": Fault(
        "is this the map of this road",
        CLOUDS_AND_POSES,
        lambda n, ns: {"/points": driven(n, ns), "/odom": pose(n, ns)},
        road="another road",
    ),
    "satellite fixes and a map without a place on Earth": Fault(
        "--crs",
        {"/points": CLOUD, "/fix": GNSS},
        lambda n, ns: {
            "/points": driven(n, ns),
            "/fix": fix_message(ns, UTM.to_lonlat(np.array([[0.5 * n, 0.0, 0.0]]))[0], 2.0),
        },
        Wish(on_earth=False),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS, ids=str)
def test_each_misconfiguration_is_told_within_ten_seconds(tmp_path: Path, domain: int, name: str) -> None:
    fault = FAULTS[name]
    scans()
    point_map = roads()[fault.road]
    warm_vehicle(Settings())
    (tmp_path / "out").mkdir()
    outbox = Outbox(tmp_path / "state", "car", folder=tmp_path / "out", say=lambda _: None)
    log = logging.getLogger("mapvote.live")
    with sending(domain, fault.topics, fault.send):
        heard = Heard(fault.said)
        handler = LogTo(heard.say)
        log.addHandler(handler)
        voice = Voice(heard.say)
        try:
            chosen = choose_topics(Network(domain), fault.wish, voice, heard.ended)
            if chosen is not None:
                topics = Subscriptions(Network(domain), chosen, SENSORS["hdl32e"])
                run(Plan("car", "day", Settings()), topics, OneMap(point_map), outbox, heard.ended, voice=voice)
        except MapvoteError as error:
            heard.say(str(error))
        finally:
            log.removeHandler(handler)
            outbox.close()
    told = [seconds for seconds, text in heard.sentences if fault.said in text]
    print(f"{name}: {heard.sentences}")
    assert told, heard.sentences
    assert told[0] < LONGEST_S
