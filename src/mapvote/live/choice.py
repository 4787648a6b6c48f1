"""The topics of a vehicle: those named, else the only ones of their types; and a voice for what is missing.

While something is missing, a sentence says what, what is heard instead, and what to type: after 5 s and each minute.
"""

from __future__ import annotations

import difflib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from mapvote.core.record import record
from mapvote.core.types import MapvoteError
from mapvote.formats.drives.compressed_cloud import one_of_each_cloud, republished, unread_format
from mapvote.formats.drives.ros_types import CLOUD, CLOUDS, COMPRESSED, GNSS, IMU, ODOMETRY, POSES, TF
from mapvote.live.dds import Network, PublishedTopic, Subscription, TopicRate
from mapvote.live.messages import POSE_TOPIC
from mapvote.live.names import RosNames


@record()
@dataclass(frozen=True, slots=True)
class Waits:
    """How long a vehicle waits for its topics."""

    first_word_s: float = 5.0
    """Time until the first sentence on a missing topic, seconds."""
    each_s: float = 60.0
    """Between two sentences on the same lack, seconds."""
    settle_s: float = 2.0
    """From the first cloud topic until the choice, so that a second LiDAR can appear, seconds."""
    silent_s: float = 2.0
    """From the subscription to a cloud topic until it counts as silent, seconds."""
    odometry_s: float = 10.0
    """From the first cloud topic until the drive begins without odometry, seconds."""


WAITS = Waits()
_UNREAD = {
    "Packet": "start the part of the driver that makes PointCloud2 of packets",
    "VelodyneScan": "start velodyne_pointcloud, which makes PointCloud2 of packets",
    "PandarScan": "start the part of the driver that makes PointCloud2 of packets",
    "HesaiScan": "start the part of the driver that makes PointCloud2 of packets",
    "RslidarScan": "start the part of the driver that makes PointCloud2 of packets",
    "LaserScan": "a scanner of one plane cannot vote: choose a LiDAR in 3D",
}
"""The mend for a message type that holds points but is not read, by a part of its name."""


class Voice:
    """Says what a drive waits for."""

    def __init__(self, say: Callable[[str], object], patience: Waits = WAITS) -> None:
        self._say = say
        self.patience = patience
        self._since_s: float | None = None
        self._said_s = float("-inf")
        self._said = ""

    def lacks(self, text: str) -> None:
        """Called each round with the sentence on the missing topic; "" if none is missing."""
        now_s = time.monotonic()
        if not text:
            self._since_s = None
            return
        if self._since_s is None:
            self._since_s = now_s
        changed = text != self._said
        early = now_s - self._since_s < self.patience.first_word_s
        pause_s = self.patience.first_word_s if changed else self.patience.each_s
        if not early and now_s - self._said_s >= pause_s:
            self._say(f"waiting: {text}")
            self._said = text
            self._said_s = now_s


@dataclass(frozen=True, slots=True)
class Wish:
    """The topics that the user names."""

    points: tuple[str, ...] = ()
    """Full names; (): the only one."""
    odometry: str | None = None
    """Full name; None: the only one, if any comes."""
    names: RosNames = field(default_factory=RosNames)
    on_earth: bool = True
    """Whether the place of the map on Earth is known: without it, fixes of GNSS are of no use."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """The topics of one vehicle."""

    points: tuple[PublishedTopic, ...]
    """The first LiDAR's is the one in whose frame scans are."""
    odometry: PublishedTopic | None
    """A topic of poses, or of fixes."""
    imu: PublishedTopic | None = None
    """Headings beside fixes."""


def choose_topics(
    network: Network, wish: Wish, voice: Voice, ended: Callable[[], bool], limit_s: float = float("inf")
) -> Chosen | None:
    """The topics of ``wish``; None if ``ended`` first. MapvoteError if there is a choice to make, or if something is
    missing after ``limit_s``."""
    listening = _Listening(network, voice.patience)
    try:
        return _choose(network, wish, voice, ended, limit_s, listening)
    finally:
        listening.close()


class _Listening:
    """Whether the clouds that are announced are sent, while the drive waits for odometry."""

    def __init__(self, network: Network, waits: Waits) -> None:
        self._network = network
        self._waits = waits
        self._readers: dict[str, tuple[Subscription, float]] = {}
        self._heard: set[str] = set()

    def silent(self, clouds: Sequence[PublishedTopic]) -> str:
        """The lack of the first of ``clouds`` that sends nothing; "" if each sends, or may still do."""
        now_s = time.monotonic()
        for one in clouds:
            if one.topic not in self._readers:
                reader = self._network.subscribe(one.topic, one.kind, reliable=one.reliable, depth=1)
                self._readers[one.topic] = reader, now_s
            reader, since_s = self._readers[one.topic]
            if one.topic not in self._heard and reader.take():
                self._heard.add(one.topic)
            if one.topic not in self._heard and now_s - since_s > self._waits.silent_s:
                return f"{one.topic} is announced but sends no cloud: is the LiDAR on?"
        return ""

    def close(self) -> None:
        """Read no more."""
        for reader, _ in self._readers.values():
            reader.close()


def _choose(
    network: Network, wish: Wish, voice: Voice, ended: Callable[[], bool], limit_s: float, listening: _Listening
) -> Chosen | None:
    """:func:`choose_topics`."""
    start_s = time.monotonic()
    seen_s = float("inf")
    while not ended():
        published = network.published()
        clouds = _clouds(published, wish)
        poses = _poses(published, wish)
        now_s = time.monotonic()
        if clouds:
            seen_s = min(seen_s, now_s)
        text = lack_of_clouds(published, wish, network.domain)
        if not text and not poses:
            text = listening.silent(clouds) or lack_of_odometry(published, wish, voice.patience)
        settled = now_s - seen_s >= (voice.patience.settle_s if not wish.points else 0.0)
        hopeless = wish.odometry is None and now_s - seen_s >= voice.patience.odometry_s
        if len(clouds) >= max(len(wish.points), 1) and settled and (poses or hopeless):
            sources = poses or _fixes(published, wish) or _moving_frames(published, wish)
            return _with_imu(_only(clouds, sources, wish), published, wish)
        voice.lacks(text)
        if text and now_s - start_s > limit_s:
            raise MapvoteError(text)
        network.wait(0.1)
    return None


def _of_kinds(
    published: Sequence[PublishedTopic], kinds: Sequence[str], wanted: Sequence[str], names: RosNames
) -> list[PublishedTopic]:
    """The topics of these kinds: those ``wanted``, else all in the namespace but our own."""
    own = names.resolve(POSE_TOPIC)
    return [
        one
        for one in published
        if one.kind in kinds and (one.topic in wanted if wanted else names.holds(one.topic) and one.topic != own)
    ]


def _clouds(published: Sequence[PublishedTopic], wish: Wish) -> list[PublishedTopic]:
    """The topics of clouds: those of ``wish``, else one for each LiDAR."""
    clouds = _of_kinds(published, CLOUDS, wish.points, wish.names)
    one_each = one_of_each_cloud({one.topic: one.kind for one in clouds})
    return [one for one in clouds if (one.topic in one_each or wish.points) and not unread_format(one.topic)]


def _poses(published: Sequence[PublishedTopic], wish: Wish) -> list[PublishedTopic]:
    """The topics of poses that the vehicle may use; of moving frames only the one that is named."""
    if wish.odometry is None:
        return _of_kinds(published, POSES, (), wish.names)
    return _of_kinds(published, (*POSES, GNSS, TF), (wish.odometry,), wish.names)


def _fixes(published: Sequence[PublishedTopic], wish: Wish) -> list[PublishedTopic]:
    """The topics of fixes, which bound the place if no pose is sent."""
    return _of_kinds(published, (GNSS,), (), wish.names) if wish.on_earth else []


def _with_imu(chosen: Chosen, published: Sequence[PublishedTopic], wish: Wish) -> Chosen:
    """The choice with the only IMU, where fixes need its headings."""
    if chosen.odometry is None or chosen.odometry.kind != GNSS:
        return chosen
    imus = _of_kinds(published, (IMU,), (), wish.names)
    return replace(chosen, imu=imus[0] if len(imus) == 1 else None)


def _moving_frames(published: Sequence[PublishedTopic], wish: Wish) -> list[PublishedTopic]:
    """The topic of moving frames, which say where the vehicle is if nothing else does."""
    names = {wish.names.resolve("/tf"), wish.names.resolve("tf")}
    return [one for one in published if one.kind == TF and one.topic in names][:1]


def _only(clouds: list[PublishedTopic], poses: list[PublishedTopic], wish: Wish) -> Chosen:
    """The choice, where there is one. MapvoteError names the option that chooses."""
    if not wish.points and len(clouds) > 1:
        listed = ",".join(one.topic for one in clouds)
        raise MapvoteError(f"several LiDARs: choose one, or join several, with --points {listed}")
    whole = [one for one in poses if one.kind == ODOMETRY] or poses
    if len(whole) > 1:
        listed = ", ".join(one.topic for one in whole)
        raise MapvoteError(f"several topics of poses; choose with --odometry: {listed}")
    by_name = {one.topic: one for one in clouds}
    return Chosen(tuple(by_name[name] for name in wish.points or by_name), whole[0] if whole else None)


def lack_of_clouds(published: Sequence[PublishedTopic], wish: Wish, domain: int) -> str:
    """The missing LiDAR topics, those that are heard, and the option to type; "" if none is missing."""
    if not published:
        return (
            f"no topic is sent in DDS domain {domain}. Check that ROS_DOMAIN_ID is the same here and there, that "
            "ROS_LOCALHOST_ONLY and ROS_AUTOMATIC_DISCOVERY_RANGE let this machine hear the other one, and that "
            "CYCLONEDDS_URI names an interface that the senders use; or type --domain N"
        )
    for name in wish.points:
        form = unread_format(name) if any(one.topic == name and one.kind == COMPRESSED for one in published) else ""
        text = f"{name} is compressed by {form}: {republished(form)}" if form else ""
        text = text or _lack_of(name, CLOUDS, published, "--points")
        if text:
            return text
    if wish.points or _clouds(published, wish):
        return ""
    compressed = [one for one in _of_kinds(published, CLOUDS, (), wish.names) if unread_format(one.topic)]
    if compressed:
        form = unread_format(compressed[0].topic)
        return f"{compressed[0].topic} is compressed by {form}: {republished(form)}"
    unread = [(one, hint) for one in published for part, hint in _UNREAD.items() if part in one.kind]
    if unread:
        one, hint = unread[0]
        return f"no {CLOUD} is sent, but {one.topic} [{one.kind}], which is not read: {hint}"
    elsewhere = [one.topic for one in published if one.kind in CLOUDS]
    if elsewhere:
        return f"no {CLOUD} is sent below {wish.names.namespace}, but {elsewhere[0]}: type --points {elsewhere[0]}"
    return f"no {CLOUD} is sent: start the LiDAR's driver. Heard: {_listed(published)}"


def lack_of_odometry(published: Sequence[PublishedTopic], wish: Wish, waits: Waits = WAITS) -> str:
    """The missing topic of poses, and the option to type."""
    if wish.odometry is not None:
        return _lack_of(wish.odometry, (*POSES, GNSS, TF), published, "--odometry")
    fixes = _fixes(published, wish)
    if fixes:
        return (
            f"no {ODOMETRY} or other pose is sent. {waits.odometry_s:.0f} s after the first cloud the drive begins "
            f"with the fixes of {fixes[0].topic}; or type --odometry {fixes[0].topic}"
        )
    moving = _moving_frames(published, wish)
    if moving:
        return (
            f"no {ODOMETRY} or other pose is sent. {waits.odometry_s:.0f} s after the first cloud the drive begins "
            f"with the frames that move on {moving[0].topic}; or type --odometry {moving[0].topic}"
        )
    useless = [one.topic for one in _of_kinds(published, (GNSS,), (), wish.names)]
    reason = (
        f" {useless[0]} is of no use: the map's place on Earth is unknown (import --crs EPSG:n)." if useless else ""
    )
    return (
        f"no {ODOMETRY} or other pose is sent.{reason} The drive begins without it {waits.odometry_s:.0f} s after the "
        "first cloud, and the whole map is searched; or start the odometry, or type --odometry TOPIC"
    )


def _lack_of(name: str, kinds: Sequence[str], published: Sequence[PublishedTopic], option: str) -> str:
    """Why the named topic cannot be used, and what to type instead; "" if it can."""
    same = [one for one in published if one.topic == name]
    if any(one.kind in kinds for one in same):
        return ""
    usable = [one.topic for one in published if one.kind in kinds]
    if same:
        hint = next((hint for part, hint in _UNREAD.items() if part in same[0].kind), "")
        other = hint or (f"type {option} {usable[0]}" if usable else f"needed is {kinds[0]}")
        return f"{name} is sent as {same[0].kind}, which is not read for {option}: {other}"
    near = difflib.get_close_matches(name, usable, 1, 0.6) or usable[:1]
    if near:
        return f"nobody sends {name}; type {option} {near[0]}. Heard: {_listed(published)}"
    return f"nobody sends {name}, and no {kinds[0]} at all. Heard: {_listed(published)}"


def _listed(published: Sequence[PublishedTopic]) -> str:
    """The topics that are heard, with their types."""
    most = 12
    listed = ", ".join(f"{one.topic} [{one.kind}]" for one in published[:most])
    more = len(published) - most
    return f"{listed} and {more} more" if more > 0 else listed or "nothing"


def missing_for_drive(rates: Sequence[TopicRate], domain: int = 0) -> list[str]:
    """Topics that a vehicle needs and does not receive, a sentence each; empty if none is missing."""
    text = lack_of_clouds([one.published for one in rates], Wish(), domain)
    if not rates:
        return [text]
    received = {one.published.kind for one in rates if one.messages}
    out = [text] if text else []
    if not text and not received & set(CLOUDS):
        out.append(f"no {CLOUD} comes, though its topic is announced: start the LiDAR's driver")
    if not received & set(POSES):
        out.append(f"no {ODOMETRY} or other pose comes: without a prior the whole map is searched at the start")
    if not any(
        one.published.kind == TF and one.published.topic.endswith("/tf_static") and one.messages for one in rates
    ):
        out.append("no /tf_static comes: odometry is taken for the LiDAR's own pose")
    return out
