"""The lifecycle node of a vehicle, with a stand-in for rclpy: no ROS is here."""

from __future__ import annotations

import importlib.util
import json
import sys
import threading
from collections import defaultdict
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import yaml

from live.loopback_dds import until
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.sensors import SENSORS
from mapvote.core.types import Scan
from mapvote.formats.drives.ros_types import CLOUD, ODOMETRY, TF
from mapvote.live.choice import Voice, Wish, choose_topics
from mapvote.live.play import POINTS, POSES, cloud_message, frames_message, odometry_message
from mapvote.live.subscriptions import Subscriptions

PACKAGE = Path(__file__).parents[2] / "examples/vehicle_node"
START = 1_700_000_000 * 10**9
SENT = {"/tf_static": TF, POSES: ODOMETRY, POINTS: CLOUD}


class Node:
    """rclpy's node, as far as ours asks it. All nodes share one network without delay."""

    readers: ClassVar[defaultdict[str, list[Any]]] = defaultdict(list)
    given: dict[str, Any]

    def __init__(self, name: str) -> None:
        self.lines: list[str] = []
        self.declared: dict[str, Any] = {}

    def declare_parameter(self, name: str, default: Any) -> Any:
        self.declared[name] = self.given.get(name, default)
        return SimpleNamespace(value=self.declared[name])

    def get_parameter(self, name: str) -> Any:
        return SimpleNamespace(value=self.declared[name])

    def get_name(self) -> str:
        return "mapvote_vehicle"

    def get_namespace(self) -> str:
        return "/"

    def get_logger(self) -> Any:
        return SimpleNamespace(info=self.lines.append, warning=self.lines.append, error=self.lines.append)

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return [
            *((topic, [kind]) for topic, kind in SENT.items()),
            ("/mapvote/pose", ["geometry_msgs/msg/PoseStamped"]),
        ]

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        name = "sender" if topic in SENT else "mapvote_vehicle"
        qos = SimpleNamespace(reliability="reliable", durability="latched" if topic == "/tf_static" else "volatile")
        return [SimpleNamespace(node_name=name, node_namespace="/", qos_profile=qos)]

    def create_subscription(self, kind: str, topic: str, callback: Any, qos: Any, *, raw: bool) -> Any:
        assert raw, "clouds are not made into Python lists"
        assert SENT.get(topic, kind) == kind
        self.readers[topic].append(callback)
        return topic, callback

    def destroy_subscription(self, subscription: Any) -> None:
        topic, callback = subscription
        self.readers[topic].remove(callback)

    def create_publisher(self, kind: str, topic: str, qos: Any) -> Any:
        return SimpleNamespace(publish=lambda data: None, get_subscription_count=lambda: 0)

    def destroy_publisher(self, publisher: Any) -> None:
        pass


def send(topic: str, data: bytes) -> None:
    for callback in Node.readers[topic]:
        callback(data)


@pytest.fixture
def node_module(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The package's node, imported beside stand-ins."""
    policies = SimpleNamespace(
        RELIABLE="reliable", BEST_EFFORT="", TRANSIENT_LOCAL="latched", VOLATILE="volatile", KEEP_LAST=""
    )
    stand_ins: dict[str, dict[str, Any]] = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "rclpy.executors": {"SingleThreadedExecutor": object},
        "rclpy.lifecycle": {
            "LifecycleNode": Node,
            "State": object,
            "TransitionCallbackReturn": SimpleNamespace(SUCCESS="success", FAILURE="failure"),
        },
        "rclpy.qos": {f"{name}Policy": policies for name in ("Durability", "History", "Reliability")}
        | {"QoSProfile": dict},
        "rosidl_runtime_py": {},
        "rosidl_runtime_py.utilities": {"get_message": str},
        "mapvote_vehicle": {"__path__": [str(PACKAGE / "mapvote_vehicle")]},
    }
    for name, members in stand_ins.items():
        made = ModuleType(name)
        vars(made).update(members)
        monkeypatch.setitem(sys.modules, name, made)
    monkeypatch.delitem(sys.modules, "mapvote_vehicle.ros_network", raising=False)
    spec = importlib.util.spec_from_file_location("vehicle_node", PACKAGE / "mapvote_vehicle/node.py")
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    Node.readers.clear()
    Node.given = {"out": "ballots"}
    return made


def test_the_service_takes_its_topics_through_rclpy_as_it_does_over_dds(node_module: ModuleType) -> None:
    network = node_module.RosNetwork(node_module.MapvoteVehicle())
    assert [one.topic for one in network.published()] == sorted(SENT), "our own pose is none of them"
    chosen = choose_topics(network, Wish(("/points",)), Voice(print), lambda: False)
    assert chosen is not None
    assert chosen.odometry is not None
    topics = Subscriptions(network, chosen, SENSORS["hdl32e"])
    mount = from_xyz_rpy(1.0, 0.0, 2.0)
    send("/tf_static", frames_message(START, {"lidar": mount}))
    send(POSES, odometry_message(START, from_xyz_rpy(5.0, 6.0, 0.0)))
    points = np.random.default_rng(1).uniform((4, 4, 0), (30, 30, 5), (50, 3)).astype(np.float32)
    send(POINTS, cloud_message(Scan(START, points)))
    network.wait(5.0)
    (scan,) = until(topics.take_scans)
    assert np.array_equal(topics.waiting(scan).read().points, points)
    ((stamp_ns, T),) = topics.take_poses()
    assert (stamp_ns, T[:2, 3].tolist()) == (START, [5.0, 6.0])
    T_base_lidar = topics.T_base_lidar()
    assert T_base_lidar is not None
    np.testing.assert_allclose(T_base_lidar, mount)
    network.close()
    assert not any(Node.readers.values())


def test_a_drive_lasts_from_activate_to_deactivate(node_module: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_module, "warm_vehicle", lambda settings: None)
    begun, ended = threading.Event(), threading.Event()

    def drive(self: Any) -> None:
        begun.set()
        assert self.stopped.wait(20.0)
        ended.set()

    monkeypatch.setattr(node_module.MapvoteVehicle, "_drive", drive)
    node = node_module.MapvoteVehicle()
    assert node.on_configure(None) == "success"
    for _ in range(2):
        begun.clear()
        ended.clear()
        assert node.on_activate(None) == "success"
        assert begun.wait(20.0)
        assert not ended.is_set()
        assert node.on_deactivate(None) == "success"
        assert ended.is_set()
    assert node.on_shutdown(None) == "success"


def test_a_node_without_a_way_for_its_ballots_is_not_configured_and_says_why(node_module: ModuleType) -> None:
    Node.given = {}
    node = node_module.MapvoteVehicle()
    assert node.on_configure(None) == "failure"
    assert node.lines == ["give send, out, or both"]


def test_parameters_schema_and_node_name_the_same_things() -> None:
    given = yaml.safe_load((PACKAGE / "config/mapvote_vehicle.param.yaml").read_text())["/**"]["ros__parameters"]
    described = json.loads((PACKAGE / "schema/mapvote_vehicle.schema.json").read_text())["definitions"][
        "mapvote_vehicle"
    ]
    source = (PACKAGE / "mapvote_vehicle/node.py").read_text()
    assert list(given) == list(described["properties"]) == described["required"]
    for name, about in described["properties"].items():
        assert about["default"] == given[name]
        default = about["default"] if isinstance(about["default"], bool) else json.dumps(about["default"])
        assert f'("{name}", {default})' in source
    for file in ("node.py", "ros_network.py"):
        compile((PACKAGE / "mapvote_vehicle" / file).read_text(), file, "exec")
    compile((PACKAGE / "launch/mapvote_vehicle.launch.py").read_text(), "launch", "exec")
