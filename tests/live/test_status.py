"""The status of a live drive for others: on DDS, by Prometheus, by systemd, in a terminal."""

from __future__ import annotations

import io
import re
import shlex
import socket
import subprocess
import sys
import time
import urllib.request
from collections import deque
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest
from rich.console import Console
from rosbags.typesys import Stores, get_typestore

from live.test_live_drive import SCANS, Live
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.types import MapvoteError
from mapvote.live.drive import Fixed
from mapvote.live.messages import from_cdr, stamp_ns
from mapvote.live.status import (
    DIAGNOSTICS,
    POSE,
    Heartbeat,
    RosStatus,
    StatusBoard,
    serve_metrics,
)


class Network:
    """Keeps what is published, by topic."""

    def __init__(self) -> None:
        self.sent: dict[str, list[bytes]] = {}

    def publish(self, topic: str, kind: str, *, patience_s: float) -> Any:
        kept = self.sent.setdefault(topic, [])
        return SimpleNamespace(send=kept.append, readers=1)


@pytest.fixture
def driven(tmp_path: Path) -> Any:
    """A drive of some scans, the board that watched it, and what was published."""
    mount = from_xyz_rpy(1.0, 0.0, 2.0, 0.0, 0.0, 0.0)
    live = Live(tmp_path, T_base_lidar=mount)
    live.poses = live.poses @ np.linalg.inv(mount)
    board, network = StatusBoard(live.live._maps, live.outbox), Network()
    topics = SimpleNamespace(clouds=0, map_frame="map", now_ns=time.time_ns)
    ros = RosStatus(network, "car")  # type: ignore[arg-type]
    board.tell(0.0, ros.diagnose)
    for i in range(SCANS):
        live.give(i)
        live.drain()
        topics.clouds += 1
        board(live.live, topics)  # type: ignore[arg-type]
        ros.poses(live.live, topics)  # type: ignore[arg-type]
    live.outbox.close()
    return SimpleNamespace(live=live, board=board, sent=network.sent)


def test_published_messages_are_read_by_ros_2_and_state_how_it_goes(driven: Any) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    said: Any = store.deserialize_cdr(driven.sent["/diagnostics"][-1], DIAGNOSTICS)
    assert {s.name: s.level for s in said.status} == {
        f"mapvote: {about}": 0 for about in ("clouds", "localisation", "load", "disk", "server")
    }
    values = {v.key: v.value for v in said.status[0].values}
    assert values["scans"] == str(SCANS)
    voted = driven.live.live.counts.localised
    assert values["localised"] == str(voted)
    poses = [from_cdr(POSE, data) for data in driven.sent["/mapvote/pose"]]
    assert len(poses) == voted > 4
    for i, message in enumerate(poses):
        true = driven.live.poses[i]
        place = message.pose.pose.position
        assert np.hypot(place.x - true[0, 3], place.y - true[1, 3]) < 0.1
        assert abs(place.z - true[2, 3]) < 0.1
        assert stamp_ns(message.header) == 1_700_000_000 * 10**9 + driven.live.scans[i].stamp_ns
        covariance = message.pose.covariance.reshape(6, 6)
        assert (np.linalg.eigvalsh(covariance) > 0).all()
        assert covariance[0, 0] < 0.01
    assert message.header.frame_id == "map"


def test_trouble_is_an_error_or_a_warning_and_says_why(driven: Any) -> None:
    sound = driven.board.status
    sick = replace(
        sound,
        counts=replace(sound.counts, left_out=3),
        outbox=replace(sound.outbox, failed_writes=1),
        silent_s=5.0,
        localised_share=0.2,
        server_away="no route",
    )
    assert [level for level, _, _ in sound.troubles()] == [0, 0, 0, 0, 0]
    assert [level for level, _, _ in sick.troubles()] == [2, 1, 1, 2, 1]
    assert "no route" in sick.line()
    screen = Console(file=io.StringIO(), width=100)
    screen.print(sick.table("car"))
    assert "none for 5 s" in screen.file.getvalue()  # type: ignore[attr-defined]


def test_prometheus_reads_it_on_loopback(driven: Any) -> None:
    port = serve_metrics(driven.board, 0)
    text = urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5).read().decode()
    assert f"mapvote_drive_scans_total {SCANS}.0" in text
    assert "mapvote_drive_silent_s 0" in text


def test_the_container_is_healthy_while_clouds_come_and_not_without_metrics(driven: Any) -> None:
    file = (Path(__file__).parents[2] / "examples/Containerfile.drive").read_text().replace("\\\n", "")
    check = shlex.split(re.findall(r"HEALTHCHECK .*? CMD (python .*)", file)[0])

    def healthy(port: int) -> bool:
        command = [sys.executable, "-c", check[2].replace("9464", str(port))]
        return subprocess.run(command, stderr=subprocess.DEVNULL).returncode == 0

    assert re.findall(r'"--metrics", "(\d+)"', file) == ["9464"]
    port = serve_metrics(driven.board, 0)
    assert healthy(port)
    driven.board.status = replace(driven.board.status, silent_s=11.0)
    assert not healthy(port)
    assert not healthy(1)


def test_systemd_hears_that_the_service_is_ready_and_alive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(address)
        systemd.settimeout(5)
        monkeypatch.setenv("NOTIFY_SOCKET", address)
        beat = Heartbeat()
        beat()
        assert systemd.recv(100) == b"EXTEND_TIMEOUT_USEC=30000000", "no beat before it is ready: it asks for time"
        beat.ready()
        assert systemd.recv(100) == b"READY=1"
        beat()
        beat()
        assert systemd.recv(100) == b"WATCHDOG=1"
        systemd.setblocking(False)
        with pytest.raises(BlockingIOError):  # once a second
            systemd.recv(100)
        systemd.settimeout(5)
        beat._next_s = 0.0
        numba.njit(lambda x: x + 1.0)(3.0)
        assert systemd.recv(100) == b"WATCHDOG=1", "the loop stands still because a kernel is compiled"
    beat()  # nobody listens any more
    monkeypatch.delenv("NOTIFY_SOCKET")
    Heartbeat()()


def test_a_reader_that_takes_nothing_does_not_end_the_drive(caplog: pytest.LogCaptureFixture) -> None:
    def refused(data: bytes) -> None:
        raise MapvoteError("DDS refuses a message")

    ros = RosStatus(SimpleNamespace(publish=lambda *_, **__: SimpleNamespace(send=refused, readers=1)), "car")  # type: ignore[arg-type]
    fixed = [Fixed(10**9, np.eye(4), np.zeros((6, 6), np.float32))] * 2
    live = SimpleNamespace(fixes=deque(fixed), T_base_upright=np.eye(4))
    ros.poses(live, SimpleNamespace(map_frame="map"))  # type: ignore[arg-type]
    assert not live.fixes
    assert caplog.messages == ["DDS refuses a message"]
