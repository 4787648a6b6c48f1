"""The examples do what they say: the node's logic without ROS, the notebook's cells, the deployment files' words."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rosbags.typesys import Stores, get_typestore
from typer.main import get_command

from mapvote import MapvoteError, Scan, Sensor, scan_from_point_cloud2
from mapvote.cli import app

EXAMPLES = Path(__file__).parents[2] / "examples"
STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES: dict[str, Any] = dict(STORE.types)
SENSOR = Sensor("hdl32e", tuple(np.linspace(10.67, -30.67, 32)), 0.5)


def street(seed: int = 0) -> np.ndarray[Any, np.dtype[np.float64]]:
    """A street of 80 m with walls and trees; every seed measures other points of it."""
    rng, n = np.random.default_rng(seed), 12_000
    road = np.column_stack([rng.uniform(-40, 40, n), rng.uniform(-8, 8, n), rng.normal(0, 0.01, n)])
    walls = [
        np.column_stack([rng.uniform(-40, 40, n), side + rng.normal(0, 0.01, n), rng.uniform(0, 5, n)])
        for side in (-8.0, 8.0)
    ]
    places = np.random.default_rng(1).uniform([-38, -7], [38, 7], (40, 2))
    places = places[np.abs(places[:, 1]) > 2.5]
    turn, height = rng.uniform(0, 2 * np.pi, (2, len(places), 250)) * np.array([1.0, 0.5]).reshape(2, 1, 1)
    x, y = places[:, :1] + 0.4 * np.cos(turn), places[:, 1:] + 0.4 * np.sin(turn)
    trees = np.column_stack([x.ravel(), y.ravel(), height.ravel()])
    return np.concatenate([road, *walls, trees])


def header(ns: int, frame: str) -> Any:
    return TYPES["std_msgs/msg/Header"](TYPES["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9), frame)


def cloud(points: np.ndarray[Any, Any], ns: int, *, cut: int = 0) -> Any:
    """A message that went over the wire and back, as rosbags' typestore has it."""
    table = np.zeros(
        len(points), dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2")]
    )
    for i, axis in enumerate("xyz"):
        table[axis] = points[:, i]
    table["intensity"], table["ring"] = 51.0, np.arange(len(points)) % 32
    field = TYPES["sensor_msgs/msg/PointField"]
    fields = [
        field(n, o, k, 1) for n, o, k in (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4))
    ]
    raw = np.frombuffer(table.tobytes(), dtype=np.uint8)
    raw = raw[: len(raw) - cut]
    message = TYPES["sensor_msgs/msg/PointCloud2"](
        header(ns, "lidar"), 1, len(points), fields, False, 18, 18 * len(points), raw, True
    )
    name = "sensor_msgs/msg/PointCloud2"
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, name), name)


def test_a_cloud_message_becomes_a_scan() -> None:
    points = street()[:500] + np.array([0.0, 8.0, 0.0])
    scan = scan_from_point_cloud2(cloud(points, 1_700_000_000_123_456_789), SENSOR)
    assert isinstance(scan, Scan)
    assert scan.stamp_ns == 1_700_000_000_123_456_789
    assert scan.ring is not None
    assert np.allclose(scan.fields["intensity"], 0.2)
    with pytest.raises(MapvoteError, match="cut off"):
        scan_from_point_cloud2(cloud(points, 1, cut=7), SENSOR)


@pytest.mark.slow
def test_the_notebook_runs_from_top_to_bottom() -> None:
    cells = json.loads((EXAMPLES / "live_vehicle.ipynb").read_text())["cells"]
    names: dict[str, Any] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert names["ballot"].scans_localised == 12
    assert len(names["ballot"].tiles) > 0


def test_deployment_files_use_verbs_options_and_extras_that_exist() -> None:
    verbs = get_command(app).commands  # type: ignore[attr-defined]
    compose = yaml.safe_load((EXAMPLES / "compose.yaml").read_text())["services"]
    started = [(compose["mapvote"]["command"].replace('"', " ").split(), "serve")]
    for name, verb in (("mapvote.service", "serve"), ("mapvote-drive.service", "drive")):
        unit = (EXAMPLES / name).read_text().replace("\\\n", " ")
        started.append((re.findall("^ExecStart=(.*)", unit, re.M)[0].split(), verb))
    for words, verb in started:
        after = words[words.index(verb) + 1 :]
        known = {option for parameter in verbs[verb].params for option in parameter.opts}
        assert {word for word in after if word.startswith("--")} <= known
    extras = tomllib.loads((EXAMPLES.parent / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {"server", "postgres", "geo"} <= set(extras)
    assert "MAPVOTE_STORE" in compose["mapvote"]["environment"]
