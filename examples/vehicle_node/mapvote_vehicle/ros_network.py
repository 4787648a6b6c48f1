"""Topics through rclpy, in place of mapvote.live.dds.Network: bytes of messages in and out, on any RMW."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosidl_runtime_py.utilities import get_message

from mapvote.live.dds import PublishedTopic


class RosSubscription:
    """Messages of one topic, as bytes, in the order in which they came."""

    def __init__(self, depth: int, came: threading.Event, closing: Callable[[RosSubscription], object]) -> None:
        self._messages: deque[tuple[int, memoryview]] = deque(maxlen=depth)
        self._came = came
        self._closing = closing

    def on_message(self, data: bytes) -> None:
        """rclpy's callback."""
        self._messages.append((time.time_ns(), memoryview(data)))
        self._came.set()

    def take(self) -> list[tuple[int, memoryview]]:
        """Every message that came since the last call, and when it came."""
        return [self._messages.popleft() for _ in range(len(self._messages))]

    def close(self) -> None:
        self._closing(self)


class RosPublication:
    """A writer of one topic."""

    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher

    @property
    def readers(self) -> int:
        return int(self._publisher.get_subscription_count())

    def send(self, data: bytes) -> None:
        self._publisher.publish(bytes(data))

    def delivered(self, seconds: float) -> bool:
        return True


class RosNetwork:
    """The topics that a node sees. The node must be spun by another thread."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._came = threading.Event()
        self._subscriptions: dict[RosSubscription, Any] = {}
        self._publishers: list[Any] = []
        self.domain = 0

    def published(self) -> list[PublishedTopic]:
        """Every topic that another node publishes now, in the order of names."""
        own = self._node.get_name(), self._node.get_namespace()
        found = []
        for topic, kinds in sorted(self._node.get_topic_names_and_types()):
            ends = self._node.get_publishers_info_by_topic(topic)
            ends = [end for end in ends if (end.node_name, end.node_namespace) != own]
            if ends:
                reliable = all(end.qos_profile.reliability == ReliabilityPolicy.RELIABLE for end in ends)
                latched = all(end.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for end in ends)
                found.append(PublishedTopic(topic, kinds[0], len(ends), reliable, latched))
        return found

    def wait(self, seconds: float) -> None:
        """Until a message comes, at most this long."""
        self._came.wait(seconds)
        self._came.clear()

    def subscribe(
        self, topic: str, kind: str, *, reliable: bool, transient_local: bool = False, depth: int = 64
    ) -> RosSubscription:
        """Messages of ``topic`` from now on."""
        subscription = RosSubscription(depth, self._came, self._close)
        self._subscriptions[subscription] = self._node.create_subscription(
            get_message(kind), topic, subscription.on_message, _qos(reliable, transient_local, depth), raw=True
        )
        return subscription

    def publish(
        self,
        topic: str,
        kind: str,
        *,
        reliable: bool = True,
        transient_local: bool = False,
        depth: int = 64,
        patience_s: float = 1.0,
    ) -> RosPublication:
        """A writer of ``topic``. How long it waits for a slow reader is up to the RMW."""
        qos = _qos(reliable, transient_local, depth)
        self._publishers.append(self._node.create_publisher(get_message(kind), topic, qos))
        return RosPublication(self._publishers[-1])

    def close(self) -> None:
        """Neither read nor write any more."""
        for subscription in list(self._subscriptions):
            self._close(subscription)
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)
        self._publishers.clear()

    def _close(self, subscription: RosSubscription) -> None:
        self._node.destroy_subscription(self._subscriptions.pop(subscription))


def _qos(reliable: bool, transient_local: bool, depth: int) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if transient_local else DurabilityPolicy.VOLATILE,
    )
