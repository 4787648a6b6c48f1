"""Writes small ROS 2 bags by hand: clouds, static frames, any message."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from mapvote.core.types import F64
from mapvote.formats.drives.ros_types import CLOUD as CLOUD
from mapvote.formats.drives.ros_types import TF
from mapvote.live.play import frames_message

START = 1_700_000_000 * 10**9
"""When the first message comes, nanoseconds."""


class Recorder:
    """Writes one bag."""

    def __init__(self, path: Path, storage: StoragePlugin = StoragePlugin.MCAP) -> None:
        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self.types: dict[str, Any] = dict(self.store.types)
        self.bag = Writer(path, version=9, storage_plugin=storage)
        self.bag.open()
        self.topics: dict[str, Any] = {}

    def register(self, definitions: dict[str, str]) -> None:
        """Types that ROS does not bring, by their definitions."""
        for name, text in definitions.items():
            self.store.register(get_types_from_msg(text, name))
        self.types = dict(self.store.types)

    def header(self, ns: int, frame: str) -> Any:
        return self.types["std_msgs/msg/Header"](
            self.types["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9), frame
        )

    def write(self, topic: str, kind: str, ns: int, message: Any) -> None:
        self.write_raw(topic, kind, ns, self.store.serialize_cdr(message, kind))

    def write_raw(self, topic: str, kind: str, ns: int, data: bytes | memoryview) -> None:
        if topic not in self.topics:
            self.topics[topic] = self.bag.add_connection(topic, kind, typestore=self.store)
        self.bag.write(self.topics[topic], ns, data)

    def cloud(self, topic: str, frame: str, ns: int, points: NDArray[np.floating]) -> None:
        rows = np.ascontiguousarray(points, dtype="<f4").view([(axis, "<f4") for axis in "xyz"])[:, 0]
        self.write(topic, CLOUD, ns, self.cloud_of(rows, ns, frame))

    def cloud_of(self, table: NDArray[np.void], ns: int, frame: str = "lidar", cut: int = 0) -> Any:
        """The message of a structured array; the last ``cut`` bytes of its data are missing."""
        types = {"|i1": 1, "|u1": 2, "<i2": 3, "<u2": 4, "<i4": 5, "<u4": 6, "<f4": 7, "<f8": 8}
        fields = [
            self.types["sensor_msgs/msg/PointField"](name, offset, types[kind.str], 1)
            for name, (kind, offset, *_) in (table.dtype.fields or {}).items()
        ]
        data, step = np.frombuffer(table.tobytes(), dtype=np.uint8), table.dtype.itemsize
        size = 1, len(table), fields, False, step, step * len(table)
        return self.types[CLOUD](self.header(ns, frame), *size, data[: len(data) - cut], True)

    def pose(self, topic: str, ns: int, T: F64, received_ns: int) -> None:
        g = "geometry_msgs/msg/"
        q = self.types[g + "Quaternion"](*Rotation.from_matrix(T[:3, :3]).as_quat().tolist())
        pose = self.types[g + "Pose"](self.types[g + "Point"](*T[:3, 3].tolist()), q)
        kind = g + "PoseStamped"
        self.write(topic, kind, received_ns, self.types[kind](self.header(ns, "map"), pose))

    def static(self, frames: dict[str, F64]) -> None:
        self.write_raw("/tf_static", TF, START, frames_message(START, frames))
