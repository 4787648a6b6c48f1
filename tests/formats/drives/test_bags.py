"""ROS bags: point clouds and their times, poses, several LiDARs of one vehicle, GNSS fixes, raw packets."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import get_types_from_msg
from scipy.spatial import cKDTree

from bag_recorder import CLOUD, START, Recorder
from mapvote.core import geometry
from mapvote.core.types import F32, MapvoteError, PosePrior, Scan
from mapvote.formats import open_drive
from mapvote.formats.drives.bag import Bag, NextMessages, stamps_of
from mapvote.formats.drives.point_fields import scan_from_point_cloud2
from mapvote.formats.drives.ros_types import GNSS, IMU, ODOMETRY, TF
from mapvote.formats.geo.frame import MapFrame
from mapvote.live.messages import blank_message, from_cdr, header_of, to_cdr
from mapvote.live.play import cloud_message, odometry_message
from mapvote.live.sweeps import Cloud, Revolutions
from receiver_messages import fix_message, imu_message, moving_frame

N = 5
STAMPS = [1_700_000_000_123_456_789 + 100_000_000 * i for i in range(N)]
STEP = geometry.from_xyz_rpy(12.0, 0.1, 0.0, yaw=0.02)
HALL = np.random.default_rng(0).uniform([-20, -20, -2], [20, 20, 6], (2000, 3))
T_BASE = {
    "front": geometry.from_xyz_rpy(2.0, 0.0, 1.0, 0.0, 0.1, 0.0),
    "rear": geometry.from_xyz_rpy(-2.0, 0.3, 1.2, 0, 0, 3.0),
}


def cloud(i: int) -> F32:
    """300 points all round, farther off than the sensor's nearest."""
    rng = np.random.default_rng(i)
    out: F32 = (rng.uniform(5, 40, (300, 3)) * rng.choice([-1, 1], (300, 3))).astype(np.float32)
    return out


def write_bag(
    path: Path, storage: StoragePlugin, *, topics: tuple[str, ...] = ("/points",), stamped: bool = True, cut: int = 0
) -> Path:
    """A bag of PointCloud2 (x y z intensity, Ouster's t) with poses at twice the rate."""
    bag = Recorder(path, storage)
    for i, ns in enumerate(STAMPS):
        kinds = [*((axis, "<f4") for axis in "xyz"), ("pad", "<u4"), ("intensity", "<f4"), ("t", "<u4")]
        table = np.zeros(300, dtype=kinds)
        table["x"], table["y"], table["z"] = cloud(i).T
        table["intensity"], table["t"] = 51.0, np.arange(300) * 300_000
        table["x"][7] = np.nan  # a ray that hit nothing
        for topic in topics:
            bag.write(topic, CLOUD, ns + 5_000_000, bag.cloud_of(table, ns if stamped else 0, cut=cut))
    for k in range(2 * N + 1):
        pose = geometry.interpolate(np.eye(4), STEP, k / 2 - 0.5)
        ns = STAMPS[0] + 50_000_000 * k
        bag.pose("/odom", ns - 50_000_000 if stamped else 0, pose, ns)
    bag.bag.close()
    return path


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_a_ros2_bag_is_a_drive(tmp_path: Path, storage: StoragePlugin) -> None:
    drive = open_drive(write_bag(tmp_path / "bag", storage), prior="/odom", sensor="hdl32e")
    assert drive.stamps_ns.tolist() == STAMPS
    keep = np.arange(300) != 7
    for i in (0, 3, 1):  # in any order
        scan = drive.read_scan(i)
        assert np.array_equal(scan.points, cloud(i)[keep])
        assert np.allclose(scan.fields["intensity"], 0.2)
        assert scan.time_s is not None
        assert np.allclose(scan.time_s, np.arange(300)[keep] * 0.0003)
    assert drive.T_map_lidar_prior is not None
    assert np.allclose(drive.T_map_lidar_prior[1], STEP, atol=1e-9)
    assert len(open_drive(tmp_path / "bag", scans="1:4:2")) == 2
    prior = open_drive(tmp_path / "bag", prior="/odom", mount="1,0,2,0,0,0", sensor="hdl32e").T_map_lidar_prior
    assert prior is not None
    assert np.allclose(prior[0, :3, 3], [1, 0, 2], atol=1e-9)
    for file in (tmp_path / "bag").glob("*.mcap"):  # without its folder
        assert len(open_drive(file, sensor="hdl32e")) == N


def test_bags_that_leave_a_question_open(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = write_bag(tmp_path / "two", StoragePlugin.SQLITE3, topics=("/front", "/rear"))
    with pytest.raises(MapvoteError, match=r"choose with --topic .*/front \(5\), /rear \(5\)"):
        open_drive(bag)
    assert len(open_drive(bag, topic="/rear", sensor="hdl32e")) == N
    (bag / "drive.toml").write_text("topic = '/front'\nsensor = 'vlp16'\n")
    assert open_drive(bag).sensor.name == "vlp16"
    with pytest.raises(MapvoteError, match=r"no PointCloud2 topic /left; there are: /front"):
        open_drive(bag, topic="/left")
    with pytest.raises(MapvoteError, match=r"no pose topic /gps; topics with poses: /odom"):
        open_drive(bag, prior="/gps")
    with caplog.at_level(logging.WARNING):
        unstamped = open_drive(write_bag(tmp_path / "u", StoragePlugin.MCAP, stamped=False), sensor="hdl32e")
    assert "no stamps" in caplog.text
    assert unstamped.stamps_ns[0] == STAMPS[0] + 5_000_000
    assert len(unstamped.read_scan(0).points) == 299


def test_broken_bags_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MapvoteError, match=r"7190 bytes, but its header says 7200"):
        open_drive(write_bag(tmp_path / "cut", StoragePlugin.SQLITE3, cut=10))
    damaged = write_bag(tmp_path / "damaged", StoragePlugin.SQLITE3) / "damaged.db3"
    damaged.write_bytes(damaged.read_bytes()[:9000])
    with pytest.raises(MapvoteError, match=r"sqlite3 \S+damaged\.db3 \"\.recover\" \| sqlite3 recovered\.db3"):
        open_drive(tmp_path / "damaged")
    for module in [m for m in sys.modules if m.partition(".")[0] == "rosbags"]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(MapvoteError, match=r"mapvote\[ros\]"):
        open_drive(tmp_path / "cut")


def test_an_orientation_that_nobody_set_is_no_pose(tmp_path: Path) -> None:
    bag = Recorder(tmp_path / "bag")
    bag.cloud("/points", "lidar", START, HALL)
    message = blank_message("geometry_msgs/msg/PoseStamped", header=header_of(START, "map"))
    bag.write_raw("/odom", "geometry_msgs/msg/PoseStamped", START, to_cdr("geometry_msgs/msg/PoseStamped", message))
    bag.bag.close()
    with pytest.raises(MapvoteError, match=r"/odom holds a quaternion of zeros, .*--prior TOPIC or --prior none"):
        open_drive(tmp_path / "bag", sensor="hdl32e", prior="/odom")
    assert len(open_drive(tmp_path / "bag", sensor="hdl32e")) == 1


def two_lidars(path: Path, *, static: bool = True, late_ns: int = 4 * 10**7, lost: int = -1) -> Path:
    bag = Recorder(path)
    if static:
        bag.static(T_BASE)
    for i in range(6):
        for late, (frame, T) in enumerate(T_BASE.items()):
            if (i, frame) != (lost, "front"):
                ns = START + i * 10**8 + late * late_ns
                bag.cloud(f"/{frame}/points", frame, ns, geometry.transform(geometry.inverse(T), HALL))
    bag.bag.close()
    return path


BOTH = "/front/points,/rear/points"


@pytest.mark.parametrize("late_ns", [0, 1_000, -1_000, 40_000_000, 50_000_000])
def test_clouds_of_several_lidars_in_one_revolution_are_one_scan(tmp_path: Path, late_ns: int) -> None:
    drive = open_drive(two_lidars(tmp_path / "bag", late_ns=late_ns), topic=BOTH, sensor="hdl32e")
    T_front_rear = geometry.inverse(T_BASE["front"]) @ T_BASE["rear"]
    assert len(drive) == 6
    assert np.array_equal(drive.stamps_ns, START + np.arange(6) * 10**8)
    for scan in drive:
        hall = geometry.transform(T_BASE["front"], scan.points.astype(np.float64))
        assert cKDTree(HALL).query(hall)[0].max() < 1e-4
        (first, front), (second, rear) = scan.by_lidar()
        assert np.allclose(front.origin_map(np.eye(4)), 0.0)
        assert np.allclose(rear.origin_map(np.eye(4)), T_front_rear[:3, 3])
        assert len(front.points) + len(rear.points) == len(scan.points)
        assert np.array_equal(scan.points[first], front.points)
        if late_ns == 0:
            assert scan.time_s is None
        else:
            assert scan.time_s is not None
            assert np.allclose(scan.time_s[first], 0.0)
            assert np.allclose(scan.time_s[second], late_ns * 1e-9)


def test_a_lidar_that_misses_a_revolution_leaves_the_other_s_scan_by_itself(tmp_path: Path) -> None:
    drive = open_drive(two_lidars(tmp_path / "bag", lost=3), topic=BOTH, sensor="hdl32e")
    assert [len(scan.by_lidar()) for scan in drive] == [2, 2, 2, 1, 2, 2]
    assert drive.read_scan(3).origin is not None


def test_messages_come_in_any_order_and_those_of_several_lidars_in_one_pass(tmp_path: Path) -> None:
    bag = Bag(two_lidars(tmp_path / "bag"))
    topics = BOTH.split(",")
    rows = [(topic, received, header) for topic, of in stamps_of(bag, topics).items() for header, received, _ in of]
    clouds = NextMessages(bag, topics)
    for seed in range(5):
        for topic, received, header in np.random.default_rng(seed).permutation(np.array(rows, object)):
            message = clouds.read(topic, received, header)
            assert message is not None
            assert (message[0].topic, bag.stamp_ns(message[1])) == (topic, header)
    assert clouds.read(topics[0], START + 1, START) is None
    before = bag.passes
    assert all(clouds.read(*row) for row in sorted(rows, key=lambda row: (round(row[2], -8), row[0])))
    assert bag.passes == before + 1
    list(bag.raw("/tf_static"))  # reads the file elsewhere
    assert clouds.read(*rows[1]) is not None


def test_two_lidars_on_one_topic_are_refused(tmp_path: Path) -> None:
    bag = Recorder(tmp_path / "bag")
    for i in range(4):
        bag.cloud("/points", "front" if i % 2 else "rear", START + i * 10**8, HALL)
    bag.bag.close()
    drive = open_drive(tmp_path / "bag", sensor="hdl32e", prior="none")
    with pytest.raises(MapvoteError, match=r"/points sends clouds in frame rear and in frame front: two LiDARs"):
        list(drive)


def test_which_lidars_are_meant_and_where_they_sit_must_be_known(tmp_path: Path) -> None:
    with pytest.raises(MapvoteError, match="several LiDARs of one vehicle with commas"):
        open_drive(two_lidars(tmp_path / "bag"))
    with pytest.raises(MapvoteError, match=r"tf_static holds no transform from front .* to rear"):
        open_drive(two_lidars(tmp_path / "no_tf", static=False), topic=BOTH)


@pytest.mark.parametrize("static", [True, False])
def test_mounts_in_drive_toml_win_over_tf_static(tmp_path: Path, static: bool) -> None:
    bag = two_lidars(tmp_path / "bag", static=static, late_ns=0)
    mounts = {f"/{name}/points": T[:3].ravel().tolist() for name, T in T_BASE.items()}
    (bag / "drive.toml").write_text(tomli_w.dumps({"mounts": mounts, "sensor": "hdl32e"}))
    drive = open_drive(bag, topic=BOTH)
    assert np.allclose(drive.T_base_lidar, T_BASE["front"])
    hall = geometry.transform(T_BASE["front"], drive.read_scan(2).points.astype(np.float64))
    assert cKDTree(HALL).query(hall)[0].max() < 1e-4
    (bag / "drive.toml").write_text(tomli_w.dumps({"mounts": {name: [1.0, 2.0] for name in mounts}}))
    with pytest.raises(MapvoteError, match=r"mounts: /front/points: T_base_lidar must be 12 numbers"):
        open_drive(bag, topic=BOTH)


def test_gnss_fixes_are_a_prior_in_the_maps_frame(tmp_path: Path) -> None:
    frame = MapFrame("EPSG:32654", (367_000.0, 3_948_000.0, 0.0))
    bag = Recorder(tmp_path / "bag")
    kind = "sensor_msgs/msg/NavSatFix"
    status = bag.types["sensor_msgs/msg/NavSatStatus"](0, 1)
    for i in range(6):
        ns = START + i * 10**8
        lon, lat, height = frame.to_lonlat(np.array([[3.0 * i, 4.0 * i, 20.0]]))[0].tolist()
        bag.write("/fix", kind, ns, bag.types[kind](bag.header(ns, "gnss"), status, lat, lon, height, np.zeros(9), 0))
        bag.cloud("/points", "lidar", ns, HALL)
    bag.bag.close()
    drive = open_drive(tmp_path / "bag", prior="/fix", frame=frame, sensor="hdl32e")
    T = drive.T_map_lidar_prior
    assert T is not None
    assert np.allclose(T[:, :3, 3], [[3.0 * i, 4.0 * i, 20.0] for i in range(6)], atol=1e-4)
    assert np.allclose(T[:, :3, 0], [0.6, 0.8, 0.0], atol=1e-6)  # heads where it drives
    assert drive.georeference["crs"] == "EPSG:32654"


def test_a_bag_of_packets_says_what_to_do(tmp_path: Path) -> None:
    bag = Recorder(tmp_path / "bag")
    name = "velodyne_msgs/msg/VelodyneScan"
    bag.store.register(get_types_from_msg("std_msgs/Header header\nuint8[] data\n", name))
    message = bag.store.types[name](bag.header(START, "velodyne"), np.zeros(4, dtype=np.uint8))
    bag.write("/velodyne_packets", name, START, message)
    bag.bag.close()
    with pytest.raises(MapvoteError, match="decode with your driver first"):
        open_drive(tmp_path / "bag")


def record_vehicle(path: Path, *odometries: str, frame: str = "odom", static: bool = True) -> Path:
    """A bag of a LiDAR that sits on a vehicle, and of the vehicle's odometry in ``frame``."""
    bag = Recorder(path)
    for i, ns in enumerate(STAMPS):
        bag.cloud("/points", "lidar", ns, cloud(i))
        for topic in odometries:
            T = geometry.from_xyz_rpy(float(i), 0.0, 0.0, 0.0, 0.0, 0.1)
            bag.write_raw(topic, ODOMETRY, ns, odometry_message(ns, T, frame))
    if static:
        bag.static({"lidar": MOUNT})
    bag.bag.close()
    return path


MOUNT = geometry.from_xyz_rpy(1.0, 0.0, 1.8, 0.0, 0.0, 0.2)


@pytest.mark.parametrize(("frame", "in_map"), [("odom", False), ("map", True), ("camera_init", False)])
def test_a_drive_that_votes_takes_odometry_and_mount_from_the_bag_as_a_live_one_does(
    tmp_path: Path, frame: str, in_map: bool
) -> None:
    bag = record_vehicle(tmp_path / "bag", "/wheels", frame=frame)
    assert open_drive(bag, sensor="hdl32e").T_map_lidar_prior is None, "a map is not built by drifting odometry"
    for drive in (open_drive(bag, sensor="hdl32e", as_live=True), open_drive(bag, sensor="hdl32e", prior="/wheels")):
        assert drive.T_map_lidar_prior is not None
        wanted = geometry.from_xyz_rpy(2.0, 0.0, 0.0, 0.0, 0.0, 0.1) @ MOUNT
        assert np.allclose(drive.T_map_lidar_prior[2], wanted)
        assert np.allclose(drive.T_base_lidar, MOUNT)
        assert drive.prior_in_map == in_map


def test_an_option_of_the_user_wins_over_the_choice_of_a_live_drive(tmp_path: Path) -> None:
    bag = record_vehicle(tmp_path / "bag", "/wheels")
    assert open_drive(bag, sensor="hdl32e", as_live=True, prior="none").T_map_lidar_prior is None
    drive = open_drive(bag, sensor="hdl32e", as_live=True, mount="0,0,2,0,0,0")
    assert drive.T_map_lidar_prior is not None
    assert np.allclose(drive.T_map_lidar_prior[0][:3, 3], [0, 0, 2])


def test_a_choice_of_poses_and_a_mount_that_nobody_names_are_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    two = record_vehicle(tmp_path / "two", "/wheels", "/lio")
    assert open_drive(two, sensor="hdl32e", as_live=True).T_map_lidar_prior is None
    assert "--prior chooses: /lio, /wheels" in caplog.messages[-1]
    unjoined = record_vehicle(tmp_path / "unjoined", "/wheels", static=False)
    assert open_drive(unjoined, sensor="hdl32e", as_live=True).T_map_lidar_prior is None
    assert "join lidar to base_link" in caplog.messages[-1]
    assert open_drive(unjoined, sensor="hdl32e", prior="/wheels").T_map_lidar_prior is not None
    assert "taken for the LiDAR's own" in caplog.messages[-1]


@pytest.mark.parametrize(("root", "in_map"), [("map", True), ("odom", False)])
def test_a_bag_without_odometry_gives_the_pose_of_the_body_that_moves_on_tf(
    tmp_path: Path, root: str, in_map: bool
) -> None:
    bag = Recorder(tmp_path / "bag")
    bag.static({"lidar": MOUNT})
    for i, ns in enumerate(STAMPS):
        bag.cloud("/points", "lidar", ns, cloud(i))
        T = geometry.from_xyz_rpy(2.0 * i, 1.0, 0.0, 0.0, 0.0, 0.1)
        bag.write_raw("/tf", TF, ns, moving_frame(ns, root, "base_link", T))
        bag.write_raw("/tf", TF, ns, moving_frame(ns, "base_link", "wheel", np.eye(4)))
    bag.bag.close()
    for options in ({"as_live": True}, {"prior": "/tf"}):
        drive = open_drive(tmp_path / "bag", sensor="hdl32e", **options)
        assert drive.T_map_lidar_prior is not None
        assert np.allclose(drive.T_map_lidar_prior[2], geometry.from_xyz_rpy(4.0, 1.0, 0.0, 0.0, 0.0, 0.1) @ MOUNT)
        assert drive.prior_in_map == in_map


def test_odometry_is_brought_to_the_map_where_a_localiser_published_the_way_on_tf(tmp_path: Path) -> None:
    T_map_odom = geometry.from_xyz_rpy(100.0, 50.0, 0.0, 0.0, 0.0, 0.6)
    bag = Recorder(tmp_path / "bag")
    bag.static({"lidar": MOUNT})
    for i, ns in enumerate(STAMPS):
        bag.write_raw("/tf", TF, ns - 1000, moving_frame(ns, "map", "odom", T_map_odom))
        bag.write_raw("/wheels", ODOMETRY, ns, odometry_message(ns, geometry.from_xyz_rpy(float(i), 0.0, 0.0), "odom"))
        bag.cloud("/points", "lidar", ns, cloud(i))
    bag.bag.close()
    drive = open_drive(tmp_path / "bag", sensor="hdl32e", as_live=True)
    assert drive.prior_in_map
    assert drive.T_map_lidar_prior is not None
    assert np.allclose(drive.T_map_lidar_prior[3], T_map_odom @ geometry.from_xyz_rpy(3.0, 0.0, 0.0) @ MOUNT)


def test_fixes_of_a_drive_that_votes_state_their_own_sigmas_and_know_no_later_fix(tmp_path: Path) -> None:
    frame = MapFrame("EPSG:32632", (457_000.0, 5_428_000.0, 0.0))
    bag = Recorder(tmp_path / "bag")
    for i, ns in enumerate(STAMPS):
        place = frame.to_lonlat(np.array([[1.5 * i, 0.0, 20.0]]))
        bag.write_raw("/fix", GNSS, ns - 10**7, fix_message(ns - 10**7, place[0], sigma_m=0.02))
        bag.write_raw("/imu", IMU, ns - 10**7, imu_message(ns - 10**7, 0.0, sigma_rad=0.01))
        bag.cloud("/points", "lidar", ns, cloud(i))
    bag.bag.close()
    drive = open_drive(tmp_path / "bag", sensor="hdl32e", as_live=True, frame=frame)
    assert drive.prior_sigmas is not None
    assert drive.T_map_lidar_prior is not None
    assert drive.prior_sigmas[0, 1] == pytest.approx(0.01, abs=0.002)
    assert drive.prior_sigmas[-1, 0] < 0.1 < drive.prior_sigmas[0, 0]
    assert drive.prior_sigma_m == pytest.approx(np.median(drive.prior_sigmas[:, 0]))
    assert np.allclose(drive.T_map_lidar_prior[-1, :2, 3], [1.5 * len(STAMPS) - 1.35, 0.0], atol=0.05)
    prior = PosePrior.of(drive, 1)
    assert prior is not None
    assert prior.is_planar
    unplaced = open_drive(tmp_path / "bag", sensor="hdl32e", as_live=True)
    assert unplaced.T_map_lidar_prior is None, "nobody knows where the map lies on Earth"


def test_packets_of_a_part_of_a_revolution_are_joined_to_the_scans_that_a_live_drive_makes_of_them(
    tmp_path: Path,
) -> None:
    """Ten packets a revolution, clockwise, each point with its time in the packet; one packet is lost."""
    rng = np.random.default_rng(3)
    bag = Recorder(tmp_path / "bag")
    live = Revolutions()
    joined = []
    for k in range(62):
        azimuth = -2.0 * np.pi * (k + np.linspace(0.0, 1.0, 300, endpoint=False)) / 10.0
        points = np.column_stack([9.0 * np.cos(azimuth), 9.0 * np.sin(azimuth), rng.uniform(-1, 3, 300)])
        time_s = np.linspace(0.0, 0.01, 300, endpoint=False).astype(np.float32)
        ns = START + k * 10**7
        data = cloud_message(Scan(ns, points.astype(np.float32), time_s))
        if k != 23:
            bag.write_raw("/points", CLOUD, ns, data)
            joined += live.add(Cloud(0, ns, ns, from_cdr(CLOUD, data)))
    bag.bag.close()
    drive = open_drive(tmp_path / "bag", sensor="hdl32e")
    assert [len(drive.read_scan(i).points) for i in range(len(drive))] == [3000, 3000, 2700, 3000, 3000, 3000]
    assert drive.stamps_ns.tolist() == [cloud.stamp_ns for cloud in joined]
    scan = drive.read_scan(0)
    assert scan.time_s is not None
    assert np.allclose(scan.time_s, np.arange(3000) / 3000 * 0.1, atol=1e-6)
    packets = [scan_from_point_cloud2(packet.message, drive.sensor) for packet in joined[1].packets]
    assert np.array_equal(drive.read_scan(1).points, np.concatenate([packet.points for packet in packets]))
