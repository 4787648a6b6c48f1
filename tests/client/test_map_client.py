"""Losses of a vehicle's client: nothing. And what it asks for: only what it lacks."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import httpx2
import pytest
from fastapi.testclient import TestClient

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, two_walls, wall
from mapvote.client import MapClient, Refused
from mapvote.codec.ballot import encode
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote_server.api.app import create_app
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import WALL, NewStore, vote_gone

BALLOT = make_ballot(two_walls(), {(0, 0): Say(states_plane({(10, 10): CellState.UNCHANGED_OCCUPIED}))}, "a", "d1")
Answer = tuple[int, dict[str, str]]


@contextmanager
def answering(*answers: Answer) -> Iterator[tuple[str, list[str]]]:
    """A server that answers so, in turn, then 201; its address, and what it was asked."""
    asked: list[str] = []
    left = list(answers)

    class Handler(BaseHTTPRequestHandler):
        def do_PUT(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            asked.append(self.path)
            status, headers = left.pop(0) if left else (201, {})
            body = b'{"result": "created"}' if status < 300 else b'{"detail": "because"}'
            self.send_response(status)
            for name, value in (headers | {"Content-Length": str(len(body))}).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}", asked
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.parametrize("status", [401, 403])
def test_without_a_valid_key_the_ballot_waits_until_there_is_one(tmp_path: Path, status: int) -> None:
    with answering((status, {})) as (url, _), MapClient(url, home=tmp_path) as client:
        with pytest.raises(
            Refused, match=r"because.*; the ballot waits in .*d1.ballot: it is sent with the next"
        ) as no:
            client.send(BALLOT)
        assert no.value.status == status
        assert client.flush() == {"a~d1": "created"}
        assert client.flush() == {}


def test_a_ballot_that_fits_no_version_any_more_is_kept_and_the_way_out_is_told(tmp_path: Path) -> None:
    with answering((409, {})) as (url, _), MapClient(url, home=tmp_path) as client:
        with pytest.raises(Refused, match="fetch the map and vote again with that drive"):
            client.send(BALLOT)
        assert client.flush() == {}
    (kept,) = tmp_path.rglob("*.refused")
    assert kept.read_bytes() == encode(BALLOT)


def test_a_ballot_waits_for_its_own_server_and_vehicle(tmp_path: Path) -> None:
    away = "http://127.0.0.1:9"
    with MapClient(away, home=tmp_path, attempts=1) as client:
        assert client.send(BALLOT) == "spooled"
        assert client.flush("b") == {}
        assert client.flush("a") == {"a~d1": "spooled"}
    with answering() as (url, asked), MapClient(url, home=tmp_path) as other:
        assert other.flush() == {}
        assert asked == []


@pytest.mark.parametrize("status", [429, 503])
def test_a_server_that_names_a_pause_gets_it(tmp_path: Path, status: int) -> None:
    pauses: list[float] = []
    slow = answering((status, {"Retry-After": "7"}))
    with slow as (url, _), MapClient(url, home=tmp_path, sleep=pauses.append) as client:
        assert client.send(BALLOT) == "created"
    assert pauses == [7.0]


def test_a_longer_pause_than_a_minute_is_another_time(tmp_path: Path) -> None:
    busy = answering((503, {"Retry-After": "600"}))
    with busy as (url, asked), MapClient(url, home=tmp_path, sleep=lambda s: pytest.fail("waits")) as client:
        assert client.send(BALLOT) == "spooled"
        assert len(asked) == 1
        assert client.flush() == {"a~d1": "created"}


class Counted:
    """An app's answers without a network, and how many there were of each kind."""

    def __init__(self, app: TestClient) -> None:
        self._app = app
        self.asked: list[tuple[str, int, int]] = []

    def request(self, method: str, path: str, **more: Any) -> httpx2.Response:
        answer = self._app.request(method, path, **{k: v for k, v in more.items() if v is not None})
        self.asked.append((path.partition("?")[0].rpartition("/")[0], answer.status_code, len(answer.content)))
        return answer

    def close(self) -> None:
        pass


Served = tuple[Store, Counted, Callable[..., MapClient]]


@pytest.fixture
def served(new_store: NewStore, tmp_path: Path) -> Iterator[Served]:
    """A long street of ten tiles."""
    tiles = {(0, c): make_tile(wall(WALL, [0.05, 0.45 + 0.01 * c]), 0.001 * c, (0, c)) for c in range(10)}
    store = new_store(make_map(tiles), Policy(fuse=FuseSettings(max_deleted_share=1.0)))
    with TestClient(create_app(store, opened=True), base_url="http://localhost") as app:
        counted = Counted(app)

        def client(**more: Any) -> MapClient:
            made = MapClient("http://localhost", home=tmp_path / "home", **more)
            made._server._http = counted  # type: ignore[assignment]
            return made

        yield store, counted, client


def take_down_a_wall(store: Store, tile: tuple[int, int] = (0, 3)) -> None:
    vote_gone(store, tiles=[tile])
    assert publish(store).published


def test_only_changed_rows_of_the_list_of_tiles_are_fetched(served: Served) -> None:
    store, counted, client = served
    first = client().fetch()
    whole = next(size for path, _, size in counted.asked if path == "/v1")
    counted.asked.clear()
    client().fetch()
    assert counted.asked == [("/v1", 304, 0)]
    take_down_a_wall(store)
    counted.asked.clear()
    second = client().fetch()
    assert [path for path, _, _ in counted.asked] == ["/v1", "/v1/tiles"]
    assert counted.asked[0][2] < whole / 2
    assert second.version == 2
    changed = [i for i in first.tiles if first.tiles[i].points.tobytes() != second.tiles[i].points.tobytes()]
    assert changed == [(0, 3)]


def test_a_server_that_was_restored_to_another_past_is_asked_for_everything(served: Served, tmp_path: Path) -> None:
    store, _, client = served
    client().fetch()
    take_down_a_wall(store)
    client().fetch()
    (manifest,) = (tmp_path / "home").rglob("manifest.json")
    manifest.write_bytes(manifest.read_bytes().replace(store.tiles()[0, 5].points.encode(), b"0" * 64))
    take_down_a_wall(store, (0, 7))
    fetched = client().fetch()
    expected = store.point_map()
    assert {i: t.points.tobytes() for i, t in fetched.tiles.items()} == {
        i: t.points.tobytes() for i, t in expected.tiles.items()
    }


def test_a_server_set_up_anew_with_another_map_of_the_same_version_is_not_taken_for_the_old_one(
    served: Served, new_store: NewStore
) -> None:
    _, _, client = served
    client().fetch()
    other = new_store(make_map({(0, 0): make_tile(wall([(7, 7)], [0.9]))}), name="other.db")
    with TestClient(create_app(other, opened=True), base_url="http://localhost") as app:
        made = client()
        made._server._http = app
        fetched = made.fetch()
    assert fetched.version == 1
    assert list(fetched.tiles) == [(0, 0)]
    assert fetched.tiles[0, 0].points.tobytes() == other.point_map().tiles[0, 0].points.tobytes()


def test_a_region_is_fetched_without_the_rest(served: Served) -> None:
    _, counted, client = served
    found = client().fetch(region=(80.0, 0.0, 160.0, 10.0))
    assert sorted(found.tiles) == [(0, 1), (0, 2)]
    assert sum(path == "/v1/tiles" for path, _, _ in counted.asked) == 4


def test_the_cache_forgets_what_was_used_longest_ago(served: Served, tmp_path: Path) -> None:
    store, _, client = served
    client(cache_bytes=0).fetch()
    planes = tmp_path / "home" / "planes"
    before = {file.name for file in planes.iterdir()}
    take_down_a_wall(store)
    client(cache_bytes=0).fetch()
    after = {file.name for file in planes.iterdir()}
    assert len(before - after) == 1, "the points that are no more"
    assert len(after) == len(before)
