"""The HTTP API within one process: what the command line uses on a store."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest

from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.codec.ballot import encode
from mapvote.config import Settings
from mapvote.config.server import ServerSettings
from mapvote.core.types import CellState
from mapvote.server.http.app import URL, in_process
from mapvote.server.store import keys
from mapvote.server.store.store import Store


@pytest.fixture
def client(tmp_path: Path) -> Iterator[httpx2.Client]:
    """The API of a store that holds a key, as its owner ``kim``; over HTTP its vehicles could send one drive a day."""
    store = Store.create(f"sqlite:///{tmp_path / 'store.db'}", two_walls())
    keys.issue(store, "v1", "vehicle")
    settings = Settings(server=ServerSettings(drives_a_day=1))
    with in_process(store, settings, owner="kim") as transport:
        yield httpx2.Client(transport=transport, base_url=URL)
    store.close()


def test_the_owner_of_a_store_needs_no_key_and_no_quota_and_signs_what_he_does(client: httpx2.Client) -> None:
    for drive in ("d1", "d2"):
        states = states_plane({}, fill=CellState.UNCHANGED_EMPTY)
        ballot = encode(make_ballot(two_walls(), {(0, 0): Say(states)}, "v1", drive))
        assert client.put(f"/v1/ballots/v1/{drive}", content=ballot).status_code == 201
    assert client.request("DELETE", "/v1/ballots/v1/d2").json() == {"withdrawn": 1}
    assert client.get("/v1/log", params={"events": 1}).json()["events"][0]["actor"] == "kim"


def test_a_plane_comes_compressed_or_not(client: httpx2.Client) -> None:
    digest = next(iter(client.get("/v1/map").json()["tiles"].values()))["points"]
    plain = client.get(f"/v1/tiles/{digest}", headers={"Accept-Encoding": "identity"}).content
    assert client.get(f"/v1/tiles/{digest}", headers={"Accept-Encoding": "zstd"}).content == plain


def test_what_is_refused_is_the_same_answer_as_over_http(client: httpx2.Client) -> None:
    answer = client.post("/v1/rollback", json={"to": 7})
    assert (answer.status_code, list(answer.json())) == (404, ["detail"])
