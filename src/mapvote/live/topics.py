"""Which topics of ROS 2 are published on this network, how often, and which of them a drive subscribes to."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mapvote.core.types import MapvoteError
from mapvote.live.cdr import TYPES, from_cdr
from mapvote.live.dds import Network, PublishedTopic, Subscription
from mapvote.live.messages import CLOUD, ODOMETRY


@dataclass(frozen=True, slots=True)
class TopicRate:
    """What was received of a topic."""

    published: PublishedTopic
    messages: int
    rate_hz: float | None
    """None: its type is none of those that are read here."""
    frame: str
    """The frame of the last message; "" where its type has none."""


def measure_rates(network: Network, seconds: float) -> list[TopicRate]:
    """Every published topic, subscribed to for so long. A topic that appears meanwhile counts from there on."""
    readers: dict[tuple[str, str], Subscription] = {}
    counts: dict[tuple[str, str], int] = {}
    frames: dict[tuple[str, str], str] = {}
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for one in network.published():
            name = one.topic, one.kind
            if one.kind in TYPES and name not in readers:
                durable = one.transient_local
                readers[name] = network.subscribe(*name, reliable=one.reliable, transient_local=durable, depth=8)
        network.wait(0.05)
        for name, reader in readers.items():
            for _, data in reader.take():
                counts[name] = counts.get(name, 0) + 1
                frames[name] = _frame(name[1], data)
    out = []
    for one in network.published():
        name = one.topic, one.kind
        n = counts.get(name, 0)
        out.append(TopicRate(one, n, n / seconds if name in readers else None, frames.get(name, "")))
    return out


def _frame(kind: str, data: memoryview) -> str:
    try:
        return str(getattr(getattr(from_cdr(kind, data), "header", None), "frame_id", ""))
    except MapvoteError as error:
        return f"damaged: {error}"


def missing_for_drive(rates: list[TopicRate]) -> list[str]:
    """What a vehicle needs and does not receive, a sentence each; empty if nothing is missing."""
    if not rates:
        return [
            "no topic is sent in this domain: check ROS_DOMAIN_ID (here and there the same), and that CYCLONEDDS_URI "
            "names an interface that the senders use"
        ]
    received = {one.published.kind for one in rates if one.messages}
    out = []
    if CLOUD not in received:
        out.append(f"no {CLOUD} comes: start the LiDAR's driver")
    if ODOMETRY not in received:
        out.append(f"no {ODOMETRY} comes: without a prior the whole map is searched at the start")
    if not any(one.published.topic == "/tf_static" and one.messages for one in rates):
        out.append("no /tf_static comes: odometry is taken for the LiDAR's own pose")
    return out


@dataclass(frozen=True, slots=True)
class Chosen:
    """The topics of one vehicle."""

    points: tuple[PublishedTopic, ...]
    """The first LiDAR's is the one in whose frame scans are."""
    odometry: PublishedTopic | None


def choose_topics(
    network: Network, points: Sequence[str], odometry: str | None, patience_s: float, ended: Callable[[], bool]
) -> Chosen | None:
    """The topics named, else the only ones of their types; None if ``ended`` first. MapvoteError lists the published
    ones if these do not come."""
    end = time.monotonic() + patience_s
    while not ended():
        published = network.published()
        clouds = [one for one in published if one.kind == CLOUD and (not points or one.topic in points)]
        poses = [one for one in published if one.kind == ODOMETRY and odometry in (None, one.topic)]
        late = time.monotonic() > end
        if len(clouds) >= max(len(points), 1) and (poses or late):
            break
        if late:
            listed = ", ".join(f"{one.topic} [{one.kind}]" for one in published) or "nothing"
            wanted = ", ".join(points) or CLOUD
            raise MapvoteError(f"no topic {wanted} in DDS domain {network.domain}; sent there: {listed}")
        network.wait(0.1)
    else:
        return None
    if not points and len(clouds) > 1:
        names = ",".join(one.topic for one in clouds)
        raise MapvoteError(f"several LiDARs: choose one, or join several, with --points {names}")
    if len(poses) > 1:
        raise MapvoteError(f"several topics; choose with --odometry: {', '.join(one.topic for one in poses)}")
    if odometry is not None and not poses:
        raise MapvoteError(f"no topic {odometry} of {ODOMETRY} in DDS domain {network.domain}")
    by_name = {one.topic: one for one in clouds}
    return Chosen(tuple(by_name[name] for name in points or by_name), poses[0] if poses else None)
