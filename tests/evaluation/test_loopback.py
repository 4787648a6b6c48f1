"""A round through a real server process gives the same map, bit for bit, as the offline update on files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapvote.config import Settings
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.point_map import all_points, map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import MapvoteError, Scan
from mapvote.formats import write_map
from mapvote.fusion.fuse import update_map
from mapvote.localisation.localiser import GivenPoses
from mapvote.vehicle import Vehicle
from mapvote_lab.evaluation.evaluate import running_server, vote_by_http


def wall(y: float) -> np.ndarray:
    x, z = np.meshgrid(np.arange(5.05, 25, 0.1), np.arange(0.35, 3.0, 0.1))
    return np.column_stack([x.ravel(), np.full(x.size, y), z.ravel()])


def ground() -> np.ndarray:
    x, y = np.meshgrid(np.arange(0.15, 30, 0.3), np.arange(0.15, 30, 0.3))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


@pytest.mark.slow
def test_by_http_and_by_files_the_map_is_the_same(tmp_path: Path) -> None:
    first_map = map_from_points(np.vstack([ground(), wall(20.05)]), map_id="street")
    write_map(first_map, tmp_path / "map")
    T_map_lidar = from_xyz_rpy(15.0, 4.0, 1.9)
    stamps = np.arange(20, dtype=np.int64) * 100_000_000 + 1_700_000_000_000_000_000
    today = np.vstack([ground(), wall(12.05)]).astype(np.float64)
    points = (today - T_map_lidar[:3, 3]).astype(np.float32)
    ballots = []
    for name in ("v1", "v2", "v3"):
        vehicle = Vehicle(
            name, SENSORS["hdl32e"], first_map, localise=GivenPoses(stamps, np.tile(T_map_lidar, (20, 1, 1)))
        )
        for stamp in stamps:
            vehicle.observe(Scan(int(stamp), points))
        vehicle.finish()
        ballots.append(vehicle.ballot())
    done = vote_by_http(ballots, tmp_path / "map", tmp_path / "server")
    offline, _ = update_map(first_map, ballots, Settings().fuse)
    assert done.held == ""
    assert done.version == 2
    assert len(all_points(offline)) != len(all_points(first_map))
    assert np.array_equal(all_points(done.updated), all_points(offline))


@pytest.mark.slow
def test_a_server_that_cannot_start_says_why(tmp_path: Path) -> None:
    with (
        pytest.raises(MapvoteError, match="did not start"),
        running_server(tmp_path / "s.db", tmp_path / "no map", tmp_path / "log"),
    ):
        pass
