"""A user's day with a server: vote on the map it serves and send the ballot; when it is away, the ballot waits."""

from pathlib import Path

import numpy as np
import pytest

from command_line import typed
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.point_map import map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import MapvoteError
from mapvote.formats import DriveWriter, write_map
from mapvote_lab.evaluation.evaluate import running_server


def street(wall_y: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0.15, 30, 0.3), np.arange(0.15, 30, 0.3))
    along, up = np.meshgrid(np.arange(5.05, 25, 0.1), np.arange(0.35, 3.0, 0.1))
    wall = np.column_stack([along.ravel(), np.full(along.size, wall_y), up.ravel()])
    return np.vstack([np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]), wall])


def drive(folder: Path) -> Path:
    T_map_lidar = from_xyz_rpy(15.0, 4.0, 1.9)
    writer = DriveWriter(folder, vehicle="v1", sensor=SENSORS["hdl32e"], start_ns=1_700_000_000_000_000_000).open()
    rng = np.random.default_rng(1)
    for i in range(20):
        points = street(12.05) - T_map_lidar[:3, 3]
        writer.write_scan(i, (points + rng.normal(0.0, 0.005, points.shape)).astype(np.float32))
    writer.close(writer.start_ns + np.arange(20) * 100_000_000, np.tile(T_map_lidar, (20, 1, 1)))
    return folder


@pytest.mark.slow
def test_a_ballot_goes_to_the_server_whose_map_it_was_cast_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_map(map_from_points(street(20.05), map_id="street"), tmp_path / "map")
    recorded = drive(tmp_path / "v1")
    with running_server(tmp_path / "store.db", tmp_path / "map", tmp_path / "log") as url:
        said = typed("vote", "--trust-prior", recorded, "--map", url, "--send", url)
        again = typed("vote", "--trust-prior", recorded, "--map", url, "--send", url)
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    away = typed("vote", "--trust-prior", recorded, "--map", url, "--send", url, "--vehicle", "v2")
    assert "Version 1 is kept here and used" in away
    assert f"{url} is away: the ballot waits" in away
    assert "20 of 20 scans localised" in said
    assert f"{url}: " in said
    assert f"{url}: " in again  # the same drive twice is harmless


def test_a_ballot_needs_somewhere_to_go(tmp_path: Path) -> None:
    with pytest.raises(MapvoteError, match=r"--out BALLOT, --send URL"):
        typed("vote", "--trust-prior", tmp_path, "--map", tmp_path)
