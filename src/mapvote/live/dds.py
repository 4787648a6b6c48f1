"""Topics of ROS 2 over DDS, by Cyclone DDS (extra ``ros2``): bytes of messages in and out, and who sends what.

Names are ROS 2's: topic /points is ``rt/points`` on the wire, type sensor_msgs/msg/PointCloud2 is
``sensor_msgs::msg::dds_::PointCloud2_``. Topics of services are ``rq/..`` and ``rr/..``, and are named so. The
variables of ROS 2 name domain and range (:mod:`mapvote.live.ros_environment`); CYCLONEDDS_URI names interfaces and
peers.
"""

from __future__ import annotations

import ctypes
import os
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from mapvote.core.extras import require
from mapvote.core.record import record
from mapvote.core.types import MapvoteError
from mapvote.formats.reading import first_line
from mapvote.live.messages import READ, from_cdr, typestore
from mapvote.live.ros_environment import ros_environment


@record()
@dataclass(frozen=True, slots=True)
class DdsDepths:
    """Lengths of queues of DDS."""

    depth: int = 64
    """Messages that a reader or a writer keeps: six seconds of clouds."""
    taken: int = 640
    """Messages that are taken at a time, at most."""


DDS_DEPTHS = DdsDepths()
_ALIVE, _ANY = 16, 0x7F
"""The instance state of a writer that exists; the mask of every sample, view and instance state."""


@dataclass(frozen=True, slots=True)
class PublishedTopic:
    """A topic of ROS 2 that has a writer."""

    topic: str
    kind: str
    """Its message type, such as sensor_msgs/msg/PointCloud2."""
    writers: int
    reliable: bool
    """Whether every writer is."""
    transient_local: bool
    """Whether every writer keeps its last messages for readers that come later."""


class Network:
    """One participant in a DDS domain."""

    def __init__(self, domain: int | None = None) -> None:
        """``domain`` defaults to ROS_DOMAIN_ID, else 0. MapvoteError without cyclonedds, without a network, or if a
        variable of ROS 2 is wrong."""
        environment = ros_environment(domain)
        self._core, self._pub, self._sub, self._topic, self._idl, builtin = (
            require(f"cyclonedds.{name}", "ros2", "ROS 2 topics")
            for name in ("core", "pub", "sub", "topic", "idl", "builtin")
        )
        self.domain = environment.domain
        try:
            with _with_defaults(environment.configuration):
                self._participant = require("cyclonedds.domain", "ros2", "DDS").DomainParticipant(self.domain)
        except Exception as error:
            raise MapvoteError(
                f"DDS domain {self.domain}: cannot be joined ({first_line(error)}). Is a network interface up, is it "
                "the one that CYCLONEDDS_URI names, and is the XML there whole? (The line above tells more)"
            ) from error
        self._own = str(self._participant.guid)
        self._waitset = self._core.WaitSet(self._participant)
        self._writers = builtin.BuiltinDataReader(self._participant, builtin.BuiltinTopicDcpsPublication)
        self._topics: dict[tuple[str, str], Any] = {}
        self._types: dict[str, Any] = {}

    def published(self) -> list[PublishedTopic]:
        """Every topic of ROS 2 that another participant publishes now, in the order of names."""
        offers_of: dict[tuple[str, str], list[Any]] = defaultdict(list)
        for end in self._writers.read(10_000):
            if not end.sample_info.valid_data or end.sample_info.instance_state != _ALIVE:
                continue  # a writer that has gone: its sample names nothing
            topic = end.topic_name.removeprefix("rt")
            kind = ros_type(end.type_name)
            if end.topic_name.startswith("rt/") and kind and str(end.participant_key) != self._own:
                offers_of[topic, kind].append(end.qos)
        policy = self._core.Policy
        return [
            PublishedTopic(
                *name,
                len(offers),
                all(qos[policy.Reliability] != policy.Reliability.BestEffort for qos in offers),
                all(qos[policy.Durability] == policy.Durability.TransientLocal for qos in offers),
            )
            for name, offers in sorted(offers_of.items())
        ]

    def wait(self, seconds: float) -> None:
        """Until one of the subscribed topics has a message, at most this long."""
        if self._waitset.get_entities():
            self._waitset.wait(int(seconds * 1e9))
        else:  # Cyclone DDS returns at once from a set of nothing
            time.sleep(seconds)

    def subscribe(
        self, topic: str, kind: str, *, reliable: bool, transient_local: bool = False, depth: int = DDS_DEPTHS.depth
    ) -> Subscription:
        """Messages of ``topic`` from now on. A reader that requests more than its writers offer receives nothing."""
        qos = self._qos(reliable, transient_local, depth, 0)
        reader = self._sub.DataReader(self._participant, self._topic_of(topic, kind), qos=qos)
        self._waitset.attach(self._core.ReadCondition(reader, _ANY))
        return Subscription(topic, reader)

    def publish(
        self,
        topic: str,
        kind: str,
        *,
        reliable: bool = True,
        transient_local: bool = False,
        depth: int = DDS_DEPTHS.depth,
        patience_s: float = 1.0,
    ) -> Publication:
        """A writer of ``topic``; ``patience_s``: how long it waits for a slow reader, if it is reliable."""
        qos = self._qos(reliable, transient_local, depth, int(1e9 * patience_s))
        return Publication(self._pub.DataWriter(self._participant, self._topic_of(topic, kind), qos=qos))

    def _qos(self, reliable: bool, transient_local: bool, depth: int, patience_ns: int) -> Any:
        policy = self._core.Policy
        return self._core.Qos(
            policy.Reliability.Reliable(patience_ns) if reliable else policy.Reliability.BestEffort,
            policy.Durability.TransientLocal if transient_local else policy.Durability.Volatile,
            policy.History.KeepLast(depth),
            policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
        )

    def _topic_of(self, topic: str, kind: str) -> Any:
        if (topic, kind) not in self._topics:
            name = topic if topic.startswith(("rq/", "rr/")) else f"rt{topic}"
            self._topics[topic, kind] = self._topic.Topic(self._participant, name, self._type(kind))
        return self._topics[topic, kind]

    def _type(self, kind: str) -> Any:
        """The type for Cyclone DDS, which checks each message by it on arrival."""
        if kind not in self._types:
            package, of, name = kind.split("/")
            members = {called: self._member(*of) for called, of in typestore().fielddefs[kind][1]}
            self._types[kind] = self._idl.make_idl_struct(name, f"{package}.{of}.dds_.{name}_", members)
        return self._types[kind]

    def _member(self, shape: Any, of: Any) -> Any:
        if shape.name == "NAME":
            return self._type(of)
        types = require("cyclonedds.idl.types", "ros2", "DDS")
        if shape.name == "BASE":
            return {"string": str, "bool": bool}.get(of[0]) or getattr(types, of[0])
        inner, length = of
        one = self._member(*inner)
        return types.array[one, length] if length else types.sequence[one]


@contextmanager
def _with_defaults(configuration: str) -> Iterator[None]:
    """CYCLONEDDS_URI, which Cyclone DDS reads when a process joins a domain: our defaults, then ROS 2's
    ``configuration``, then the user's. The last one counts."""
    # Cyclone DDS asks for 1 MB. A cloud of 64 beams has 3 MB, and waits in the socket while the process computes. The
    # kernel gives no more than net.core.rmem_max.
    ours = '<Domain id="any"><Internal><SocketReceiveBufferSize max="8MB"/></Internal></Domain>'
    theirs = os.environ.get("CYCLONEDDS_URI")
    os.environ["CYCLONEDDS_URI"] = ",".join(filter(None, (ours, configuration, theirs)))
    try:
        yield
    finally:
        if theirs is None:
            del os.environ["CYCLONEDDS_URI"]
        else:
            os.environ["CYCLONEDDS_URI"] = theirs


class _Span(ctypes.Structure):
    """A piece of memory: POSIX's iovec."""

    _fields_ = (("start", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Sample:
    """One message in the memory of Cyclone DDS. It stays there as long as this object, or an array of its bytes."""

    def __init__(self, library: Any, handle: Any) -> None:
        """``handle``: an owned reference to a ``ddsi_serdata``; it is consumed."""
        self._span = _Span()
        self._handle = ctypes.c_void_p(handle)
        self._at = ctypes.byref(self._span)
        self._give_back = library.ddsi_serdata_to_ser_unref
        size = ctypes.c_size_t(library.ddsi_serdata_size(self._handle))
        library.ddsi_serdata_to_ser_ref(self._handle, ctypes.c_size_t(0), size, self._at)
        library.ddsi_serdata_unref(self._handle)  # the call before took a reference of its own

    @property
    def __array_interface__(self) -> dict[str, Any]:
        """Numpy's protocol. True: read only."""
        return {"version": 3, "typestr": "|u1", "shape": (self._span.length,), "data": (self._span.start, True)}

    def __del__(self) -> None:
        self._give_back(self._handle, self._at)


class Subscription:
    """Messages of one topic, as bytes.

    The Python package of Cyclone DDS copies a message twice, which costs a cloud of 70,000 points 1 ms. Here its C
    library gives the memory in which the message lies.
    """

    def __init__(self, topic: str, reader: Any) -> None:
        self._topic = topic
        self._reader = reader
        internal = require("cyclonedds.internal", "ros2", "DDS")
        self._library = internal.DDS._dll_handle
        self._handles = (ctypes.c_void_p * DDS_DEPTHS.taken)()
        self._infos = (internal.dds_c_t.sample_info * DDS_DEPTHS.taken)()

    def take(self) -> list[tuple[int, memoryview]]:
        """Every message that arrived since the last call: the time at which its writer sent it, nanoseconds since 1970
        by the writer's clock, and its bytes. The oldest are lost if there were too many."""
        count: int = self._library.dds_takecdr(self._reader._ref, self._handles, DDS_DEPTHS.taken, self._infos, _ANY)
        if count < 0:
            raise MapvoteError(f"{self._topic}: DDS cannot read it (error {count})")
        taken = zip(self._infos[:count], self._handles[:count], strict=True)
        samples = [(info, _Sample(self._library, handle)) for info, handle in taken]
        return [(info.source_timestamp, np.asarray(sample).data) for info, sample in samples if info.valid_data]

    def close(self) -> None:
        """Read no more: writers lose this reader at once."""
        self._library.dds_delete(self._reader._ref)

    @property
    def writers(self) -> int:
        """How many send it now."""
        return len(self._reader.get_matched_publications())


class Publication:
    """A writer of one topic."""

    def __init__(self, writer: Any) -> None:
        self._writer = writer
        self._write = require("cyclonedds._clayer", "ros2", "DDS").ddspy_write

    @property
    def readers(self) -> int:
        """How many read it now."""
        return len(self._writer.get_matched_subscriptions())

    def send(self, data: bytes) -> None:
        """One message in CDR, as :func:`mapvote.live.messages.to_cdr` makes it. MapvoteError if DDS refuses it."""
        result = self._write(self._writer._ref, data + bytes(-len(data) % 4))
        if result < 0:
            raise MapvoteError(f"DDS refuses a message of {len(data)} bytes (error {result}); is a reader too slow?")

    def delivered(self, seconds: float) -> bool:
        """Wait so long at most until every reliable reader has everything; returns whether it has."""
        # The package's own wait_for_acks ends in an AttributeError if the time is over.
        return bool(self._writer._wait_for_acks(self._writer._ref, int(seconds * 1e9)) == 0)


def ros_type(type_name: str) -> str | None:
    """sensor_msgs/msg/PointCloud2 of ``sensor_msgs::msg::dds_::PointCloud2_``; None if it is no type of ROS 2."""
    parts = type_name.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return None
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"


@dataclass(frozen=True, slots=True)
class TopicRate:
    """Statistics of a topic that was received."""

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
            if one.kind in READ and name not in readers:
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
