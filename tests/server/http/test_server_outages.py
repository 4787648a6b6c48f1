"""A real server process whose database goes away: what it acknowledged is there afterwards (kills: test_crash.py)."""

from __future__ import annotations

import time
from pathlib import Path

import httpx2
import pytest
import sqlalchemy as sa

from hand_made import Say, make_ballot, states_plane, two_walls
from live_server import serving
from mapvote.codec.ballot import encode
from mapvote.core.types import CellState
from mapvote.server.store import schema
from mapvote.server.store.store import Store
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
                assert refused.json()["detail"] == "the database cannot be reached; try again"
                assert http.get("/livez").status_code == 200
                for path in ("/v1/map", "/healthz", "/readyz", "/v1/coverage"):
                    assert http.get(path).status_code == 503
                assert http.request("POST", "/v1/publish", json={}).status_code == 503
                time.sleep(0.5)
        finally:
            postgres_cluster.start()
        assert put(http, "v1", "after").status_code == 201
        for path in ("/healthz", "/readyz"):
            assert http.get(path).status_code == 200
    store = Store.open(postgres_url)
    with store.database.reading() as connection:
        assert set(connection.execute(sa.select(schema.ballots.c.drive)).scalars()) == {"before", "after"}
    store.close()
    assert "Traceback" not in (tmp_path / "log").read_text()
