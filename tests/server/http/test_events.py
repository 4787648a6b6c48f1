"""Events as they happen, on a real server: by stream and by webhook."""

from __future__ import annotations

import asyncio
import base64
import json
import queue
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import httpx2
import pytest
import sqlalchemy as sa
from standardwebhooks import Webhook, WebhookVerificationError

from hand_made import Say, make_ballot, states_plane, two_walls
from live_server import serving, serving_here
from mapvote.client import MapClient
from mapvote.config import ServerSettings
from mapvote.core.types import CellState
from mapvote.server.http.event_routes import as_sse, deliver
from mapvote.server.store import schema
from mapvote.server.store.queries import log_event
from mapvote.server.store.store import Store
from mapvote.server.views.history import Event, Feed, newest_event, without_names

if TYPE_CHECKING:
    from mapvote.server.http.services import Services

SECRET = "whsec_" + base64.b64encode(bytes(range(32))).decode()
Posts = queue.Queue[tuple[dict[str, str], bytes]]


@pytest.fixture
def store(tmp_path: Path) -> Path:
    Store.create(f"sqlite:///{tmp_path / 'store.db'}", two_walls()).close()
    return tmp_path / "store.db"


def vote(url: str, home: Path) -> None:
    says = {(0, 0): Say(states_plane(fill=CellState.UNCHANGED_EMPTY))}
    with MapClient(url, home=home) as client:
        client.fetch()
        client.send(make_ballot(two_walls(), says, "v1"))


def test_a_ballot_is_told_to_who_listens_and_again_to_who_comes_back(store: Path, tmp_path: Path) -> None:
    with serving_here(store, log=tmp_path / "log") as url, httpx2.Client(timeout=20.0) as http:
        with http.stream("GET", f"{url}/v1/events") as answer:
            lines = answer.iter_lines()
            assert next(lines) == ": listening"
            vote(url, tmp_path / "home")
            told = next(json.loads(line[5:]) for line in lines if line.startswith("data:"))
        assert (told["version"], "v1" in told["actor"] + told["detail"]) == (1, True)
        with http.stream("GET", f"{url}/v1/events", headers={"Last-Event-ID": str(told["seq"] - 1)}) as answer:
            again = next(json.loads(line[5:]) for line in answer.iter_lines() if line.startswith("data:"))
        assert again == told


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
    store: Path, tmp_path: Path, receiver: tuple[str, Posts]
) -> None:
    config = tmp_path / "mapvote.toml"
    config.write_text(f'[server]\nwebhook_url = "{receiver[0]}"\nwebhook_secret = "{SECRET}"\n')
    with serving(store, "--open", "--config", config, log=tmp_path / "log") as (url, _):
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


def test_a_restart_neither_loses_nor_repeats_what_a_webhook_gets(tmp_path: Path, receiver: tuple[str, Posts]) -> None:
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", two_walls())
    settings = SimpleNamespace(server=ServerSettings(webhook_url=receiver[0], webhook_secret=SECRET))
    parts = cast("Services", SimpleNamespace(store=store, settings=settings, fetching=None, feed=Feed(store, 0.0)))

    async def listen(posts: int) -> list[str]:
        task = asyncio.create_task(deliver(parts))
        heard: list[tuple[dict[str, str], bytes]] = []
        while len(heard) < posts or (posts == 0 and not known()):
            await asyncio.sleep(0.02)
            if not receiver[1].empty():
                heard.append(receiver[1].get())
        while posts and known()[0] < newest_event(store):
            await asyncio.sleep(0.02)
        task.cancel()
        return [event["detail"] for _, body in heard for event in json.loads(body)["events"]]

    def known() -> list[int]:
        with store.database.reading() as connection:
            return list(connection.execute(sa.select(schema.deliveries.c.seq)).scalars())

    def happens(what: str) -> None:
        with store.database.writing() as connection:
            log_event(connection, 5, "test", "", what)

    assert asyncio.run(listen(0)) == []
    happens("one")
    assert asyncio.run(listen(1)) == ["one"]
    happens("two")
    happens("three")
    assert asyncio.run(listen(1)) == ["two", "three"]
    store.close()


def test_no_name_can_begin_another_event() -> None:
    sent = as_sse(Event(7, 0, "ballot", "v1\n\ndata: {}", "x\r\n", 1))
    assert sent.count(b"\n\n") == 1
    assert sent.count(b"\ndata:") == 1


def test_readers_hear_what_happened_to_the_map_but_not_who_drove_by_or_when() -> None:
    published, judged = Event(2, 6, "publish", "boss", "v2", 2), Event(3, 7, "rejected", "eve", "built.v2.1.1", 2)
    events = [Event(1, 5, "ballot", "v1", "d1", 1), published, judged, Event(4, 8, "withdraw", "v1", "v1/d1", 2)]
    assert without_names(events) == [published, Event(3, 7, "rejected", "", "", 2)]
