"""Writes small ROS 2 bags by hand: clouds, static frames, any message."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from mapvote.core.types import F64

START = 1_700_000_000 * 10**9
"""When the first message comes, nanoseconds."""


class Recorder:
    """Writes one bag."""

    def __init__(self, path: Path) -> None:
        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self.types: dict[str, Any] = dict(self.store.types)
        self.bag = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self.bag.open()
        self.topics: dict[str, Any] = {}

    def header(self, ns: int, frame: str) -> Any:
        return self.types["std_msgs/msg/Header"](
            self.types["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9), frame
        )

    def write(self, topic: str, kind: str, ns: int, message: Any) -> None:
        if topic not in self.topics:
            self.topics[topic] = self.bag.add_connection(topic, kind, typestore=self.store)
        self.bag.write(self.topics[topic], ns, self.store.serialize_cdr(message, kind))

    def cloud(self, topic: str, frame: str, ns: int, points: NDArray[np.floating]) -> None:
        kind, field = "sensor_msgs/msg/PointCloud2", self.types["sensor_msgs/msg/PointField"]
        raw = np.ascontiguousarray(points, dtype="<f4").view(np.uint8).ravel()
        fields = [field(axis, 4 * i, 7, 1) for i, axis in enumerate("xyz")]
        n = len(points)
        self.write(
            topic, kind, ns, self.types[kind](self.header(ns, frame), 1, n, fields, False, 12, 12 * n, raw, True)
        )

    def static(self, frames: dict[str, F64]) -> None:
        g = "geometry_msgs/msg/"
        transforms = []
        for child, T in frames.items():
            q = self.types[g + "Quaternion"](*Rotation.from_matrix(T[:3, :3]).as_quat().tolist())
            transform = self.types[g + "Transform"](self.types[g + "Vector3"](*T[:3, 3].tolist()), q)
            transforms.append(self.types[g + "TransformStamped"](self.header(START, "base_link"), child, transform))
        self.write("/tf_static", "tf2_msgs/msg/TFMessage", START, self.types["tf2_msgs/msg/TFMessage"](transforms))
