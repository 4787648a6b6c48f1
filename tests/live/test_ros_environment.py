"""Environment variables of ROS 2: what they mean to Cyclone DDS, and errors that name a wrong one."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from live.loopback_dds import LOOPBACK, until
from mapvote.core.types import MapvoteError
from mapvote.formats.drives.ros_types import CLOUD
from mapvote.live.ros_environment import ros_environment


@pytest.mark.parametrize(
    ("variable", "value", "said"),
    [
        *(("ROS_DOMAIN_ID", value, "whole number from 0 to 232") for value in ("abc", "-1", "300", "1.5", "0x1", "²")),
        *(("ROS_LOCALHOST_ONLY", value, "give 1 .* or 0") for value in ("true", "2")),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "localhost", "SUBNET, LOCALHOST, OFF or SYSTEM_DEFAULT"),
        ("ROS_STATIC_PEERS", "10.0.0.1,10.0.0.2", "semicolons"),
        ("ROS_STATIC_PEERS", 'a"/><b', "semicolons"),
        ("CYCLONEDDS_URI", "file:///nowhere/dds.xml", "no file /nowhere/dds.xml"),
    ],
)
def test_a_variable_that_ros_2_would_refuse_or_ignore_is_one_error_that_names_it(
    variable: str, value: str, said: str
) -> None:
    with pytest.raises(MapvoteError, match=f"^{variable}=.*{said}"):
        ros_environment(variables={variable: value})


def test_the_domain_of_the_command_line_wins_and_an_empty_variable_is_none(tmp_path: Path) -> None:
    (tmp_path / "dds.xml").write_text(LOOPBACK)
    assert ros_environment(7, {"ROS_DOMAIN_ID": "abc"}).domain == 7
    assert ros_environment(variables={"ROS_DOMAIN_ID": " 42 "}).domain == 42
    empty = dict.fromkeys(("ROS_DOMAIN_ID", "ROS_STATIC_PEERS", "ROS_AUTOMATIC_DISCOVERY_RANGE", "CYCLONEDDS_URI"), "")
    assert ros_environment(variables=empty) == ros_environment(variables={})
    assert ros_environment(variables={}).domain == 0
    ros_environment(variables={"CYCLONEDDS_URI": f"file://{tmp_path}/dds.xml"})


def test_each_range_of_discovery_is_what_rmw_cyclonedds_makes_of_it() -> None:
    def configured(**variables: str) -> str:
        return ros_environment(variables=variables).configuration

    multicast, local = "<AllowMulticast>false", '<Peer address="localhost"/>'
    peer = '<Peer address="10.0.0.1"/>'
    subnet = configured(ROS_STATIC_PEERS="10.0.0.1;fe80::1%eth0")
    assert (multicast in subnet, local in subnet, peer in subnet) == (False, False, True)
    host = configured(ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST", ROS_STATIC_PEERS="10.0.0.1")
    assert (multicast in host, local in host, peer in host) == (True, True, True)
    only = configured(ROS_LOCALHOST_ONLY="1", ROS_STATIC_PEERS="10.0.0.1", ROS_AUTOMATIC_DISCOVERY_RANGE="OFF")
    assert (multicast in only, local in only, peer in only) == (True, True, False)
    off = configured(ROS_AUTOMATIC_DISCOVERY_RANGE="OFF", ROS_STATIC_PEERS="10.0.0.1")
    assert ("ros_discovery_off_" in off, peer in off) == (True, False)
    assert configured(ROS_AUTOMATIC_DISCOVERY_RANGE="SYSTEM_DEFAULT", ROS_STATIC_PEERS="10.0.0.1") == ""


def test_middleware_that_is_not_read_is_said(caplog: pytest.LogCaptureFixture) -> None:
    ros_environment(variables={"RMW_IMPLEMENTATION": "rmw_zenoh_cpp", "ROS_DISCOVERY_SERVER": "10.0.0.1:11811"})
    first, second = caplog.messages
    assert "10.0.0.1:11811" in first
    assert "rmw_zenoh_cpp" in second
    assert all(record.levelno == logging.WARNING for record in caplog.records)


def test_two_networks_of_this_machine_alone_hear_each_other(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cyclonedds")
    from mapvote.live.dds import Network

    monkeypatch.delenv("CYCLONEDDS_URI")
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    network = Network()
    publication = network.publish("/points", CLOUD)
    listening = Network().subscribe("/points", CLOUD, reliable=True)
    until(lambda: publication.readers and listening.writers)
