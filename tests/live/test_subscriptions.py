"""Messages that a vehicle receives over DDS: LiDARs joined by /tf_static, and what its first seconds refuse."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drive_formats import livox_message
from live.loopback_dds import until
from mapvote.codec.planes import zstd
from mapvote.config import Settings
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.point_map import map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import MapvoteError, Scan
from mapvote.formats.drives.frames import matrix_of
from mapvote.formats.drives.packets import direction_of
from mapvote.formats.drives.point_fields import point_cloud_table
from mapvote.formats.drives.point_times import TimeRules
from mapvote.formats.drives.ros_types import CLOUD, COMPRESSED, LIVOX, ODOMETRY, TF
from mapvote.live.choice import WAITS, Chosen, Voice, Waits, Wish, choose_topics, missing_for_drive
from mapvote.live.dds import Network, PublishedTopic, TopicRate
from mapvote.live.messages import blank_message, cloud_of, from_cdr, to_cdr
from mapvote.live.outbox import Outbox
from mapvote.live.play import POINTS, POSES, cloud_message, frames_message, odometry_message
from mapvote.live.road_map import OneMap
from mapvote.live.service import Plan, run
from mapvote.live.subscriptions import Clocks, Headers, Subscriptions
from mapvote.live.sweeps import Cloud, Revolutions, Sweeps
from streets import drive_along, path, street

pytest.importorskip("cyclonedds")
START = 1_700_000_000 * 10**9
STEP = 100_000_000


def joined(*clouds: tuple[int, int], together: int = 1) -> list[list[tuple[int, int]]]:
    """The scans that (LiDAR, milliseconds) in the order of receipt make, of which so many arrive together."""
    sweeps, came = Sweeps(1 + max(lidar for lidar, _ in clouds)), [Cloud(k, ms * 10**6, 0, b"") for k, ms in clouds]
    made = [scan for k in range(0, len(came), together) for scan in sweeps.add(came[k : k + together])]
    return [[(c.lidar, c.stamp_ns // 10**6) for c in scan] for scan in made]


def test_clouds_of_one_revolution_are_one_scan_in_the_order_of_lidars_however_they_arrive() -> None:
    assert joined((1, 0), (0, 3), (0, 100), (1, 104)) == [[(0, 3), (1, 0)], [(0, 100), (1, 104)]]
    left_out = (0, 0), (1, 2), (0, 100), (0, 200), (1, 202)
    assert joined(*left_out) == [[(0, 0), (1, 2)], [(0, 100)], [(0, 200), (1, 202)]], "it holds no other back"
    clouds = [(lidar, ms + 2 * lidar) for lidar in (0, 1) for ms in (0, 100, 200)]
    assert joined(*clouds, together=6) == [[(0, ms), (1, ms + 2)] for ms in (0, 100, 200)], "by a busy process"


def sector(start_deg: float, width_deg: float, ns: int, seed: int = 0) -> Cloud:
    """A cloud of points between two azimuths, counter-clockwise from the first."""
    azimuth = np.radians(start_deg + width_deg * np.linspace(0.0, 1.0, 400))
    r = np.random.default_rng(seed).uniform(5.0, 30.0, 400)
    points = np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), np.ones(400)]).astype(np.float32)
    return Cloud(0, ns, ns, from_cdr(CLOUD, cloud_message(Scan(ns, points))))


@pytest.mark.parametrize(("start_deg", "step_deg"), [(0.0, 36.0), (170.0, -36.0), (-90.0, 72.0), (11.0, 20.0)])
def test_packets_of_a_part_of_a_revolution_are_joined_to_whole_ones(start_deg: float, step_deg: float) -> None:
    packets, per_turn = Revolutions(), round(360.0 / abs(step_deg))
    out = []
    for k in range(5 * per_turn):
        width = abs(step_deg)
        begin = start_deg + k * step_deg - (width if step_deg < 0 else 0.0)
        out += packets.add(sector(begin, width, k * 10**7))
    assert packets._packets.is_packets
    assert [len(scan.packets) for scan in out] == [per_turn] * 4
    assert [scan.stamp_ns for scan in out] == [n * per_turn * 10**7 for n in range(4)]


def test_clouds_that_wait_for_the_decision_are_released_after_a_pause() -> None:
    packets = Revolutions()
    first = sector(0.0, 90.0, 0)
    assert packets.add(first, 5.0) == []
    assert packets.after_pause(5.2) == []
    assert packets.after_pause(5.4) == [first]
    assert packets.after_pause(9.0) == []


def test_lost_packets_cost_their_points_and_no_revolution() -> None:
    packets = Revolutions()
    out = [s for k in range(60) if k not in (23, 24, 41) for s in packets.add(sector(36.0 * k, 36.0, k * 10**7))]
    assert [len(scan.packets) for scan in out] == [10, 10, 8, 10, 9]


@pytest.mark.parametrize(("start_deg", "width_deg"), [(0.0, 360.0), (-60.0, 120.0), (-35.0, 70.0)])
def test_whole_revolutions_and_lidars_that_look_ahead_are_no_packets(start_deg: float, width_deg: float) -> None:
    packets = Revolutions()
    clouds = [sector(start_deg, width_deg, k * 10**8, k) for k in range(12)]
    out = [one for cloud in clouds for one in packets.add(cloud)]
    assert (packets._packets.is_packets, out) == (False, clouds)
    middle, coverage = direction_of(point_cloud_table("a cloud", clouds[0].message))
    assert coverage == pytest.approx(width_deg / 360.0, abs=0.06)
    assert width_deg == 360.0 or abs(middle) < 0.05


def test_clouds_compressed_by_zstd_arrive_as_scans(domain: int) -> None:
    sender = Network(domain).publish("/points/zstd", COMPRESSED)
    topics = Subscriptions(
        Network(domain), Chosen((PublishedTopic("/points/zstd", COMPRESSED, 1, True, False),), None), SENSORS["hdl32e"]
    )
    until(lambda: sender.readers == 1)
    points = np.random.default_rng(0).uniform(5, 30, (200, 3)).astype("<f4")
    plain = vars(cloud_of({axis: points[:, k] for k, axis in enumerate("xyz")}, START, "lidar"))
    members = {name: value for name, value in plain.items() if name not in ("data", "__msgtype__")}
    data = np.frombuffer(zstd.compress(points.tobytes()), np.uint8)
    sender.send(to_cdr(COMPRESSED, blank_message(COMPRESSED, **members, compressed_data=data, format="zstd")))
    scans: list[list[Cloud]] = []

    def arrived() -> bool:
        scans.extend(topics.take_scans())
        return bool(scans)

    until(arrived)
    assert np.array_equal(topics.waiting(scans[0]).read().points, points)


def test_the_scan_of_packets_has_all_points_at_the_times_at_which_they_were_measured(domain: int) -> None:
    chosen = Chosen((PublishedTopic(POINTS, CLOUD, 1, True, False),), None)
    topics = Subscriptions(Network(domain), chosen, SENSORS["hdl32e"])
    azimuth = np.linspace(0.0, 2 * np.pi, 3600, endpoint=False)
    points = np.column_stack([9 * np.cos(azimuth), 9 * np.sin(azimuth), np.ones(3600)]).astype(np.float32)
    time_s = np.linspace(0.0, 0.1, 3600, endpoint=False).astype(np.float32)
    parts = []
    for part in np.array_split(np.arange(3600), 10):
        ns = START + round(1e9 * float(time_s[part[0]]))
        message = cloud_message(Scan(ns, points[part], time_s[part] - time_s[part[0]]))
        parts.append(Cloud(0, ns, ns, from_cdr(CLOUD, message)))
    scan = topics._scan_of(Cloud(0, START, START, parts[0].message, tuple(parts)), SENSORS["hdl32e"])
    assert np.array_equal(scan.points, points)
    assert scan.time_s is not None
    assert np.abs(scan.time_s - time_s).max() < 1e-6
    assert scan.others == ()


@pytest.mark.parametrize("damage", [{"w": 0.0}, {"x": np.nan}, {"w": np.inf}])
def test_a_pose_that_is_none_is_refused(damage: dict[str, float]) -> None:
    identity = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    zero = SimpleNamespace(x=0.0, y=0.0, z=0.0)
    assert np.array_equal(matrix_of(zero, SimpleNamespace(**identity)), np.eye(4))
    with pytest.raises(MapvoteError, match="quaternion of zeros"):
        matrix_of(zero, SimpleNamespace(**identity | damage))


def test_a_topic_without_stamps_has_its_times_of_sending_and_one_lidar(caplog: pytest.LogCaptureFixture) -> None:
    headers = Headers("/points")
    assert [headers.stamp_ns(0, sent) for sent in (7, 8)] == [7, 8]
    assert caplog.text.count("/points has no stamps in its headers") == 1
    assert headers.stamp_ns(START, 9) == START
    with pytest.raises(MapvoteError, match="its stamp is 0"):
        headers.stamp_ns(0, 10)
    headers.check_frame("front")
    headers.check_frame("front")
    with pytest.raises(MapvoteError, match="/points sends clouds in frame front and in frame rear: two LiDARs"):
        headers.check_frame("rear")


LATE_POSES = [("pose", 100.0 + k, 100.0 + k, 30.0) for k in range(9)]


@pytest.mark.parametrize(
    ("came", "wrong"),
    [
        ([("pose", 100.0, 105.0, 7.0), ("cloud", 100.0, 100.0, 7.0)], True),
        pytest.param([*LATE_POSES, ("cloud", 102.0, 102.0, 30.0)], False, id="read late by a busy process"),
        pytest.param([("pose", 940.0, 100.0, 7.0), ("cloud", 100.0, 100.0, 7.1)], False, id="senders' clocks differ"),
        pytest.param([("pose", 100, 100, 7), ("cloud", 100, 100, 7), ("cloud", 104, 104, 11)], False, id="poses ended"),
    ],
)
def test_stamps_of_two_clocks_are_those_that_differ_by_sending_and_by_arrival(came: Any, wrong: bool) -> None:
    clocks = Clocks()
    for what, sent_s, stamp_s, now_s in came:  # seconds
        (clocks.pose if what == "pose" else clocks.cloud)(int(sent_s * 1e9), int(stamp_s * 1e9), now_s)
    assert ("+5.0 s" in clocks.trouble()) == wrong == ("two clocks" in clocks.trouble())


def rate(topic: str, kind: str, messages: int = 9) -> TopicRate:
    return TopicRate(PublishedTopic(topic, kind, 1, True, kind == TF), messages, messages / 5.0, "")


VEHICLE = [rate("/points", CLOUD), rate("/odom", ODOMETRY), rate("/tf_static", TF, 1)]


def test_each_topic_that_a_drive_needs_and_does_not_receive_has_a_sentence_of_its_own() -> None:
    assert missing_for_drive(VEHICLE) == []
    for absent, named in enumerate((CLOUD, ODOMETRY, "/tf_static")):
        (sentence,) = missing_for_drive([one for k, one in enumerate(VEHICLE) if k != absent])
        assert named in sentence
    (sentence,) = missing_for_drive([rate("/points", CLOUD, 0), *VEHICLE[1:]])  # offered, but nothing is sent
    assert CLOUD in sentence
    (sentence,) = missing_for_drive([*VEHICLE[:2], rate("/tf", TF)])
    assert "/tf_static" in sentence
    (sentence,) = missing_for_drive([])
    assert "ROS_DOMAIN_ID" in sentence
    assert "CYCLONEDDS_URI" in sentence


class Vehicle:
    """The other side of the network: what it publishes is in its topics from the start."""

    def __init__(self, domain: int, *topics: tuple[str, str]) -> None:
        network = Network(domain)
        self._out = {topic: network.publish(topic, kind, transient_local=kind == TF) for topic, kind in topics}

    def send(self, topic: str, data: bytes) -> None:
        self._out[topic].send(data)

    def until_subscribed(self) -> None:
        until(lambda: all(out.readers for out in self._out.values()))


def subscriptions(
    domain: int, points: list[str], rules: TimeRules | None = None, waits: Waits = WAITS
) -> Subscriptions:
    network = Network(domain)
    chosen = choose_topics(network, Wish(tuple(points)), Voice(print, waits), lambda: False, 60.0)
    assert chosen is not None
    return Subscriptions(network, chosen, SENSORS["hdl32e"], rules=rules or TimeRules())


@pytest.mark.slow
@pytest.mark.parametrize("compensated", [None, True, False])
def test_a_live_topic_obeys_what_is_stated_of_motion(domain: int, compensated: bool | None) -> None:
    """Clouds without times, 20 times a second, of a sensor whose data sheet says ten."""
    seen = np.array([[10, 0, 0], [0, 10, 0], [0, -10, 0]], dtype=np.float32)
    vehicle = Vehicle(domain, (POINTS, CLOUD))
    rules = TimeRules(motion_compensated=compensated)
    topics, scans = subscriptions(domain, [], rules, Waits(odometry_s=0.0)), list[list[Cloud]]()
    vehicle.until_subscribed()
    for i in range(5):
        vehicle.send(POINTS, cloud_message(Scan(START + i * STEP // 2, seen)))

    def all_came() -> bool:
        scans.extend(topics.take_scans())
        return len(scans) == 5

    until(all_came)
    time_s = topics.waiting(scans[-1]).read().time_s
    if compensated is False:
        assert time_s is not None
        assert np.allclose(time_s, [0.0, -0.0125, 0.0125])
    else:
        assert time_s is None


def test_two_lidars_are_one_scan_in_the_frame_of_the_first_by_tf_static(domain: int) -> None:
    world = np.random.default_rng(1).uniform((4, 4, 0), (30, 30, 5), (500, 3))
    T = {"left": from_xyz_rpy(1.0, 0.7, 1.9, 0.0, 0.1, 0.4), "right": from_xyz_rpy(1.0, -0.7, 1.9, 0.0, 0.0, -1.2)}
    vehicle = Vehicle(domain, ("/left", CLOUD), ("/right", CLOUD), (POSES, ODOMETRY), ("/tf_static", TF))
    vehicle.send("/tf_static", frames_message(0, T))
    topics, scans = subscriptions(domain, ["/left", "/right"]), list[list[Cloud]]()
    vehicle.until_subscribed()
    for lidar, T_base_lidar in T.items():
        seen = transform(inverse(T_base_lidar), world).astype(np.float32)
        vehicle.send(f"/{lidar}", cloud_message(Scan(START, seen), lidar))

    def is_joined() -> bool:
        scans.extend(topics.take_scans())
        return bool(scans and topics.mounts())

    until(is_joined)
    scan = topics.waiting(scans[0]).read()
    assert np.abs(transform(T["left"], scan.points) - np.concatenate([world, world])).max() < 1e-4
    ((start, origin),) = scan.others
    assert start == len(world)
    assert np.allclose(transform(T["left"], origin[None])[0], T["right"][:3, 3])


@pytest.mark.parametrize("roll_deg", [0, 180, 90])
def test_a_lidar_that_hangs_on_the_vehicle_by_tf_static_is_read_in_axes_with_z_up(domain: int, roll_deg: int) -> None:
    world = np.random.default_rng(1).uniform((4, 4, 0), (30, 30, 5), (500, 3))
    T_base_lidar = from_xyz_rpy(1.0, 0.7, 1.9, np.radians(roll_deg), 0.02, 0.05)
    vehicle = Vehicle(domain, (POINTS, CLOUD), (POSES, ODOMETRY), ("/tf_static", TF))
    vehicle.send("/tf_static", frames_message(0, {"lidar": T_base_lidar}))
    topics, scans = subscriptions(domain, [POINTS]), list[list[Cloud]]()
    vehicle.until_subscribed()
    seen = transform(inverse(T_base_lidar), world).astype(np.float32)
    vehicle.send(POINTS, cloud_message(Scan(START, seen), "lidar"))
    vehicle.send(POSES, odometry_message(START, np.eye(4)))

    def has_come() -> bool:
        scans.extend(topics.take_scans())
        topics.take_poses()
        return bool(scans and topics.poses)

    until(has_come)
    topics.stand_upright(None, scans)
    T = T_base_lidar if topics.mount is None else T_base_lidar @ inverse(topics.mount.C)
    scan = topics.waiting(scans[0]).read()
    assert T[2, 2] > 0.99
    assert T[0, 0] > 0.99
    assert np.abs(transform(T, scan.points) - world).max() < 1e-4


def test_empty_clouds_and_stamps_of_zero_at_the_start_do_not_end_a_drive_whose_sensor_is_measured(domain: int) -> None:
    drive = drive_along(path(11), 1)
    vehicle = Vehicle(domain, (POINTS, CLOUD), ("/tf_static", TF))
    topics, scans = subscriptions(domain, [POINTS], waits=Waits(odometry_s=0.0)), list[list[Cloud]]()
    topics.sensor = None
    vehicle.until_subscribed()
    for i in range(11):
        points = drive.read_scan(i).points
        covered = np.full((5, 3), np.nan, dtype=np.float32)
        vehicle.send(POINTS, cloud_message(Scan(0 if i < 3 else START + i * STEP, points[:0] if i < 2 else points)))
        if i == 2:
            columns = dict(zip("xyz", covered.T, strict=True))
            vehicle.send(POINTS, to_cdr(CLOUD, cloud_of(columns, START + STEP, "lidar")))
    vehicle.send(POINTS, cloud_message(Scan(START + 11 * STEP, drive.read_scan(0).points)))
    vehicle.send(POINTS, cloud_message(Scan(START + 12 * STEP, drive.read_scan(0).points)))

    def is_measured() -> bool:
        scans.extend(topics.take_scans())
        return topics.measure(scans)

    until(is_measured)
    assert topics.unusable == 3, "two are empty, one has no return"
    sent = max(scans, key=lambda sweep: sweep[0].stamp_ns)  # by the clock of today
    assert topics.waiting(sent).read().stamp_ns == sent[0].stamp_ns > START + 100 * STEP


def test_a_drive_to_which_no_cloud_comes_ends_after_the_idle_time(tmp_path: Path, domain: int) -> None:
    chosen = Chosen((PublishedTopic(POINTS, CLOUD, 1, True, False),), None)
    topics = Subscriptions(Network(domain), chosen, SENSORS["hdl32e"])
    outbox = Outbox(tmp_path / "state", "car", say=lambda _: None)
    maps = OneMap(map_from_points(street(1)))
    assert run(Plan("car", "day", Settings(), idle_s=0.2), topics, maps, outbox, lambda: False) is None
    outbox.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("late_ns", "wider", "said"), [(5 * 10**9, 1.0, "two clocks"), (0, 2.5, "fits the map nowhere")]
)
def test_a_drive_whose_first_seconds_show_an_error_ends_and_leaves_nothing(
    tmp_path: Path, domain: int, late_ns: int, wider: float, said: str
) -> None:
    poses = path(12, speed_mps=5.0)  # so few that none is decided before the drive ends
    scans = list(drive_along(poses, 1))
    vehicle = Vehicle(domain, (POINTS, CLOUD), (POSES, ODOMETRY), ("/tf_static", TF))
    vehicle.send("/tf_static", frames_message(0, {"lidar": np.eye(4)}))
    topics = subscriptions(domain, [])
    vehicle.until_subscribed()
    for i, (scan, T) in enumerate(zip(scans, poses, strict=True)):
        ns = START + i * STEP
        vehicle.send(POSES, odometry_message(ns + late_ns, T))
        vehicle.send(POINTS, cloud_message(Scan(ns, scan.points, scan.time_s)))
    (tmp_path / "out").mkdir()
    outbox = Outbox(tmp_path / "state", "car", folder=tmp_path / "out", say=lambda _: None)
    plan, maps = Plan("car", "day", Settings(), idle_s=1.0), OneMap(map_from_points(street(1) * [1.0, wider, 1.0]))
    with pytest.raises(MapvoteError, match=f"the first seconds: .*{said}"):
        run(plan, topics, maps, outbox, lambda: False)
    outbox.close()
    assert not list((tmp_path / "out").iterdir())
    assert not list((tmp_path / "state/car").glob("*.journal"))


@pytest.mark.parametrize("kind", LIVOX)
def test_clouds_of_a_livox_driver_arrive_as_scans_with_the_times_of_their_points(domain: int, kind: str) -> None:
    sender = Network(domain).publish("/livox/lidar", kind)
    topics = Subscriptions(
        Network(domain), Chosen((PublishedTopic("/livox/lidar", kind, 1, True, False),), None), SENSORS["hdl32e"]
    )
    until(lambda: sender.readers == 1)
    names = ["offset_time", "x", "y", "z", "reflectivity", "tag", "line"]
    table = np.zeros(300, dtype=list(zip(names, ["<u4", "<f4", "<f4", "<f4", "u1", "u1", "u1"], strict=True)))
    rng = np.random.default_rng(0)
    for axis in "xyz":
        table[axis] = rng.uniform(5.0, 30.0, 300)
    table["offset_time"] = np.linspace(0, 99_000_000, 300)
    sender.send(livox_message(table, START))
    scans: list[list[Cloud]] = []

    def arrived() -> bool:
        scans.extend(topics.take_scans())
        return bool(scans)

    until(arrived)
    scan = topics.waiting(scans[0]).read()
    assert scan.stamp_ns == START
    assert topics.lidar_frames == ["livox"]
    assert np.array_equal(scan.points, np.column_stack([table[axis] for axis in "xyz"]))
    assert scan.time_s is not None
    assert np.allclose(scan.time_s, 1e-9 * table["offset_time"], atol=1e-9)
