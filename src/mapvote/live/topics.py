"""Which topics of ROS 2 are sent on this network, how often, and what a drive lacks among them."""

from __future__ import annotations

import time
from dataclasses import dataclass

from mapvote.core.types import MapvoteError
from mapvote.live.cdr import TYPES, from_cdr
from mapvote.live.dds import Network, SentTopic, Subscription

CLOUD, ODOMETRY, TF = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"


@dataclass(frozen=True, slots=True)
class Listened:
    """A topic that was listened to."""

    heard: SentTopic
    messages: int
    rate_hz: float | None
    """None: its type is none of those that are read here."""
    frame: str
    """The frame of the last message; "" where its type has none."""


def listen(network: Network, seconds: float) -> list[Listened]:
    """Every topic that is sent, listened to for so long. A topic that appears meanwhile counts from there on."""
    readers: dict[tuple[str, str], Subscription] = {}
    counts: dict[tuple[str, str], int] = {}
    frames: dict[tuple[str, str], str] = {}
    start = time.monotonic()
    while time.monotonic() < start + seconds:
        for heard in network.heard():
            name = heard.topic, heard.kind
            if heard.kind in TYPES and name not in readers:
                readers[name] = network.subscribe(
                    *name, reliable=heard.reliable, transient_local=heard.transient_local, depth=8
                )
        network.wait(0.05)
        for name, reader in readers.items():
            for data in reader.take():
                counts[name] = counts.get(name, 0) + 1
                frames[name] = _frame(reader.kind, data)
    out = []
    for heard in network.heard():
        name = heard.topic, heard.kind
        n = counts.get(name, 0)
        out.append(Listened(heard, n, n / seconds if name in readers else None, frames.get(name, "")))
    return out


def _frame(kind: str, data: memoryview) -> str:
    try:
        return str(getattr(getattr(from_cdr(kind, data), "header", None), "frame_id", ""))
    except MapvoteError as error:
        return f"damaged: {error}"


def missing_for_drive(listened: list[Listened]) -> list[str]:
    """What a vehicle needs and does not hear, a sentence each; empty if nothing is missing."""
    sent = {one.heard.kind for one in listened if one.messages}
    out = []
    if not listened:
        return [
            "no topic is sent in this domain: check ROS_DOMAIN_ID (here and there the same), and that CYCLONEDDS_URI "
            "names an interface that the senders use"
        ]
    if CLOUD not in sent:
        out.append(f"no {CLOUD} comes: start the LiDAR's driver")
    if ODOMETRY not in sent:
        out.append(f"no {ODOMETRY} comes: without a prior the whole map is searched at the start")
    if not any(one.heard.topic == "/tf_static" and one.messages for one in listened):
        out.append("no /tf_static comes: odometry is taken for the LiDAR's own pose")
    return out
