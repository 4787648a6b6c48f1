"""A real server process that is killed, and one whose database goes away: what it acknowledged is there afterwards."""

from __future__ import annotations

import random
import threading
import time
from pathlib import Path

import httpx2
import pytest
import sqlalchemy as sa

from hand_made import Say, make_ballot, states_plane, two_walls
from live_server import serving
from mapvote.core.ballot import encode
from mapvote.core.types import CellState
from mapvote.fleet import schema
from mapvote.fleet.store import Store
from postgres_cluster import PostgresCluster

pytestmark = pytest.mark.slow
CELLS = [(10, 10), (10, 11), (10, 12)]


def ballot(vehicle: str, drive: str) -> bytes:
    cell = CELLS[len(drive) % 3]
    state = CellState.CHANGED_EMPTY if drive.endswith("0") else CellState.UNCHANGED_OCCUPIED
    say = Say(states_plane({cell: state}))
    return encode(make_ballot(two_walls(), {(0, 0): say}, vehicle, drive, end_ns=time.time_ns() - 10**9))


def put(http: httpx2.Client, vehicle: str, drive: str) -> httpx2.Response:
    return http.request("PUT", f"/v1/ballots/{vehicle}/{drive}", content=ballot(vehicle, drive))


def send_until_dead(url: str, vehicle: str, turn: int, acknowledged: set[tuple[str, str]]) -> None:
    """One drive after another, and a publish now and then, until the server is gone."""
    with httpx2.Client(base_url=url, timeout=10.0) as http:
        for i in range(10_000):
            try:
                answer = put(http, vehicle, f"d{turn}.{i}")
                if i % 10 == 9:
                    http.request("POST", "/v1/publish", json={"override": True})
            except httpx2.TransportError:
                return
            if answer.status_code in (200, 201):
                acknowledged.add((vehicle, f"d{turn}.{i}"))


def test_a_server_killed_while_it_takes_in_ballots_loses_none_that_it_acknowledged(
    database_url: str, tmp_path: Path
) -> None:
    Store.create(database_url, two_walls()).close()
    rng = random.Random(1)
    acknowledged: set[tuple[str, str]] = set()
    for turn in range(3):
        with serving(database_url, log=tmp_path / "log") as (url, process):
            senders = [
                threading.Thread(target=send_until_dead, args=(url, f"v{i}", turn, acknowledged)) for i in range(8)
            ]
            for sender in senders:
                sender.start()
            time.sleep(1.0 + rng.random())
            process.kill()
            for sender in senders:
                sender.join()
    assert len(acknowledged) > 30
    store = Store.open(database_url)
    with store.database.reading() as connection:
        b = schema.ballots.c
        known = {(row.vehicle, row.drive) for row in connection.execute(sa.select(b.vehicle, b.drive))}
    assert acknowledged <= known
    for version in store.versions():
        assert set(store.point_map(version.number).tiles) == set(two_walls().tiles)
    store.close()


def test_a_database_gone_for_ten_seconds_is_503_and_then_all_is_well(
    postgres_cluster: PostgresCluster, postgres_url: str, tmp_path: Path
) -> None:
    Store.create(postgres_url, two_walls()).close()
    with serving(postgres_url, log=tmp_path / "log") as (url, _), httpx2.Client(base_url=url, timeout=60.0) as http:
        assert put(http, "v1", "before").status_code == 201
        postgres_cluster.stop()
        try:
            gone = time.monotonic()
            while time.monotonic() - gone < 10.0:
                refused = put(http, "v1", "during")
                assert refused.status_code == 503
                assert "Retry-After" in refused.headers
                assert "again" in refused.json()["detail"]
                for path in ("/v1/map", "/healthz", "/v1/coverage"):
                    assert http.get(path).status_code == 503
                assert http.request("POST", "/v1/publish", json={}).status_code == 503
                time.sleep(0.5)
        finally:
            postgres_cluster.start()
        assert put(http, "v1", "after").status_code == 201
        assert http.get("/healthz").status_code == 200
    store = Store.open(postgres_url)
    with store.database.reading() as connection:
        assert set(connection.execute(sa.select(schema.ballots.c.drive)).scalars()) == {"before", "after"}
    store.close()
    assert "Traceback" not in (tmp_path / "log").read_text()
