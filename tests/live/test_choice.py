"""A vehicle that lacks something says what, what it hears instead, and what to type; and it takes what it needs."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from live.loopback_dds import until
from mapvote.config import Settings
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.sensors import SENSORS
from mapvote.core.types import MapvoteError, Scan
from mapvote.formats.drives.ros_types import CLOCK, CLOUD, GNSS, IMU, ODOMETRY, POSE, POSE_WITH_COVARIANCE, TF
from mapvote.live import choice
from mapvote.live.choice import Chosen, Voice, Waits, Wish, choose_topics
from mapvote.live.dds import Network, PublishedTopic
from mapvote.live.messages import blank_message, header_of, pose_of, to_cdr
from mapvote.live.names import RosNames, ros_names, sim_time_of
from mapvote.live.play import cloud_message, frames_message, odometry_message
from mapvote.live.service import Plan, prepare
from mapvote.live.subscriptions import Subscriptions

pytest.importorskip("cyclonedds")
IMPATIENT = Waits(first_word_s=0.3, each_s=0.6, settle_s=0.2, odometry_s=1.0)
POINTS = np.random.default_rng(1).uniform((4, 4, 0), (30, 30, 5), (50, 3)).astype(np.float32)
START = 1_700_000_000 * 10**9


class Said:
    """Sentences of the voice, and its end: after so many sentences, or seconds."""

    def __init__(self, sentences: int = 1) -> None:
        self.lines: list[str] = []
        self.voice = Voice(self.lines.append, IMPATIENT)
        self._sentences = sentences
        self._end_s = time.monotonic() + 20.0

    def __call__(self) -> bool:
        return len(self.lines) >= self._sentences or time.monotonic() > self._end_s


class Sender:
    """The other side of the network."""

    def __init__(self, domain: int, *topics: tuple[str, str]) -> None:
        network = Network(domain)
        self._out = {
            topic: network.publish(topic, kind, transient_local=topic.endswith("tf_static")) for topic, kind in topics
        }

    def send(self, topic: str, data: bytes) -> None:
        self._out[topic].send(data)


LIVOX = "diagnostic_msgs/msg/DiagnosticArray"
"""Stands for any type that is no cloud: which one is on the wire does not matter here."""


@pytest.mark.parametrize(
    ("sent", "wish", "said"),
    [
        ([], Wish(), ["no topic is sent in DDS domain", "ROS_DOMAIN_ID", "--domain N"]),
        ([("/imu", "sensor_msgs/msg/Imu")], Wish(), ["no sensor_msgs/msg/PointCloud2", "Heard: /imu"]),
        ([("/lidar/points", CLOUD)], Wish(("/lidar/point",)), ["nobody sends /lidar/point;", "--points /lidar/points"]),
        ([("/points", LIVOX)], Wish(("/points",)), ["/points is sent as diagnostic", "not read for --points"]),
        ([("/points", CLOUD), ("/odom", ODOMETRY)], Wish((), "/odon"), ["nobody sends /odon", "--odometry /odom"]),
        ([("/points", CLOUD)], Wish((), "/odom"), ["nobody sends /odom", "no nav_msgs/msg/Odometry at all"]),
        ([("/points", CLOUD)], Wish((), "/points"), ["not read for --odometry", "needed is nav_msgs"]),
        (
            [("/car2/points", CLOUD)],
            Wish(names=ros_names("/car1")),
            ["below /car1", "type --points /car2/points"],
        ),
        ([("/points", CLOUD)], Wish(), ["no nav_msgs/msg/Odometry or other pose", "begins without it"]),
        ([("/points", CLOUD), ("/tf", TF)], Wish(), ["begins with the frames that move on /tf", "--odometry /tf"]),
    ],
)
def test_a_missing_topic_is_named_soon_and_again_with_the_option_to_type(
    domain: int, sent: list[tuple[str, str]], wish: Wish, said: list[str]
) -> None:
    sender = Sender(domain, *sent)
    network = Network(domain)
    until(lambda: len(network.published()) == len(sent))
    ended = Said(2 if wish.odometry or not sent else 1)
    start = time.monotonic()
    chosen = choose_topics(network, wish, ended.voice, ended)
    assert ended.lines, "silence"
    assert time.monotonic() - start < 5.0
    for part in said:
        assert part in ended.lines[0]
    assert chosen is None
    del sender


def test_types_that_hold_points_but_are_not_read_have_a_hint() -> None:
    for kind, hint in (
        ("velodyne_msgs/msg/VelodyneScan", "velodyne_pointcloud"),
        ("ouster_sensor_msgs/msg/PacketMsg", "driver"),
    ):
        topic = PublishedTopic("/lidar", kind, 1, True, False)
        assert hint in choice.lack_of_clouds([topic], Wish(), 0)
        assert hint in choice.lack_of_clouds([topic], Wish(("/lidar",)), 0)


def test_a_second_lidar_that_appears_late_and_two_odometries_are_a_choice_to_make(domain: int) -> None:
    sender = Sender(domain, ("/left", CLOUD), ("/right", CLOUD), ("/a", ODOMETRY), ("/b", ODOMETRY))
    network = Network(domain)
    until(lambda: len(network.published()) == 4)
    ended = Said()
    with pytest.raises(MapvoteError, match=r"--points /left,/right"):
        choose_topics(network, Wish(), ended.voice, ended)
    with pytest.raises(MapvoteError, match=r"--odometry: /a, /b"):
        choose_topics(network, Wish(("/left",)), ended.voice, ended)
    chosen = choose_topics(network, Wish(("/right", "/left"), "/b"), ended.voice, ended)
    assert chosen is not None
    assert [one.topic for one in chosen.points] == ["/right", "/left"]
    assert chosen.odometry is not None
    assert chosen.odometry.topic == "/b"
    del sender


def test_an_odometry_is_preferred_to_other_poses_and_our_own_pose_is_none(domain: int) -> None:
    sender = Sender(
        domain, ("/points", CLOUD), ("/gnss", POSE), ("/mapvote/pose", POSE_WITH_COVARIANCE), ("/odom", ODOMETRY)
    )
    network = Network(domain)
    until(lambda: len(network.published()) == 4)
    chosen = choose_topics(network, Wish(), Said().voice, Said())
    assert chosen is not None
    assert chosen.odometry is not None
    assert chosen.odometry.topic == "/odom"
    del sender


def test_a_drive_begins_without_odometry_after_a_while(domain: int) -> None:
    sender = Sender(domain, ("/points", CLOUD))
    start = time.monotonic()
    chosen = choose_topics(Network(domain), Wish(), Said(9).voice, lambda: False)
    assert chosen is not None
    assert chosen.odometry is None
    assert 1.0 <= time.monotonic() - start < 5.0
    del sender


def test_moving_frames_are_taken_if_nothing_else_says_where_the_vehicle_is(domain: int) -> None:
    sender = Sender(domain, ("/points", CLOUD), ("/tf", TF))
    network = Network(domain)
    until(lambda: len(network.published()) == 2)
    chosen = choose_topics(network, Wish(), Said(9).voice, lambda: False)
    assert chosen is not None
    assert chosen.odometry is not None
    assert chosen.odometry.topic == "/tf"
    del sender


def topics_of(domain: int, odometry: str | None, kind: str = ODOMETRY, **more: Any) -> Subscriptions:
    points = (PublishedTopic("/points", CLOUD, 1, True, False),)
    pose = None if odometry is None else PublishedTopic(odometry, kind, 1, True, False)
    return Subscriptions(Network(domain), Chosen(points, pose), SENSORS["hdl32e"], **more)


def cloud(ns: int, frame: str = "lidar") -> bytes:
    return cloud_message(Scan(START + ns, POINTS), frame)


NO_POSE = to_cdr(ODOMETRY, blank_message(ODOMETRY, header=header_of(START, "odom")))
PLAN = Plan("car", "day", Settings())


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        ([], ["/points is announced but sends no cloud"]),
        ([("/points", cloud(0)), ("/odom", odometry_message(START, np.eye(4)))], ["no frames join lidar to base_link"]),
        ([("/points", cloud(0))], ["/odom is announced but sends nothing", "--odometry TOPIC"]),
        ([("/points", cloud(0)), ("/odom", NO_POSE)], ["/odom sends nothing that can be used", "quaternion of zeros"]),
    ],
)
def test_topics_that_are_there_but_send_nothing_of_use_are_said(
    domain: int, sent: list[tuple[str, bytes]], said: list[str]
) -> None:
    sender = Sender(domain, ("/points", CLOUD), ("/odom", ODOMETRY))
    topics = topics_of(domain, "/odom")
    until(lambda: topics._points[0].writers and topics._odometry[0].writers)
    for topic, data in sent:
        sender.send(topic, data)
    ended = Said()
    start = time.monotonic()
    prepare(topics, PLAN, ended, ended.voice)
    assert time.monotonic() - start < 5.0
    for part in said:
        assert part in ended.lines[0]


def test_frames_that_come_late_or_as_moving_ones_are_waited_for(domain: int) -> None:
    sender = Sender(domain, ("/points", CLOUD), ("/odom", ODOMETRY), ("/tf", TF))
    topics = topics_of(domain, "/odom")
    until(lambda: topics._points[0].writers and topics._odometry[0].writers and topics._tf.writers)
    sender.send("/points", cloud(0))
    sender.send("/odom", odometry_message(START, np.eye(4)))
    ended = Said()
    prepare(topics, PLAN, ended, ended.voice)
    assert topics.T_base_lidar() is None
    mount = from_xyz_rpy(1.0, 0.0, 1.8, 0.0, 0.0, 0.1)
    sender.send("/tf", frames_message(START, {"lidar": mount}))
    sender.send("/points", cloud(10**8))
    scans, poses = prepare(topics, PLAN, lambda: topics.T_base_lidar() is not None, Voice(print, IMPATIENT))
    found = topics.T_base_lidar()
    assert found is not None
    assert np.allclose(found, mount)
    del scans, poses


def test_fixed_frames_whose_sender_keeps_nothing_are_named_and_read_when_they_are_sent_again(domain: int) -> None:
    sender = Sender(domain, ("/points", CLOUD), ("/odom", ODOMETRY))
    frames = Network(domain).publish("/tf_static", TF)
    topics = topics_of(domain, "/odom")
    until(lambda: topics._points[0].writers and topics._odometry[0].writers and topics._tf_static[1].writers)
    sender.send("/points", cloud(0))
    sender.send("/odom", odometry_message(START, np.eye(4)))
    ended = Said()
    prepare(topics, PLAN, ended, ended.voice)
    assert "/tf_static is not sent as transient local" in ended.lines[0]
    frames.send(frames_message(0, {"lidar": from_xyz_rpy(1.0, 0.0, 1.8)}))
    until(lambda: topics.take_scans() or topics.T_base_lidar() is not None)


def heard_lidar(topics: Subscriptions, sender: Sender) -> None:
    """A cloud has arrived, and the frames."""
    until(lambda: topics._odometry[0].writers and topics._points[0].writers)
    sender.send("/points", cloud(0))
    until(lambda: topics.take_scans() or (topics.clouds and topics.frames.names))


def test_poses_come_from_stamped_poses_and_from_moving_frames_too(domain: int) -> None:
    mount = from_xyz_rpy(1.0, 0.0, 1.8, 0.0, 0.0, 0.1)
    T = from_xyz_rpy(10.0, 20.0, 0.5, 0.0, 0.0, 0.3)
    header = header_of(START, "map")
    plain = blank_message(POSE, header=header, pose=pose_of(T))
    with_covariance = blank_message(POSE_WITH_COVARIANCE, header=header)
    with_covariance.pose.pose = pose_of(T)
    for kind, message in ((POSE, plain), (POSE_WITH_COVARIANCE, with_covariance)):
        sender = Sender(domain, ("/pose", kind), ("/points", CLOUD), ("/tf_static", TF))
        topics = topics_of(domain, "/pose", kind)
        sender.send("/tf_static", frames_message(START, {"lidar": mount}))
        heard_lidar(topics, sender)
        sender.send("/pose", to_cdr(kind, message))
        (found,) = until(topics.take_poses)
        assert found[0] == START
        assert np.allclose(found[1], T)
        assert (topics.base_frame, topics.map_frame) == ("base_link", "map")
        assert np.allclose(topics.T_base_lidar(), mount)  # type: ignore[arg-type]
        del sender, topics


def frame_message(ns: int, parent: str, child: str, T: Any) -> bytes:
    """One moving frame."""
    pose = pose_of(T)
    transform = blank_message("geometry_msgs/msg/Transform", translation=pose.position, rotation=pose.orientation)
    stamped = blank_message(
        "geometry_msgs/msg/TransformStamped",
        header=header_of(START + ns, parent),
        child_frame_id=child,
        transform=transform,
    )
    return to_cdr(TF, blank_message(TF, transforms=[stamped]))


def test_the_body_that_carries_the_lidar_is_followed_in_the_top_frame(domain: int) -> None:
    mount = from_xyz_rpy(1.0, 0.0, 1.8, 0.0, 0.0, 0.1)
    T_map_odom = from_xyz_rpy(100.0, 50.0, 0.0, 0.0, 0.0, 0.6)
    T_odom_base = from_xyz_rpy(3.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    sender = Sender(domain, ("/tf", TF), ("/points", CLOUD), ("/tf_static", TF))
    topics = topics_of(domain, "/tf", TF)
    sender.send("/tf_static", frames_message(START, {"lidar": mount}))
    heard_lidar(topics, sender)
    sender.send("/tf", frame_message(0, "odom", "base_link", T_odom_base))
    (first,) = until(topics.take_poses)
    assert topics.map_frame == "odom"
    assert np.allclose(first[1], T_odom_base)
    sender.send("/tf", frame_message(1, "map", "odom", T_map_odom))
    sender.send("/tf", frame_message(2, "base_link", "wheel", np.eye(4)))
    sender.send("/tf", frame_message(3, "odom", "base_link", T_odom_base))
    (second,) = until(topics.take_poses)
    assert (topics.map_frame, topics.base_frame, second[0]) == ("map", "base_link", START + 3)
    assert np.allclose(second[1], T_map_odom @ T_odom_base)


def test_sim_time_is_that_of_the_clock(domain: int) -> None:
    sender = Sender(domain, ("/clock", CLOCK))
    topics = topics_of(domain, None, sim_time=True)
    assert topics.now_ns() == 0
    until(lambda: topics._clock.writers)
    time_message = blank_message("builtin_interfaces/msg/Time", sec=5, nanosec=7)
    sender.send("/clock", to_cdr(CLOCK, blank_message(CLOCK, clock=time_message)))
    assert until(topics.now_ns) == 5_000_000_007
    assert abs(topics_of(domain, None).now_ns() - time.time_ns()) < 10**9


def test_names_are_resolved_as_ros_2_does() -> None:
    plain, car = RosNames(), ros_names("car1/")
    assert (plain.resolve("points"), plain.resolve("/points")) == ("/points", "/points")
    assert (car.resolve("points"), car.resolve("/points")) == ("/car1/points", "/points")
    remapped = ros_names(remaps=["__ns:=/car1", "/tf:=tf", "points:=/lidar", "a/b:=c"])
    assert [remapped.resolve(name) for name in ("/tf", "points", "a/b", "tf_static")] == [
        "/car1/tf",
        "/lidar",
        "/car1/c",
        "/car1/tf_static",
    ]
    assert remapped.named("points", None) == ("/lidar",)
    assert remapped.named("odometry", None) == ()
    assert remapped.named("points", "left, /right") == ("/car1/left", "/right")
    assert car.holds("/car1/points")
    assert not car.holds("/car10/points")
    for wrong in ("a=b", ":=b", "a:=", "__node:=x", "a:=b c", "1a:=b", "a:=/b/"):
        with pytest.raises(MapvoteError):
            ros_names(remaps=[wrong])
    assert [sim_time_of(given) for given in ([], ["use_sim_time:=true"], ["use_sim_time:=false"])] == [0, 1, 0]
    with pytest.raises(MapvoteError, match="use_sim_time:=true"):
        sim_time_of(["use_sim_time:=yes"])


def test_frames_of_a_namespace_are_taken_where_somebody_sends_them(domain: int) -> None:
    names = ros_names("/car1")
    assert topics_of(domain, None, names=names).tf_static == "/tf_static"
    sender = Sender(domain, ("/car1/tf_static", TF))
    network = Network(domain)
    until(network.published)
    assert until(lambda: topics_of(domain, None, names=names).tf_static == "/car1/tf_static")
    remapped = ros_names("/car1", ["/tf_static:=/fixed"])
    assert topics_of(domain, None, names=remapped).tf_static == "/fixed"
    del sender


def test_the_page_of_the_voice_says_nothing_while_nothing_lacks(tmp_path: Path) -> None:
    lines: list[str] = []
    voice = Voice(lines.append, Waits(first_word_s=0.0, each_s=0.0))
    voice.lacks("")
    assert lines == []
    voice.lacks("a LiDAR")
    assert lines == ["waiting: a LiDAR"]


@pytest.mark.parametrize("on_earth", [True, False])
def test_fixes_are_taken_if_no_pose_is_sent_and_the_map_has_a_place_on_earth(domain: int, on_earth: bool) -> None:
    sender = Sender(domain, ("/points", CLOUD), ("/fix", GNSS), ("/imu", IMU))
    network = Network(domain)
    until(lambda: len(network.published()) == 3)
    said = Said(9)
    chosen = choose_topics(network, Wish(on_earth=on_earth), said.voice, lambda: False)
    assert chosen is not None
    if on_earth:
        assert chosen.odometry is not None
        assert chosen.imu is not None
        assert (chosen.odometry.topic, chosen.imu.topic) == ("/fix", "/imu")
        assert "begins with the fixes of /fix" in said.lines[0]
    else:
        assert (chosen.odometry, chosen.imu) == (None, None)
        assert "begins without it" in said.lines[0]
    del sender
