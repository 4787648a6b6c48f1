"""An open bag: its topics, messages and fixed frames, read through the rosbags library (extra ``ros``)."""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core import geometry
from mapvote.core.extras import require
from mapvote.core.record import record
from mapvote.core.types import F64, I64, MapvoteError
from mapvote.formats.drives.bag_files import bag_files, is_bag, is_bag_without_metadata, mend_of
from mapvote.formats.drives.compressed_cloud import definition_of_compressed
from mapvote.formats.drives.frames import Edges, pose_of_message
from mapvote.formats.drives.point_fields import livox_table, point_cloud_table, serialised_frame, serialised_stamp_ns
from mapvote.formats.drives.ros_types import COMPRESSED, LIVOX, TF
from mapvote.formats.reading import first_line


def is_rosbag(path: Path) -> bool:
    """Whether a bag of any kind lies at ``path``."""
    return is_bag(path) or is_bag_without_metadata(path)


class Bag:
    """An open bag. Closed when the drive that reads from it is gone."""

    def __init__(self, path: Path) -> None:
        reader = require("rosbags.highlevel", "ros", str(path))
        stores = require("rosbags.typesys", "ros", str(path))
        typestore = stores.get_typestore(stores.Stores.LATEST)
        typestore.register(stores.get_types_from_msg(definition_of_compressed(), COMPRESSED))
        files = bag_files(path)
        try:
            self.reader = reader.AnyReader(files.paths, default_typestore=typestore)
            self.reader.open()
        except Exception as error:  # rosbags passes on the exceptions of its storages
            raise MapvoteError(
                f"{path}: not a readable bag ({first_line(error)}); was the recording stopped properly? Try: "
                f"{mend_of(path)}"
            ) from error
        weakref.finalize(self, self.reader.close)
        self.path = path
        self.passes = 0
        """How often reading began: a pass over an MCAP without an index is lost where another one begins."""
        self.mended = files.mended
        """Faults of its files that do not stop the reading."""

    def decode(self, connection: Any, data: bytes) -> Any:
        """A serialised message; MapvoteError if it is damaged."""
        try:
            return self.reader.deserialize(data, connection.msgtype)
        except Exception as error:  # rosbags raises the exceptions of struct, numpy and its own parsers
            raise MapvoteError(
                f"{self.path}: {connection.topic}: a message is damaged ({first_line(error)}); copy the bag again"
            ) from error

    def topics(self, *types: str) -> dict[str, int]:
        """Topics of these message types, with their number of messages."""
        return {name: t.msgcount for name, t in sorted(self.reader.topics.items()) if t.msgtype in types}

    def raw(self, *topics: str, **window: int) -> Iterator[tuple[Any, int, bytes]]:
        """(connection, receive time ns, bytes) one by one; ``start``, ``stop`` bound the receive time."""
        self.passes += 1
        return self._read(topics, window)

    def _read(self, topics: Sequence[str], window: dict[str, int]) -> Iterator[tuple[Any, int, bytes]]:
        connections = [c for c in self.reader.connections if c.topic in topics]
        try:
            yield from self.reader.messages(connections=connections, **window)
        except MapvoteError:
            raise
        except Exception as error:  # whatever zstd, lz4, sqlite and struct raise
            raise MapvoteError(
                f"{self.path}: {', '.join(topics)}: damaged ({type(error).__name__}: {first_line(error)}); copy it "
                f"again"
            ) from error

    def messages(self, topic: str, **window: int) -> Iterator[tuple[int, Any]]:
        """(receive time ns, message) one by one."""
        for connection, time_ns, data in self.raw(topic, **window):
            yield time_ns, self.decode(connection, data)

    def points(self, source: str, connection: Any, data: bytes) -> NDArray[np.void]:
        """The points (n,) of a serialised cloud of one of CLOUDS, with their fields."""
        if connection.msgtype in LIVOX:
            return livox_table(source, data, ros2=self.reader.is2)
        return point_cloud_table(source, self.decode(connection, data))

    def frame_id(self, data: bytes) -> str:
        """The frame in the header of a serialised message, without reading the rest."""
        return serialised_frame(data, ros2=self.reader.is2)

    def stamp_ns(self, data: bytes) -> int:
        """The stamp in the header of a serialised message, without reading the rest."""
        return serialised_stamp_ns(str(self.path), data, ros2=self.reader.is2)


@record()
@dataclass(frozen=True, slots=True)
class ReadAhead:
    """How far messages are read ahead of those that are wanted."""

    opened_ns: int = 2_000_000_000
    """The part of a file that is opened at a time, nanoseconds of receipt."""
    kept: int = 4
    """Messages a topic that are kept when they are passed over: others were received before them."""


READ_AHEAD = ReadAhead()


class NextMessages:
    """Messages of some topics that are wanted nearly in the order of their receipt: the parts of a file in which they
    lie are read and decompressed once, not once for each message."""

    def __init__(self, bag: Bag, topics: Sequence[str], rule: ReadAhead = READ_AHEAD) -> None:
        self._bag = bag
        self._topics = topics
        self._rule = rule
        self._rows: Iterator[tuple[Any, int, bytes]] = iter(())
        self._pass = -1
        self._at_ns = 0
        """Receipt of the last message that was read."""
        self._until_ns = 0
        self._kept: dict[tuple[str, int, int], tuple[Any, bytes]] = {}
        self.frames: dict[str, str] = {}
        """The frame of each topic, once a message of it was read."""

    def read(self, topic: str, received_ns: int, header_ns: int) -> tuple[Any, bytes] | None:
        """(connection, bytes) of the message that was received then with this stamp in its header; None without one.
        MapvoteError if the file is damaged there."""
        wanted = topic, received_ns, header_ns
        message = self._read_on(wanted)
        if message is None:
            self._kept.clear()
            self._rows = self._bag.raw(*self._topics, start=received_ns, stop=received_ns + self._rule.opened_ns)
            self._pass = self._bag.passes
            self._at_ns = received_ns
            self._until_ns = received_ns + self._rule.opened_ns
            message = self._read_on(wanted)
        return message

    def _read_on(self, wanted: tuple[str, int, int]) -> tuple[Any, bytes] | None:
        """The same, among what was kept and what follows in the open part."""
        if wanted in self._kept:
            return self._kept.pop(wanted)
        if self._pass != self._bag.passes or not self._at_ns <= wanted[1] < self._until_ns:
            return None
        for connection, received_ns, data in self._rows:
            self._at_ns = received_ns
            read = connection.topic, received_ns, self._bag.stamp_ns(data)
            if read == wanted:
                return connection, data
            self._kept[read] = connection, data
            if len(self._kept) > self._rule.kept * len(self._topics):
                del self._kept[next(iter(self._kept))]
            if received_ns > wanted[1]:
                break
        return None


def stamps_of(bag: Bag, topics: Iterable[str]) -> dict[str, I64]:
    """(n, 3) of each topic: the stamp in the header and the time of receipt of every message, nanoseconds, and its size
    in bytes, as received."""
    rows: dict[str, list[tuple[int, int, int]]] = {topic: [] for topic in topics}
    for connection, received_ns, data in bag.raw(*rows):
        rows[connection.topic].append((bag.stamp_ns(data), received_ns, len(data)))
    return {topic: np.array(of_topic, dtype=np.int64).reshape(-1, 3) for topic, of_topic in rows.items()}


def frame_id(bag: Bag, topic: str, *, child: bool = False) -> str:
    """The frame of a topic's first message; ``child``: what an Odometry tracks, "" where the message does not say."""
    if child:
        return next((str(getattr(m, "child_frame_id", "")).strip("/") for _, m in bag.messages(topic)), "")
    return next((bag.frame_id(data).strip("/") for _, _, data in bag.raw(topic)), "")


def static_frames(bag: Bag) -> Edges:
    """From each frame of /tf_static to its neighbours, with T_frame_neighbour (4, 4), both ways."""
    edges: Edges = {}
    for topic in bag.topics(TF):
        if not topic.endswith("tf_static"):
            continue
        for _, message in bag.messages(topic):
            for t in message.transforms:
                T = matrix_in(bag, topic, t.transform.translation, t.transform.rotation)
                parent = t.header.frame_id.strip("/")
                child = t.child_frame_id.strip("/")
                edges.setdefault(parent, []).append((child, T))
                edges.setdefault(child, []).append((parent, geometry.inverse(T)))
    return edges


def matrix_in(bag: Bag, topic: str, p: Any, q: Any) -> F64:
    """T (4, 4) of the position and quaternion of a message. MapvoteError names the topic where they are no pose."""
    if not np.any([q.x, q.y, q.z, q.w]):
        raise MapvoteError(
            f"{bag.path}: {topic} holds a quaternion of zeros, which is no rotation: correct its publisher, or choose "
            f"another topic (poses: --prior TOPIC or --prior none; LiDARs: --topic)"
        )
    return pose_of_message(p, q)
