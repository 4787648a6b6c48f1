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


def two_lidars(path: Path, *, static: bool = True) -> Path:
    bag = Recorder(path)
    if static:
        bag.static(T_BASE)
    for i in range(6):
        for late, (frame, T) in enumerate(T_BASE.items()):
            ns = START + i * 10**8 + late * 4 * 10**7
            bag.cloud(f"/{frame}/points", frame, ns, geometry.transform(geometry.inverse(T), HALL))
    bag.bag.close()
    return path


def test_several_lidars_of_one_vehicle_are_one_drive(tmp_path: Path) -> None:
    path = two_lidars(tmp_path / "bag")
    with pytest.raises(MapvoteError, match="several LiDARs of one vehicle with commas"):
        open_drive(path)
    drive = open_drive(path, topic="/front/points,/rear/points", sensor="hdl32e")
    assert len(drive) == 12
    T_front_rear = geometry.inverse(T_BASE["front"]) @ T_BASE["rear"]
    for i, scan in enumerate(drive):
        hall = geometry.transform(T_BASE["front"], scan.points.astype(np.float64))
        assert cKDTree(HALL).query(hall)[0].max() < 1e-4
        rays_begin = scan.origin_map(np.eye(4))
        assert np.allclose(rays_begin, np.zeros(3) if i % 2 == 0 else T_front_rear[:3, 3])
    with pytest.raises(MapvoteError, match="tf_static does not say"):
        open_drive(two_lidars(tmp_path / "no_tf", static=False), topic="/front/points,/rear/points")


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
