"""Messages of ROS 2 as another implementation writes them, and over DDS on loopback."""

from __future__ import annotations

import gc
import os
import time

import numpy as np
import pytest

from live.loopback_dds import LOOPBACK, own_domain, until
from mapvote.core.sensors import SENSORS
from mapvote.core.types import MapvoteError, Scan
from mapvote.formats.drives.point_fields import scan_from_point_cloud2
from mapvote.formats.drives.ros_types import CLOUD, LIVOX, TF
from mapvote.live.dds import Network, ros_type
from mapvote.live.messages import READ, blank_message, from_cdr, to_cdr
from mapvote.live.play import cloud_message

pytest.importorskip("cyclonedds")
START = 1_700_000_000_123_456_789


def cloud(n: int = 1000) -> bytes:
    points = np.random.default_rng(4).uniform(5, 30, (n, 3)).astype(np.float32)
    return cloud_message(Scan(START, points))


def test_every_type_that_is_read_has_a_blank_message_that_dds_carries(domain: int) -> None:
    network = Network(domain)
    for kind in sorted(READ):
        blank = to_cdr(kind, blank_message(kind))
        assert kind in LIVOX or to_cdr(kind, from_cdr(kind, blank)) == blank  # those are read as PointCloud2
        network.publish("/any", kind).send(blank)


def test_a_message_that_is_cut_off_or_no_cdr_is_refused_and_says_so() -> None:
    whole = cloud()
    for length in (0, 3, 20, 60, len(whole) - 20):
        with pytest.raises(MapvoteError, match="PointCloud2"):
            from_cdr(CLOUD, whole[:length])
    with pytest.raises(MapvoteError, match="no plain CDR"):
        from_cdr(CLOUD, b"\0\x03" + whole[2:])


def test_only_types_of_ros_2_have_a_ros_2_name() -> None:
    assert ros_type("sensor_msgs::msg::dds_::PointCloud2_") == CLOUD
    assert ros_type("HelloWorld") is None


def test_a_message_is_delivered_once_its_reader_acknowledged_it_and_a_closed_reader_is_gone(domain: int) -> None:
    sender, receiver = Network(domain), Network(domain)
    out = sender.publish("/points", CLOUD)
    incoming = receiver.subscribe("/points", CLOUD, reliable=True, depth=1)
    until(lambda: out.readers and incoming.writers)
    out.send(cloud())
    assert out.delivered(30.0)
    incoming.close()
    until(lambda: not out.readers)


def test_a_cloud_goes_over_dds_and_is_the_scan_that_was_sent(domain: int) -> None:
    sender, receiver = Network(domain), Network(domain)
    out = sender.publish("/points", CLOUD)
    published = until(receiver.published)
    assert [(p.topic, p.kind, p.writers, p.reliable, p.transient_local) for p in published] == [
        ("/points", CLOUD, 1, True, False)
    ]
    incoming = receiver.subscribe("/points", CLOUD, reliable=True)
    until(lambda: out.readers)
    out.send(cloud())
    receiver.wait(5.0)
    ((_, data),) = until(incoming.take)
    scan = scan_from_point_cloud2(from_cdr(CLOUD, data), SENSORS["hdl32e"])
    assert (scan.stamp_ns, len(scan.points)) == (START, 1000)


def test_a_network_that_subscribes_to_nothing_yet_waits_as_long_as_it_is_told(domain: int) -> None:
    start_s = time.monotonic()
    Network(domain).wait(0.1)
    assert time.monotonic() - start_s >= 0.1


def test_joining_a_domain_leaves_the_users_configuration_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    Network(own_domain())
    assert os.environ["CYCLONEDDS_URI"] == LOOPBACK
    monkeypatch.setenv("CYCLONEDDS_URI", "<Domain><NoSuchSetting/></Domain>")
    with pytest.raises(MapvoteError, match="CYCLONEDDS_URI"):
        Network(own_domain())
    assert os.environ["CYCLONEDDS_URI"] == "<Domain><NoSuchSetting/></Domain>"


def test_the_bytes_of_a_message_outlive_its_reader_and_its_network(domain: int) -> None:
    sent, kept = [cloud(n) for n in (1000, 1001)], list[memoryview]()

    def exchange() -> None:
        sender, receiver = Network(domain), Network(domain)
        incoming, out = receiver.subscribe("/points", CLOUD, reliable=True), sender.publish("/points", CLOUD)
        until(lambda: out.readers)
        for one in sent:
            out.send(one)
        while len(kept) < len(sent):
            kept.extend(data for _, data in until(incoming.take))

    exchange()
    gc.collect()
    assert [bytes(data[: len(one)]) for data, one in zip(kept, sent, strict=True)] == sent
    assert all(data.readonly for data in kept)


def test_a_reader_that_comes_late_gets_what_a_durable_writer_sent(domain: int) -> None:
    sender, receiver = Network(domain), Network(domain)
    out = sender.publish("/tf_static", TF, transient_local=True, depth=1)
    out.send(to_cdr(TF, blank_message(TF)))
    incoming = receiver.subscribe("/tf_static", TF, reliable=True, transient_local=True)
    ((_, data),) = until(incoming.take)
    assert from_cdr(TF, data).transforms == []
