"""The map on the way, from a real server: what is ahead comes, what is published comes, and nothing waits for it."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from client.test_map_client import take_down_a_wall
from hand_made import make_map, make_tile, wall
from live.loopback_dds import until
from live_server import serving
from mapvote.client import Manifest, MapClient, Unreachable
from mapvote.config import FuseSettings
from mapvote.live.road_map import RoadMap
from mapvote_server.store.policy import Policy
from mapvote_server.store.store import Store
from stores import WALL, NewStore

TILE_M = 76.8


@pytest.fixture
def store(new_store: NewStore) -> Store:
    """A street of thirty tiles, 2.3 km."""
    tiles = {(0, c): make_tile(wall(WALL, [0.05, 0.45]), 0.001 * c, (0, c)) for c in range(30)}
    return new_store(make_map(tiles), Policy(fuse=FuseSettings(max_deleted_share=1)))


def at(tile: int) -> np.ndarray:
    return np.array([(tile + 0.5) * TILE_M, 10.0, 1.8])


def road_map(url: str, tmp_path: Path, poll_s: float = 60.0) -> RoadMap:
    def client() -> MapClient:
        return MapClient(url, home=tmp_path / "home", attempts=1, timeout_s=5.0)

    return RoadMap(client, poll_s=poll_s)


def test_tiles_come_as_the_vehicle_drives_and_a_version_when_it_is_published(store: Store, tmp_path: Path) -> None:
    with serving(tmp_path / "s.db", log=tmp_path / "log") as (url, _):
        road = road_map(url, tmp_path)
        first = road.current()
        assert not road.covers(at(0))
        until(lambda: road.covers(at(0)), "the tiles around the vehicle did not come")
        until(lambda: road.tiles == 5, "300 m ahead lie five tiles")
        for tile in range(1, 8):
            until(lambda tile=tile: road.covers(at(tile)), f"tile {tile} did not come")  # type: ignore[misc]
        assert set(first.tiles) <= {(0, c) for c in range(12)}
        assert len(first.tiles[0, 7].points) == 6
        until(lambda: road.events, "no events come")
        before = first.tiles[0, 4]
        take_down_a_wall(store, (0, 7))
        until(lambda: road._current.point_map.version == 2, "the new version did not come")
        assert len(first.tiles[0, 7].points) == 6  # the open ballot holds to the version it began with
        second = road.current()
        assert (second.version, len(second.tiles[0, 7].points)) == (2, 3)
        assert second.tiles[0, 4] is before  # what stayed the same is shared
        assert road.covers(at(7))
        road.close()


@pytest.mark.slow
def test_without_a_network_the_vehicle_drives_on_what_it_has_and_polls_until_it_is_back(
    store: Store, tmp_path: Path
) -> None:
    with serving(tmp_path / "s.db", log=tmp_path / "log") as (url, _):
        road = road_map(url, tmp_path)
        road.current()
        road.covers(at(3))
        until(lambda: road.covers(at(3)) and road.tiles == 8, "the tiles around the vehicle did not come")
        road.close()
    away = road_map(url, tmp_path, poll_s=0.05)
    assert away.away
    away.current()
    assert away.covers(at(3))
    assert not away.covers(at(25))
    away.close()
    with pytest.raises(Unreachable):
        road_map(url, tmp_path / "another")


@pytest.mark.slow
def test_closed_in_the_middle_of_a_request_it_lets_that_end(
    store: Store, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    asked = threading.Semaphore(0)

    class Slow(MapClient):
        def manifest(self) -> Manifest:
            asked.release()
            time.sleep(0.3)
            return super().manifest()

    with serving(tmp_path / "s.db", log=tmp_path / "log") as (url, _):
        road = RoadMap(lambda: Slow(url, home=tmp_path / "home", attempts=1, timeout_s=5.0), poll_s=0.05)
        assert asked.acquire(timeout=5.0)  # the first, before the thread starts
        assert asked.acquire(timeout=5.0)
        road.close()
        assert not road._threads[0].is_alive()
    assert not caplog.records
