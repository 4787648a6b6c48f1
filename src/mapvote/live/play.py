"""A recorded ROS 2 bag, sent on DDS as it was recorded: the bytes of its messages, at the times of their receipt."""

from __future__ import annotations

import time
from pathlib import Path

from mapvote.core.types import MapvoteError
from mapvote.formats.drives.rosbag import Bag
from mapvote.live.cdr import TYPES
from mapvote.live.dds import Network, Publication

_SEEN_S = 0.5
"""Between the first reader and the first message, so that every reader has found every topic."""


def play(bag_path: Path, network: Network, *, rate: float = 1.0, wait_s: float = 0.0) -> int:
    """Send every message of the types that :data:`mapvote.live.cdr.TYPES` knows; returns how many.

    ``rate``: times as fast as recorded. ``wait_s``: wait so long for a reader at most. MapvoteError if the bag is of
    ROS 1 or holds nothing to send.
    """
    bag = Bag(bag_path)
    if not bag.reader.is2:
        raise MapvoteError(f"{bag_path}: a ROS 1 bag, whose messages are no CDR; convert it with rosbags-convert")
    connections = [c for c in bag.reader.connections if c.msgtype in TYPES]
    if not connections:
        raise MapvoteError(f"{bag_path}: no topic of a type that can be played: {', '.join(sorted(TYPES))}")
    out: dict[str, Publication] = {}
    for c in connections:
        static = c.topic.endswith("tf_static")
        out[c.topic] = out.get(c.topic) or network.publish(c.topic, c.msgtype, transient_local=static)
    end = time.monotonic() + wait_s
    while time.monotonic() < end and not any(publication.readers for publication in out.values()):
        time.sleep(0.05)
    time.sleep(_SEEN_S)
    start, first, count = time.monotonic(), None, 0
    for connection, time_ns, data in bag.reader.messages(connections=connections):
        first = time_ns if first is None else first
        time.sleep(max(0.0, start + 1e-9 * (time_ns - first) / rate - time.monotonic()))
        out[connection.topic].send(bytes(data))
        count += 1
    time.sleep(_SEEN_S)  # a reliable writer that is gone repeats nothing
    return count
