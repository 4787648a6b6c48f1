"""Bags of whole vehicles: several LiDARs, GNSS fixes, raw packets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg
from scipy.spatial import cKDTree

from bag_recorder import START, Recorder
from mapvote.core import geometry
from mapvote.core.types import MapvoteError
from mapvote.formats import open_drive
from mapvote.formats.geo.frame import MapFrame

HALL = np.random.default_rng(0).uniform([-20, -20, -2], [20, 20, 6], (2000, 3))
T_BASE = {
    "front": geometry.from_xyz_rpy(2.0, 0.0, 1.0, 0.0, 0.1, 0.0),
    "rear": geometry.from_xyz_rpy(-2.0, 0.3, 1.2, 0, 0, 3.0),
}


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
def test_what_several_lidars_see_in_one_revolution_is_one_scan(tmp_path: Path, late_ns: int) -> None:
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


def test_which_lidars_are_meant_and_where_they_sit_must_be_known(tmp_path: Path) -> None:
    with pytest.raises(MapvoteError, match="several LiDARs of one vehicle with commas"):
        open_drive(two_lidars(tmp_path / "bag"))
    with pytest.raises(MapvoteError, match=r"tf_static holds no transform from front .* to rear"):
        open_drive(two_lidars(tmp_path / "no_tf", static=False), topic=BOTH)


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
