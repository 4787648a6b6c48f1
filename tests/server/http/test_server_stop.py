"""SIGTERM while ballots come in and a version is being made: nothing half done, nothing acknowledged lost, and soon."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import httpx2
import numpy as np
import pytest
import sqlalchemy as sa

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from live_server import serving
from mapvote.codec.ballot import Ballot, encode
from mapvote.core.point_map import PointMap
from mapvote.core.types import CellState
from mapvote.server.store import schema
from mapvote.server.store.store import Store
from stores import send

PILLAR = (10, 10)
TILES = [(row, col) for row in range(20) for col in range(20)]


def street() -> PointMap:
    """400 tiles with a pillar each, none like another."""
    pillar = wall([PILLAR], [0.45, 0.75, 1.05])
    return make_map({tile: make_tile(pillar + np.float32(1e-3 * i)) for i, tile in enumerate(TILES)})


def gone_everywhere(point_map: PointMap, vehicle: str) -> Ballot:
    states = states_plane({PILLAR: CellState.CHANGED_EMPTY})
    return make_ballot(point_map, dict.fromkeys(TILES, Say(states)), vehicle, "all", time.time_ns())


def send_until_stopped(url: str, vehicle: str, point_map: PointMap, acknowledged: set[tuple[str, str]]) -> None:
    say = {TILES[0]: Say(states_plane({PILLAR: CellState.UNCHANGED_OCCUPIED}))}
    with httpx2.Client(base_url=url, timeout=30.0) as http:
        for i in range(100_000):
            drive = f"d{i}"
            body = encode(make_ballot(point_map, say, vehicle, drive, time.time_ns()))
            try:
                answer = http.request("PUT", f"/v1/ballots/{vehicle}/{drive}", content=body)
            except httpx2.TransportError:
                return
            assert answer.status_code == 201, answer.text
            acknowledged.add((vehicle, drive))


@pytest.mark.parametrize("after_s", [0.3, pytest.param(1.0, marks=pytest.mark.slow)])
def test_a_stop_under_load_is_soon_and_loses_nothing(tmp_path: Path, after_s: float) -> None:
    point_map = street()
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", point_map)
    send(store, *[gone_everywhere(point_map, vehicle) for vehicle in ("a", "b")])
    acknowledged: set[tuple[str, str]] = set()
    published: list[int] = []
    connected = threading.Event()

    def publish(url: str) -> None:
        with httpx2.Client(base_url=url, timeout=60.0) as http:
            assert http.get("/healthz").status_code == 200
            connected.set()
            published.append(http.request("POST", "/v1/publish", json={"override": True}).status_code)

    (tmp_path / "server.toml").write_text("[server]\ndrives_a_day = 1000000\n")
    with serving(tmp_path / "s.db", "--config", tmp_path / "server.toml", log=tmp_path / "log") as (url, process):
        senders = [
            threading.Thread(target=send_until_stopped, args=(url, f"v{i}", point_map, acknowledged)) for i in range(4)
        ]
        for sender in senders:
            sender.start()
        while len(acknowledged) < 20:
            time.sleep(0.01)
        publisher = threading.Thread(target=publish, args=(url,))
        publisher.start()
        assert connected.wait(30.0)
        time.sleep(after_s)
        process.terminate()
        assert process.wait(300) in (0, -15), "it waits neither for the publish nor for the senders"
        for thread in (*senders, publisher):
            thread.join()
    assert published[0] in (503, 200)
    assert store.current() == (2 if published == [200] else 1)
    assert len(store.point_map().tiles) == len(TILES)
    with store.database.reading() as connection:
        b = schema.ballots.c
        known = {(row.vehicle, row.drive) for row in connection.execute(sa.select(b.vehicle, b.drive))}
    assert acknowledged <= known
    assert "Traceback" not in (tmp_path / "log").read_text()
    store.close()
