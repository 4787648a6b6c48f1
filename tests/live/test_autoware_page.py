"""Autoware in an afternoon: the page's commands in their order, on a street where a house was taken down."""

from __future__ import annotations

import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml

from live.test_drive import record
from mapvote.core.types import F64, Bool
from mapvote.formats import read_map
from mapvote.formats.geo.frame import MapFrame
from mapvote.formats.maps.autoware import write_autoware
from mapvote.formats.maps.cloud import Cloud
from streets import street, surface

PAGE = Path(__file__).parents[2] / "docs/autoware.md"
NOT_HERE = {
    "python3 -m venv": "it installs from the network",
    "colcon build": "ROS 2 is not here",
    "ros2 launch": "ROS 2 is not here",
    "mapvote log": "tests/shapes/test_affected.py has a map with lanelets",
    "mapvote affected": "tests/shapes/test_affected.py has a map with lanelets",
}
HOUSE = (-3.0, 11.0, 13.0, 16.5)
"""x and y of a house front, from and to."""


def world(seed: int, density: float = 1.0) -> F64:
    """The street, and a wall behind its houses, which is seen once one is gone."""
    rng = np.random.default_rng(seed)
    behind = surface(rng, int(6000 * density), (-45, 17, 0), (45, 17, 8))
    return np.concatenate([street(seed, density), behind])


def of_house(points: F64) -> Bool:
    """Which of the points (n, 3) are of the house, not of the ground below it."""
    x0, y0, x1, y1 = HOUSE
    x, y, z = points.T
    return np.asarray((x > x0) & (x < x1) & (y > y0) & (y < y1) & (z > 0.3))


@contextmanager
def running(line: str, log: Path, until: str) -> Iterator[None]:
    """A command in the background, until it is interrupted as with Ctrl-C; entered once it has said ``until``."""
    with log.open("w") as out:
        process = subprocess.Popen([sys.executable, "-m", *shlex.split(line)], stdout=out, stderr=subprocess.STDOUT)
    try:
        end = time.monotonic() + 120.0
        while until not in log.read_text():
            assert process.poll() is None, f"{line}: {log.read_text()}"
            assert time.monotonic() < end, f"{line}: {log.read_text()}"
            time.sleep(0.1)
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(90)


def run(line: str) -> str:
    result = subprocess.run([sys.executable, "-m", *shlex.split(line)], capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, f"{line}: {result.stdout}{result.stderr}"
    return result.stdout


def tiles_of(folder: Path) -> set[str]:
    return {name for name in yaml.safe_load((folder / "pointcloud_map_metadata.yaml").read_text()) if "pcd" in name}


@pytest.mark.slow
def test_the_page_works_in_its_order(tmp_path: Path, domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cyclonedds")
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    monkeypatch.setenv("PYTHONUNBUFFERED", "1")
    text = PAGE.read_text().replace("127.0.0.1:8080", f"127.0.0.1:{port}")
    blocks = re.findall(r"^```\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines() if not line.startswith(tuple(NOT_HERE))]
    importing, serving, topics, driving, *playing, publishing, loading = lines
    verbs = " ".join(line.split()[1] for line in lines)
    assert verbs == "import serve topics drive play play publish autoware"
    write_autoware(tmp_path / "my_autoware_map", Cloud(world(1), frame=MapFrame()))
    points, odometry = (driving.split(option)[1].split()[0] for option in ("--points ", "--odometry "))
    for bag, seed in (("bag_1", 1000), ("bag_2", 5000)):

        def without_house(i: int, seed: int = seed) -> F64:
            after = world(seed + i, 0.6)
            return after[~of_house(after)]

        record(tmp_path / bag, without_house, points, odometry)
    run(importing)
    server = running(f"{serving} --port {port}", tmp_path / "serve.log", "serving")
    with server, running(loading, tmp_path / "autoware.log", "serving"):
        before = tiles_of(tmp_path / "map")
        for car, line in (("car_1", playing[0]), ("car_2", playing[1])):
            drive = driving.replace("car_1", car)
            log = tmp_path / f"{car}.log"
            with running(drive, log, ""):
                run(f"{line} --rate 0.5")
            assert "at the server" in log.read_text(), log.read_text()
        assert "/map/pointcloud_map_metadata" in run(topics)
        run(publishing)
        end = time.monotonic() + 60.0
        while "version 2" not in (tmp_path / "autoware.log").read_text():
            assert time.monotonic() < end, (tmp_path / "autoware.log").read_text()
            time.sleep(0.2)
        time.sleep(1.0)
    after = tiles_of(tmp_path / "map")
    assert before - after
    assert before & after
    left = np.concatenate([t.points_map for t in read_map(tmp_path / "map").tiles.values()])
    assert of_house(left).sum() < 0.3 * of_house(world(1)).sum()
