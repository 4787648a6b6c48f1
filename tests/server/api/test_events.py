"""Events as they happen: by stream and by webhook. Listeners share one poll of the database, and each hears every event
once and in order."""

from __future__ import annotations

import asyncio
import base64
import json
import queue
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import httpx2
import pytest
import sqlalchemy as sa
from standardwebhooks import Webhook, WebhookVerificationError

from hand_made import Say, make_ballot, states_plane, two_walls
from live_server import serving, serving_here
from mapvote.client import MapClient
from mapvote.config import ServerSettings
from mapvote.core.types import CellState
from mapvote_server.api.event_routes import as_sse, deliver
from mapvote_server.questions.history import Event, Feed, newest_event, without_names
from mapvote_server.store import keys, schema
from mapvote_server.store.queries import log_event
from mapvote_server.store.store import Store
from stores import NewStore

if TYPE_CHECKING:
    from mapvote_server.api.services import Services

SECRET = "whsec_" + base64.b64encode(bytes(range(32))).decode()
Posts = queue.Queue[tuple[dict[str, str], bytes]]


@pytest.fixture
def store(new_store: NewStore) -> Store:
    return new_store()


def log(store: Store, *details: str) -> list[int]:
    """Numbers of new events of a store."""
    with store.database.writing() as connection:
        return [log_event(connection, store.clock(), "publish", "boss", detail) for detail in details]


def vote(url: str, home: Path) -> None:
    says = {(0, 0): Say(states_plane(fill=CellState.UNCHANGED_EMPTY))}
    with MapClient(url, home=home) as client:
        client.fetch()
        client.send(make_ballot(two_walls(), says, "v1"))


def test_a_ballot_is_told_to_who_listens_and_again_to_who_comes_back(store: Store, tmp_path: Path) -> None:
    with serving_here(tmp_path / "s.db", log=tmp_path / "log") as url, httpx2.Client(timeout=20.0) as http:
        with http.stream("GET", f"{url}/v1/events") as answer:
            lines = answer.iter_lines()
            assert next(lines) == ": listening"
            vote(url, tmp_path / "home")
            told = next(json.loads(line[5:]) for line in lines if line.startswith("data:"))
        assert (told["version"], "v1" in told["actor"] + told["detail"]) == (1, True)
        with http.stream("GET", f"{url}/v1/events", headers={"Last-Event-ID": str(told["seq"] - 1)}) as answer:
            again = next(json.loads(line[5:]) for line in answer.iter_lines() if line.startswith("data:"))
        assert again == told


def begun(http: httpx2.Client, url: str, key: str) -> tuple[int, Iterator[str]]:
    """Status and lines of a stream, which stays open until the client is closed."""
    request = http.build_request("GET", f"{url}/v1/events", headers={"Authorization": f"Bearer {key}"})
    answer = http.send(request, stream=True)
    return answer.status_code, answer.iter_lines()


@pytest.mark.parametrize("end", ["revoked", "expired"])
def test_a_stream_ends_with_its_key_and_hears_nothing_afterwards(store: Store, tmp_path: Path, end: str) -> None:
    key = keys.issue(store, "eve", "operator", days=None if end == "revoked" else 5.0 / 86_400)
    with serving_here(tmp_path / "s.db", log=tmp_path / "log") as url, httpx2.Client(timeout=20.0) as http:
        status, lines = begun(http, url, key)
        assert (status, next(lines)) == (200, ": listening")
        if end == "revoked":
            keys.revoke(store, "eve")
        else:
            time.sleep(5.1)
        keys.issue(store, "secret-car-7", "vehicle")
        heard = "".join(lines)
    assert "secret-car-7" not in heard
    assert "key revoked" not in heard


def test_one_key_listens_to_four_streams_and_shuts_nobody_out(store: Store, tmp_path: Path) -> None:
    greedy, operator = keys.issue(store, "greedy", "vehicle"), keys.issue(store, "boss", "operator")
    settings = "[server]\nconnections = 8\n"
    with (
        serving_here(tmp_path / "s.db", settings=settings, log=tmp_path / "log") as url,
        httpx2.Client(timeout=20.0, limits=httpx2.Limits(max_connections=None)) as http,
    ):
        streams = [begun(http, url, greedy) for _ in range(12)]
        assert [status for status, _ in streams] == [200] * 4 + [429] * 8
        assert httpx2.get(f"{url}/livez", timeout=20.0).status_code == 200
        assert begun(http, url, operator)[0] == 200


@pytest.fixture
def receiver() -> Iterator[tuple[str, Posts]]:
    """An address that refuses the first post and takes the others."""
    posts: Posts = queue.Queue()
    refused = threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(200 if refused.is_set() else 503)
            self.end_headers()
            if refused.is_set():
                posts.put((dict(self.headers), body))
            refused.set()

        def log_message(self, *arguments: object) -> None:
            pass

    listener = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=listener.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    yield f"http://127.0.0.1:{listener.server_port}/hook", posts
    listener.shutdown()
    thread.join()
    listener.server_close()


@pytest.mark.slow
def test_a_webhook_is_signed_and_sent_again_until_it_is_taken(
    store: Store, tmp_path: Path, receiver: tuple[str, Posts]
) -> None:
    settings = f'[server]\nwebhook_url = "{receiver[0]}"\nwebhook_secret = "{SECRET}"\n'
    with serving(tmp_path / "s.db", settings=settings, log=tmp_path / "log") as (url, _):
        vote(url, tmp_path / "home")
        headers, body = receiver[1].get(timeout=30)
    told = Webhook(SECRET).verify(body, headers)
    assert [event["version"] for event in told["events"]] == [1]
    for other, sent in ((Webhook(SECRET[:-4] + "AAA="), body), (Webhook(SECRET), body + b" ")):
        with pytest.raises(WebhookVerificationError):
            other.verify(sent, headers)


def test_an_address_without_a_secret_and_a_secret_of_another_form_are_refused() -> None:
    with pytest.raises(ValueError, match="webhook_secret"):
        ServerSettings(webhook_url="http://localhost/hook")
    with pytest.raises(ValueError, match="webhook_secret"):
        ServerSettings(webhook_secret="a secret of both")


def test_a_restart_neither_loses_nor_repeats_what_a_webhook_gets(store: Store, receiver: tuple[str, Posts]) -> None:
    settings = SimpleNamespace(server=ServerSettings(webhook_url=receiver[0], webhook_secret=SECRET))
    feed = Feed(store, 0.0)
    parts = cast("Services", SimpleNamespace(store=store, settings=settings, look_up=asyncio.to_thread, feed=feed))

    async def listen(posts: int) -> list[str]:
        task = asyncio.create_task(deliver(parts))
        heard: list[tuple[dict[str, str], bytes]] = []
        while len(heard) < posts or (posts == 0 and not known()):
            await asyncio.sleep(0.02)
            assert not task.done(), task
            if not receiver[1].empty():
                heard.append(receiver[1].get())
        while posts and known()[0] < newest_event(store):
            await asyncio.sleep(0.02)
        task.cancel()
        return [event["detail"] for _, body in heard for event in json.loads(body)["events"]]

    def known() -> list[int]:
        with store.database.reading() as connection:
            return list(connection.execute(sa.select(schema.deliveries.c.seq)).scalars())

    assert asyncio.run(listen(0)) == []
    log(store, "one")
    assert asyncio.run(listen(1)) == ["one"]
    log(store, "two", "three")
    assert asyncio.run(listen(1)) == ["two", "three"]


def test_no_name_can_begin_another_event() -> None:
    sent = as_sse(Event(7, 0, "ballot", "v1\n\ndata: {}", "x\r\n", 1))
    assert sent.count(b"\n\n") == 1
    assert sent.count(b"\ndata:") == 1


def test_readers_hear_what_happened_to_the_map_but_not_who_drove_by_or_when() -> None:
    published, judged = Event(2, 6, "publish", "boss", "v2", 2), Event(3, 7, "rejected", "eve", "built.v2.1.1", 2)
    events = [Event(1, 5, "ballot", "v1", "d1", 1), published, judged, Event(4, 8, "withdraw", "v1", "v1/d1", 2)]
    assert without_names(events) == [published, Event(3, 7, "rejected", "", "", 2)]


def test_twenty_listeners_cost_one_poll_a_second(store: Store) -> None:
    listeners, seconds = 20, 30
    now, statements = [0.0], [0]
    feed = Feed(store, seconds=lambda: now[0])
    start = newest_event(store)
    at, heard = [start] * listeners, [list[str]() for _ in range(listeners)]

    def asked(*_: Any) -> None:
        statements[0] += 1

    for second in range(seconds):
        if second % 10 == 5:
            log(store, f"e{second}")
        sa.event.listen(store.database.engine, "before_cursor_execute", asked)
        for i in range(listeners):
            now[0] = second + i / listeners
            for event in feed.after(at[i]):
                heard[i].append(event.detail)
                at[i] = event.seq
        sa.event.remove(store.database.engine, "before_cursor_execute", asked)
    now[0] += 1.0
    for i in range(listeners):
        heard[i] += [event.detail for event in feed.after(at[i])]
    assert heard == [["e5", "e15", "e25"]] * listeners
    assert statements[0] <= 3 * (seconds / 0.9 + 1), "begin, events, and the version where there are any"


def test_who_comes_back_after_long_reads_the_log_and_misses_nothing(store: Store) -> None:
    now = [0.0]
    feed = Feed(store, seconds=lambda: now[0])
    feed.after(newest_event(store))
    told = log(store, *[f"e{i}" for i in range(600)])
    for _ in range(3):
        now[0] += 1.0
        feed.after(told[-1])
    seq, heard = told[0] - 1, list[int]()
    while found := feed.after(seq):
        heard += [event.seq for event in found]
        seq = heard[-1]
    assert heard == told
