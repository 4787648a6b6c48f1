"""The operator's page on a real server with keys, a real store, and a vehicle that lies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient

from chromium import Chromium, program
from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from live_server import mapvote, serving
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote.server.http.app import create_app
from mapvote.server.store import keys
from mapvote.server.store.publish import publish
from mapvote.server.store.store import Store
from mapvote.server.views.consensus import vehicle_standings
from stores import send

HOUSE = [(r, c) for r in range(40, 60) for c in range(40, 70) if r in (40, 59) or c in (40, 69)]
GHOSTS = [(r + i, c + j) for r in range(100, 250, 30) for c in range(100, 250, 30) for i in range(3) for j in range(3)]
HEIGHTS = [0.45, 1.05, 2.55, 4.35]
HOUR = 3_600_000_000_000


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A store where six vehicles took a house down and a seventh, between them, saw 25 pillars that are not there."""
    home = tmp_path_factory.mktemp("town")
    ground = wall([(r, c) for r in range(0, 256, 2) for c in range(0, 256, 2)], [0.05])
    point_map = make_map({(0, 0): make_tile(np.concatenate([ground, wall(HOUSE, HEIGHTS)]))})
    store = Store.create(f"sqlite:///{home / 'store.db'}", point_map)
    now = store.clock()
    for i in range(7):
        states = states_plane(dict.fromkeys(HOUSE, CellState.CHANGED_EMPTY), fill=CellState.UNCHANGED_EMPTY)
        if i == 3:
            for cell in GHOSTS:
                states[cell] = CellState.CHANGED_OCCUPIED
        name = "liar" if i == 3 else f"v{i}"
        ballot = make_ballot(point_map, {(0, 0): Say(states)}, name, "d1", end_ns=now - (10 - i) * HOUR)
        send(store, ballot)
    assert publish(store, FuseSettings(max_deleted_share=1.0), reason="the house is gone").version == 2
    key = keys.issue(store, "boss", "operator")
    store.close()
    return home / "store.db", key


def test_the_liar_is_named_from_the_ballots_in_the_store(town: tuple[Path, str]) -> None:
    store = Store.open(f"sqlite:///{town[0]}")
    found = {s.vehicle: s for s in vehicle_standings(store)}
    store.close()
    assert {name for name, s in found.items() if s.verdict == "contradicts"} == {"liar"}
    assert found["liar"].objects == 25
    assert found["v0"].verdict == "undecidable"
    assert found["v2"].verdict == "consistent"


def test_only_operators_hear_who_contradicts_whom(town: tuple[Path, str]) -> None:
    store = Store.open(f"sqlite:///{town[0]}")
    vehicle = keys.issue(store, "v1", "vehicle")
    with TestClient(create_app(store), base_url="http://localhost") as client:
        for key, status in ((vehicle, 403), (town[1], 200)):
            answer = client.get("/v1/vehicles", headers={"Authorization": f"Bearer {key}"})
            assert answer.status_code == status
    store.close()
    liar = next(v for v in answer.json()["vehicles"] if v["vehicle"] == "liar")
    assert (liar["verdict"], liar["evidence"][0]["says"]) == ("contradicts", "occupied")


@pytest.mark.slow
def test_the_verb_says_the_same(town: tuple[Path, str]) -> None:
    import subprocess

    done = subprocess.run(mapvote("info", town[0], "--vehicles"), capture_output=True, text=True, check=True)
    line = next(line for line in done.stdout.splitlines() if "liar" in line)
    assert "contradi" in line, "a narrow terminal cuts or wraps the word"


@pytest.mark.slow
def test_the_page_on_a_real_server(town: tuple[Path, str], tmp_path: Path) -> None:
    if program() is None:
        pytest.skip("Chromium is not installed: apt-get install chromium")
    store, key = town
    browser = Chromium()
    try:
        with serving(store, log=tmp_path / "log") as (url, _):
            browser.open(url.replace("://", f"://operator:{key}@"))
            browser.wait("document.querySelector('#tally')?.innerText.includes('1 demolished')")
            browser.wait("document.querySelector('#vehicles')?.innerText.includes('liar')")
            assert "the house is gone" in browser.run("document.querySelector('#versions').innerText")
            assert "1 of 1 tiles" in browser.run("document.querySelector('#coverage-note').innerText")
            browser.run("document.querySelector('#changes button').click()")
            shown = browser.run("document.querySelector('#details').innerText")
            assert "(96 cells)" in shown
            assert "4.3 m above ground" in shown
            assert "7 (fewest 7)" in shown
            browser.run("document.querySelector('#details .link').click()")
            browser.wait("document.querySelector('#details h3').innerText.startsWith('Cell at')")
            browser.wait("document.querySelector('#details').innerText.includes('liar / d1')")
            assert "Version 2 decided: changed, now empty." in browser.run(
                "document.querySelector('#details').innerText"
            )
            browser.wait("performance.getEntriesByType('resource').some(e => e.name.includes('/tiles/'))")
            assert browser.errors == []
            browser.screenshot(tmp_path / "page.png")
        assert key not in (tmp_path / "log").read_text()
    finally:
        browser.close()
