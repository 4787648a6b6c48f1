"""The web page in a real browser: what an operator sees and clicks."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest

from chromium import Chromium, program
from mapvote.codec.arrays import zstd
from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.server.views.change_objects import Decided, change_objects, changed_cells
from mapvote.server.views.geojson import to_geojson

KEY = "operator-key-1"
TYPES = {"html": "text/html; charset=utf-8", "css": "text/css", "js": "text/javascript"}


def house(x: float, y: float, width: float, depth: float, height: float) -> np.ndarray:
    """Walls of a house, one point a voxel."""
    u = np.arange(CELL_SIZE / 2, width, CELL_SIZE)
    v = np.arange(CELL_SIZE / 2, depth, CELL_SIZE)
    ring = np.concatenate(
        [
            np.column_stack([x + u, np.full(len(u), y + 0.15)]),
            np.column_stack([x + u, np.full(len(u), y + depth - 0.15)]),
            np.column_stack([np.full(len(v), x + 0.15), y + v]),
            np.column_stack([np.full(len(v), x + width - 0.15), y + v]),
        ]
    )
    z = np.arange(0.45, height, CELL_SIZE)
    return np.column_stack([np.repeat(ring, len(z), axis=0), np.tile(z, len(ring))])


def street(*houses: np.ndarray) -> PointMap:
    x, y = np.meshgrid(np.arange(-149.85, 200, CELL_SIZE), np.arange(-7.95, 8, CELL_SIZE))
    road = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return map_from_points(np.concatenate([road, *houses]), map_id="street")


@cache
def make_world() -> tuple[PointMap, PointMap]:
    rng = np.random.default_rng(1)
    stays = [
        house(x, side * 12 - (0 if side > 0 else 9), rng.uniform(8, 14), rng.uniform(7, 10), rng.uniform(4, 12))
        for x in range(-140, 190, 18)
        for side in (-1, 1)
        if (x, side) not in {(-14, 1), (76, -1), (4, -1)}
    ]
    old = [house(-14, 12, 11.1, 9, 7.0), house(75.9, -21, 9, 7.2, 5.0)]
    new = [house(3.9, -21, 12, 9.3, 8.5), house(120, 9.6, 0.6, 0.6, 2.6)]
    return street(*stays, *old), street(*stays, *new)


EMPTY_DESK = {"version": 2, "held": [], "pending": {"type": "FeatureCollection", "features": []}, "reviewed": []}


@dataclass
class FakeServer:
    """Answers the routes that the page asks for with the shapes that the server gives, and notes every request."""

    answers: dict[str, Any]
    key: str | None = None
    asked: list[tuple[str, str | None]] = field(default_factory=list)
    url: str = ""

    def answer(self, path: str, query: dict[str, list[str]], key: str | None) -> tuple[int, str, bytes]:
        self.asked.append((path, key))
        if not path.startswith("/v1/"):
            name = "index.html" if path == "/" else path.removeprefix("/viewer/")
            page = files("mapvote.server.http") / "viewer" / name
            return 200, TYPES[name.rsplit(".", 1)[1]], page.read_bytes()
        if self.key is not None and key != f"Bearer {self.key}":
            return 401, "application/json", json.dumps({"detail": "this key is unknown or revoked"}).encode()
        if path == "/v1/events":
            return 200, "text/event-stream", b": listening\n\n"
        found = self.answers.get(path.removeprefix("/v1/"), EMPTY_DESK if path == "/v1/desk" else None)
        if callable(found):
            found = found(query)
        if isinstance(found, bytes):
            return 200, "application/octet-stream", found
        if found is None:
            return 404, "application/json", json.dumps({"detail": f"nothing at {path}"}).encode()
        return 200, "application/json", json.dumps(found).encode()


def spoken(vehicle: str, state: str, end: str, why: str | None = None) -> dict[str, Any]:
    return {"vehicle": vehicle, "drive": "d1", "state": state, "end": end, "counts": why is None, "why": why}


@cache
def world_answers() -> dict[str, Any]:
    before, after = make_world()
    versions = [
        {
            "number": n,
            "parent": n - 1 or None,
            "kind": "import" if n == 1 else "publish",
            "target": None,
            "created": f"2026-11-{18 + n}T08:15:00Z",
            "published_by": "operator",
            "reason": reason,
        }
        for n, reason in ((1, "first map"), (2, "weekly round, 3 vehicles"))
    ]
    cells = []
    for index in sorted(after.tiles):
        a, b = before.tile(index), after.tile(index)
        changed = changed_cells(a, b)
        states = np.full((256, 256), 255, dtype=np.uint8)
        states[changed.rows - 256 * index[0], changed.cols - 256 * index[1]] = changed.states
        tally = np.zeros((256, 256, 5), dtype=np.int32)
        tally[..., 2:4] = 3 * 16
        stamps = [(1795000000 * 10**9 + i * 3600 * 10**9, states) for i in range(3)]
        cells.append(changed_cells(a, b, [Decided(2, states, tally, stamps)]))
    collection = to_geojson(change_objects(cells), Lattice(), map_id="street", from_version=1, to_version=2)
    empty = to_geojson([], Lattice(), map_id="street", from_version=2, to_version=1)
    answers: dict[str, Any] = {
        "map": {
            "map_id": "street",
            "version": 2,
            "lattice": {"x0": 0.0, "y0": 0.0},
            "tiles": {f"{r},{c}": {"points": f"hash{r}_{c}"} for r, c in after.tiles},
        },
        "map/versions": {"versions": versions},
        "changes": lambda query: collection if query["from"] == ["1"] and query["to"] == ["2"] else empty,
        "coverage": {
            "tiles": [
                {"row": r, "col": c, "last_seen": f"2026-11-{10 + 2 * c + 5}T09:00:00Z", "vehicles": max(1, 3 + c)}
                for r, c in after.tiles
            ]
        },
        "vehicles": {"vehicles": []},
        "cells": lambda query: {
            "x": float(query["x"][0]),
            "y": float(query["y"][0]),
            "votes": [
                spoken("v1", "changed_occupied", "2026-11-20T07:00:00Z"),
                spoken("<img src=x onerror=alert(1)>", "undetermined", "2026-11-20T08:00:00Z"),
                spoken("v9", "unchanged_empty", "2026-08-01T08:00:00Z", "older than 30 days"),
            ],
            "decisions": [{"version": 2, "state": "changed_occupied"}],
        },
    }
    for (r, c), tile in after.tiles.items():
        answers[f"tiles/hash{r}_{c}"] = zstd.compress(tile.points.tobytes())
    return answers


@pytest.fixture
def server() -> Iterator[FakeServer]:
    fake = FakeServer(deepcopy(world_answers()))

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            parts = urlsplit(self.path)
            status, kind, body = fake.answer(parts.path, parse_qs(parts.query), self.headers.get("Authorization"))
            self.send_response(status)
            self.send_header("Content-Type", kind)
            if kind == "application/octet-stream":
                assert "zstd" in self.headers["Accept-Encoding"]
                self.send_header("Content-Encoding", "zstd")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *arguments: object) -> None:
            pass

    listener = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=listener.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    fake.url = f"http://127.0.0.1:{listener.server_port}/"
    yield fake
    listener.shutdown()
    thread.join()
    listener.server_close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Chromium]:
    if program() is None:
        pytest.skip("Chromium is not installed: apt-get install chromium")
    found = Chromium()
    yield found
    found.close()


def text(browser: Chromium, selector: str) -> str:
    found: str = browser.run(f"document.querySelector({selector!r}).innerText")
    return found


def open_page(browser: Chromium, server: FakeServer, fragment: str = "") -> None:
    browser.open(server.url + fragment)
    browser.wait("!document.querySelector('#content').hidden && document.querySelector('#tally').innerText")


def hosts(browser: Chromium) -> set[str]:
    return {urlsplit(url).netloc for url in browser.requests if url.startswith(("http", "ws"))}


def test_the_page_lists_what_was_built_and_demolished_and_asks_nobody_else(
    browser: Chromium, server: FakeServer
) -> None:
    open_page(browser, server)
    assert text(browser, "#which-map") == "street, version 2"
    assert "1 built" in text(browser, "#tally")
    assert text(browser, "#small summary") == "1 smaller than 1 m²", "the pole is folded away"
    assert "2 demolished" in text(browser, "#tally")
    first = text(browser, "#changes li").split("\n")
    assert first == ["Built", "12.4 m²", "7.8 m high"], "the largest comes first"
    assert "weekly round, 3 vehicles" in text(browser, "#versions")
    assert "10 of 10 tiles" in text(browser, "#coverage-note")
    browser.wait("performance.getEntriesByType('resource').filter(e => e.name.includes('/tiles/')).length === 10")
    assert hosts(browser) == {urlsplit(server.url).netloc}
    assert browser.errors == []


def test_points_are_drawn_where_they_are(browser: Chromium, server: FakeServer) -> None:
    """A wall of a house that stays is darker than the ground beside it."""
    open_page(browser, server, "#cell=-139.85,12.15")
    script = """(() => {
        const c = document.querySelector("canvas"), g = c.getContext("2d");
        const at = (dx, dy) => g.getImageData(c.width / 2 + dx, c.height / 2 + dy, 1, 1).data[3];  // how much ink
        return at(0, -100) > at(-100, -100) + 60;
    })()"""
    browser.wait(script)
    assert browser.errors == []


def test_a_click_on_a_change_tells_its_votes_height_and_area(browser: Chromium, server: FakeServer) -> None:
    open_page(browser, server)
    browser.run("document.querySelector('#changes button').click()")  # fits the house into the middle
    browser.run("document.querySelector('#details .close').click()")
    assert browser.run("document.querySelector('#details').hidden")
    width, height, box = 928, 800, (12.0, 9.3)
    scale = min(width / box[0], height / box[1]) * (1 - 2 * 0.38)
    browser.click(width / 2 - (box[0] / 2 - 0.15) * scale, height / 2)
    browser.wait("!document.querySelector('#details').hidden")
    shown = text(browser, "#details")
    for fact in (
        "Built",
        "12.42 m² (138 cells)",
        "7.8 m above ground",
        "3834 added",
        "3 (fewest 3)",
        "2026-11-18 11:06 UTC",
    ):
        assert fact in shown
    assert "false" not in shown, "what is not known is left out"
    assert browser.run("location.hash").startswith("#change=built.v2.")
    assert browser.run("document.querySelector('#changes [aria-current=true]').innerText").startswith("Built")


def test_a_click_elsewhere_tells_who_voted_what_and_names_stay_text(browser: Chromium, server: FakeServer) -> None:
    open_page(browser, server)
    browser.click(464, 100)
    browser.wait("document.querySelector('#details h3')?.innerText.startsWith('Cell at')")
    shown = text(browser, "#details")
    assert "changed, now occupied" in shown
    assert "does not count now: older than 30 days" in shown
    assert "<img src=x onerror=alert(1)>" in shown
    assert browser.run("document.querySelectorAll('#details img').length") == 0
    assert "Version 2 decided: changed, now occupied." in shown


def test_a_link_opens_the_same_change_again(browser: Chromium, server: FakeServer) -> None:
    open_page(browser, server)
    last = browser.run("document.querySelector('#small li').id.slice(5)")
    open_page(browser, server, f"#change={last}")
    browser.wait("!document.querySelector('#details').hidden")
    assert "0.36 m² (4 cells)" in text(browser, "#details")


def test_an_equal_or_empty_range_says_so(browser: Chromium, server: FakeServer) -> None:
    open_page(browser, server)
    browser.run("(s => (s.value = '2', s.onchange()))(document.querySelector('#from'))")
    browser.wait("document.querySelector('#tally').innerText === 'Choose two different versions.'")
    browser.run("(s => (s.value = '1', s.onchange()))(document.querySelector('#to'))")
    browser.wait("document.querySelector('#tally').innerText === 'Nothing changed between version 2 and version 1.'")
    assert browser.run("document.querySelectorAll('#changes li').length") == 0


def test_a_new_server_says_what_is_missing(browser: Chromium, server: FakeServer) -> None:
    server.answers["map"] = {"map_id": "street", "version": 1, "lattice": {"x0": 0.0, "y0": 0.0}, "tiles": {}}
    server.answers["map/versions"]["versions"].pop()
    server.answers["coverage"] = {"tiles": []}
    open_page(browser, server)
    assert "Changes appear once vehicles have voted" in text(browser, "#tally")
    assert text(browser, "#coverage-note") == "No ballot has come yet."
    assert text(browser, "#notice") == "This map has no tiles yet."
    assert browser.errors == []


def test_the_key_is_asked_for_kept_in_the_tab_and_never_in_a_url(browser: Chromium, server: FakeServer) -> None:
    server.key = KEY
    browser.open(server.url)
    browser.wait("!document.querySelector('#key-form').hidden && document.activeElement.id === 'key'")
    browser.type("wrong")
    browser.run("document.querySelector('#key-form button').click()")
    browser.wait("document.querySelector('#key-reason').innerText === 'this key is unknown or revoked'")
    assert browser.run("sessionStorage.length") == 0
    browser.type(KEY)
    browser.run("document.querySelector('#key-form button').click()")
    browser.wait("!document.querySelector('#content').hidden && document.querySelector('#tally').innerText")
    assert ("/v1/map", f"Bearer {KEY}") in server.asked
    assert not [url for url in browser.requests if KEY in url]
    assert browser.run("[localStorage.length, document.cookie, sessionStorage.length]") == [0, "", 1]
    assert browser.run("document.querySelector('#key').value") == ""
    browser.run("document.querySelector('#forget').click()")
    browser.wait("!document.querySelector('#key-form').hidden")
    assert browser.run("sessionStorage.length") == 0


def test_a_server_that_fails_is_reported_in_its_own_words(browser: Chromium, server: FakeServer) -> None:
    del server.answers["coverage"]
    browser.open(server.url)
    browser.wait("document.querySelector('#notice').innerText === 'nothing at /v1/coverage'")
