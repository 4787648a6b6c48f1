"""The ROS 2 node in place of Autoware's map loader, with a stand-in for rclpy: no ROS is here."""

from __future__ import annotations

import importlib.util
import json
import sys
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from live.test_map_loader import lay, points
from mapvote.live.messages import blank_message, header_of

PACKAGE = Path(__file__).parents[2] / "examples/autoware_map_loader"


class Node:
    """rclpy's node, as far as ours asks it."""

    parameters: dict[str, Any]

    def __init__(self, name: str) -> None:
        self.published: dict[str, list[Any]] = {}
        self.services: dict[str, Any] = {}

    def declare_parameter(self, name: str, default: Any) -> Any:
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_publisher(self, kind: Any, topic: str, qos: Any) -> Any:
        return SimpleNamespace(publish=self.published.setdefault(topic, []).append)

    def create_timer(self, period_s: float, callback: Any) -> Any:
        return callback

    def create_service(self, kind: Any, name: str, callback: Any) -> None:
        self.services[name] = callback

    def get_logger(self) -> Any:
        return SimpleNamespace(info=print, warning=print, error=print)

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: 5))


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    cells = {
        f"PointCloudMap{name}": partial(blank_message, f"autoware_map_msgs/msg/PointCloudMap{name}")
        for name in ("CellMetaDataWithID", "CellWithID", "MetaData")
    }
    services = ("GetDifferentialPointCloudMap", "GetPartialPointCloudMap", "GetSelectedPointCloudMap")
    stand_ins: dict[str, dict[str, Any]] = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"QoSProfile": dict, "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL=1)},
        "autoware_map_msgs.msg": cells,
        "autoware_map_msgs.srv": dict.fromkeys(services),
        "sensor_msgs.msg": {
            name: partial(blank_message, f"sensor_msgs/msg/{name}") for name in ("PointCloud2", "PointField")
        },
        "tier4_external_api_msgs.msg": {"MapHash": partial(blank_message, "tier4_external_api_msgs/msg/MapHash")},
    }
    for name, members in stand_ins.items():
        made = ModuleType(name)
        vars(made).update(members)
        monkeypatch.setitem(sys.modules, name.partition(".")[0], ModuleType(name.partition(".")[0]))
        monkeypatch.setitem(sys.modules, name, made)
    spec = importlib.util.spec_from_file_location("loader_node", PACKAGE / "mapvote_map_loader/node.py")
    assert spec is not None
    assert spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


def test_the_node_offers_no_service_before_a_version_is_in_its_folder(module: ModuleType, tmp_path: Path) -> None:
    Node.parameters = {"folder": str(tmp_path), "server_url": "http://127.0.0.1:9", "period": 3600.0}
    node = module.MapvoteMapLoader()
    node.timer()
    assert node.services == {}
    lay(tmp_path, points((0, 0)), 1)
    node.timer()
    assert len(node.services) == 3
    node.ended.set()


def test_the_node_answers_from_the_folder_and_says_which_map_it_is(module: ModuleType, tmp_path: Path) -> None:
    lay(tmp_path, points((0, 0), (20, 0)), 1)
    Node.parameters = {"folder": str(tmp_path), "server_url": "http://127.0.0.1:9", "period": 3600.0}
    node = module.MapvoteMapLoader()
    answer = node.services["~/service/get_differential_pcd_map"]
    area = SimpleNamespace(center_x=5.0, center_y=5.0, radius=1.0)
    response = SimpleNamespace(header=header_of(0, ""), new_pointcloud_with_ids=[], ids_to_remove=[])
    answer(SimpleNamespace(area=area, cached_ids=["old"]), response)
    (cell,) = response.new_pointcloud_with_ids
    assert (response.ids_to_remove, response.header.frame_id) == (["old"], "map")
    assert (cell.metadata.max_x, cell.pointcloud.width, cell.pointcloud.header.frame_id) == (20.0, 2, "map")
    assert np.frombuffer(cell.pointcloud.data, "<f4").reshape(-1, 3).tolist() == [[3, 3, 1], [4, 4, 1]]
    lay(tmp_path, points((0, 0), (20, 0), z=2.0), 2)
    answer(SimpleNamespace(area=area, cached_ids=[cell.cell_id]), response)
    assert response.ids_to_remove == [cell.cell_id]
    assert len({told.pcd for told in node.published["~/output/map_hash"]}) == 2
    assert [whole.width for whole in node.published["~/output/pointcloud_map"]] == [4, 4]
    assert [len(t.metadata_list) for t in node.published["~/output/pointcloud_map_metadata"]] == [2, 2]
    node.ended.set()


def test_parameters_schema_and_node_name_the_same_things() -> None:
    given = yaml.safe_load((PACKAGE / "config/mapvote_map_loader.param.yaml").read_text())["/**"]["ros__parameters"]
    schema = json.loads((PACKAGE / "schema/mapvote_map_loader.schema.json").read_text())
    described = schema["definitions"]["mapvote_map_loader"]
    source = (PACKAGE / "mapvote_map_loader/node.py").read_text()
    assert sorted(given) == sorted(described["properties"]) == sorted(described["required"])
    for name, about in described["properties"].items():
        assert about["default"] == given[name]
        assert f'("{name}", {json.dumps(about["default"])})' in source
    launch = (PACKAGE / "launch/mapvote_map_loader.launch.xml").read_text()
    assert 'push-ros-namespace namespace="map"' in launch, "its parameters are asked for below /map"
    for name in ("differential", "partial", "selected"):
        assert f'from="~/service/get_{name}_pcd_map" to="/map/get_{name}_pointcloud_map"' in launch
