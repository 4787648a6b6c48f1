"""The page as a browser without WebGL shows it, on a real server: what an operator sees and clicks."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import httpx2
import numpy as np
import pytest

from chromium import Chromium, browsing
from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from live_server import serving_here
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote_server.questions.vehicles import vehicle_standings
from mapvote_server.store import keys
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import send


def outline(row: int, col: int, rows: int, cols: int) -> list[tuple[int, int]]:
    """The cells of a house's walls."""
    box = [(r, c) for r in range(row, row + rows) for c in range(col, col + cols)]
    return [(r, c) for r, c in box if r in (row, row + rows - 1) or c in (col, col + cols - 1)]


GONE, NEW, STAYS, POLE = outline(40, 40, 20, 30), outline(100, 40, 20, 40), outline(40, 150, 20, 30), [(10, 10)]
GHOSTS = [(r + i, c + j) for r in range(130, 250, 30) for c in range(100, 250, 30) for i in range(3) for j in range(3)]
HEIGHTS = [0.45, 1.05, 2.55, 4.35]
HOUR_NS = 3_600_000_000_000
REASON = "weekly round <script>alert(1)</script>"


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store in which six vehicles took a house and a pole down and built a house, and a seventh, between them, also
    saw 20 pillars that are not there. Nobody holds a key."""
    home = tmp_path_factory.mktemp("town")
    ground = wall([(r, c) for r in range(0, 256, 2) for c in range(0, 256, 2)], [0.05])
    point_map = make_map({(0, 0): make_tile(np.concatenate([ground, wall([*GONE, *STAYS, *POLE], HEIGHTS)]))})
    store = Store.create(f"sqlite:///{home / 'store.db'}", point_map)
    now = store.clock()
    for i in range(7):
        new = [*NEW, *(GHOSTS if i == 3 else [])]
        states = states_plane(dict.fromkeys([*GONE, *POLE], CellState.CHANGED_EMPTY), fill=CellState.UNCHANGED_EMPTY)
        for cell in new:
            states[cell] = CellState.CHANGED_OCCUPIED
        say = Say(states, new_points=wall(new, HEIGHTS))
        name = "liar" if i == 3 else f"v{i}"
        send(store, make_ballot(point_map, {(0, 0): say}, name, "d1", end_ns=now - (10 - i) * HOUR_NS))
    done = publish(store, FuseSettings(max_deleted_share=1.0), by="<b>boss</b>", reason=REASON, override=True)
    assert (done.points_added, done.points_deleted) == (len(NEW) * len(HEIGHTS), len([*GONE, *POLE]) * len(HEIGHTS))
    store.close()
    return home / "store.db"


@pytest.fixture(scope="module")
def url(town: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with serving_here(town, log=tmp_path_factory.mktemp("log") / "log") as address:
        yield address + "/"


@pytest.fixture(scope="module")
def browser() -> Iterator[Chromium]:
    with browsing() as found:
        yield found


SHOWN = "!document.querySelector('#content').hidden && document.querySelector('#tally').innerText"


def open_page(browser: Chromium, url: str) -> None:
    browser.open(url)
    browser.wait(SHOWN)


def type_key(browser: Chromium, key: str) -> None:
    browser.run(f"document.querySelector('#key').value = {key!r}; document.querySelector('form').submit()")


def test_the_liar_is_named_from_the_ballots_in_the_store(town: Path) -> None:
    store = Store.open(f"sqlite:///{town}")
    found = {s.vehicle: s for s in vehicle_standings(store)}
    store.close()
    assert {name for name, s in found.items() if s.verdict == "contradicts"} == {"liar"}
    assert found["liar"].objects == 20
    assert (found["v0"].verdict, found["v2"].verdict) == ("undecidable", "consistent")


def test_the_page_lists_what_was_built_and_demolished_and_asks_nobody_else(browser: Chromium, url: str) -> None:
    open_page(browser, url)
    assert browser.text("#which-map") == "test-map, version 2"
    assert browser.text("#tally").split() == ["1", "built", "1", "demolished"]
    assert browser.text("#small summary") == "1 smaller than 1 m²", "the pole is folded away"
    assert browser.text("#changes li").split("\n") == ["Built", "10.4 m²", "4.3 m high"], "the largest comes first"
    assert REASON in browser.text("#versions"), "text stays text"
    assert "published by <b>boss</b>" in browser.text("#versions")
    assert "1 of 1 tiles" in browser.text("#coverage-note")
    browser.wait("document.querySelector('#vehicles')?.innerText.includes('liar')")
    browser.wait("performance.getEntriesByType('resource').filter(e => e.name.includes('/tiles/')).length === 1")
    asked = {urlsplit(one).netloc for one in browser.requests if one.startswith(("http", "ws"))}
    assert asked == {urlsplit(url).netloc}
    assert browser.errors == []


def test_points_are_drawn_where_they_are(browser: Chromium, url: str) -> None:
    """A wall of the house that stays is darker than the ground beside it."""
    open_page(browser, f"{url}#cell=45.15,12.15")
    script = """(() => {
        const c = document.querySelector("canvas"), g = c.getContext("2d");
        const at = (dx, dy) => g.getImageData(c.width / 2 + dx, c.height / 2 + dy, 1, 1).data[3];  // how much ink
        return at(0, -60) > at(-60, -60) + 60;
    })()"""
    browser.wait(script)
    assert browser.errors == []


def test_a_click_on_a_change_tells_its_votes_height_and_area(browser: Chromium, url: str) -> None:
    open_page(browser, url)
    browser.run("document.querySelector('#changes button').click()")  # fits the house into the middle
    browser.run("document.querySelector('#details .close').click()")
    assert browser.run("document.querySelector('#details').hidden")
    width, height, box = 928, 800, (12.0, 6.0)
    scale = min(width / box[0], height / box[1]) * (1 - 2 * 0.38)
    browser.click(width / 2 - (box[0] / 2 - 0.15) * scale, height / 2)
    browser.wait("!document.querySelector('#details').hidden")
    shown = browser.text("#details")
    for fact in ("Built", f"({len(NEW)} cells)", "4.3 m above ground", "464 added", "7 (fewest 7)"):
        assert fact in shown
    assert "false" not in shown, "what is not known is left out"
    assert browser.run("location.hash").startswith("#change=built.v2.")
    assert browser.run("document.querySelector('#changes [aria-current=true]').innerText").startswith("Built")
    browser.run("document.querySelector('#details > .link').click()")
    browser.wait("document.querySelector('#details').innerText.includes('liar / d1')")
    shown = browser.text("#details")
    assert "Version 2 decided: changed, now occupied." in shown
    assert "does not count now: spent: version 2 has changed the cell since" in shown


def test_a_link_opens_the_same_change_again(browser: Chromium, url: str) -> None:
    open_page(browser, url)
    last = browser.run("document.querySelector('#small li').id.slice(5)")
    open_page(browser, f"{url}#change={last}")
    browser.wait("!document.querySelector('#details').hidden")
    assert "0.09 m² (1 cells)" in browser.text("#details")


def lanelet2(*lanes: tuple[float, float]) -> str:
    """A lanelet2 map of lanes along x from 5 to 30 m, each from one y to another, in local metres."""
    nodes: list[str] = []
    ways: list[str] = []
    relations: list[str] = []
    for lane, sides in enumerate(lanes, 1):
        for side, y in zip(("left", "right"), sides, strict=True):
            name = f"{lane}{len(ways)}"
            for end, x in enumerate((5.0, 30.0)):
                tags = f"<tag k='local_x' v='{x}'/><tag k='local_y' v='{y}'/>"
                nodes.append(f"<node id='{name}{end}' lat='' lon=''>{tags}</node>")
            ways.append(f"<way id='{name}'><nd ref='{name}0'/><nd ref='{name}1'/><tag k='type' v='line_thin'/></way>")
            relations.append(f"<member type='way' ref='{name}' role='{side}'/>")
        lines = "".join(relations[-2:])
        relations[-2:] = [
            f"<relation id='9{lane}'>{lines}<tag k='type' v='lanelet'/><tag k='subtype' v='road'/></relation>"
        ]
    return f"<osm>{''.join([*nodes, *ways, *relations])}</osm>"


def test_lanelets_of_a_file_that_is_dropped_are_those_near_the_changes(browser: Chromium, url: str) -> None:
    open_page(browser, url)
    colour = """(() => { const c = document.querySelector('#map'), g = c.getContext('2d');
        const d = g.getImageData(0, 0, c.width, c.height).data; let n = 0;
        for (let i = 0; i < d.length; i += 4) n += d[i] === 11 && d[i + 1] === 122 && d[i + 2] === 86;
        return n; })()"""
    assert browser.run(colour) == 0
    drop = """(text => { const moved = new DataTransfer();
        moved.items.add(new File([text], 'lanelet2_map.osm'));
        const event = new DragEvent('drop', { dataTransfer: moved, bubbles: true, cancelable: true });
        document.body.dispatchEvent(event); })"""
    browser.run(f"{drop}({lanelet2((20.0, 16.5), (70.0, 66.5))!r})")
    browser.wait("document.querySelector('#lanelets-text').innerText.includes('1 part within 2 m')")
    assert browser.text("#lanelets-near") == "lanelet 91 (road) 0 m from demolished"
    browser.run("document.querySelector('#lanelets-near button').click()")
    browser.wait(f"{colour} > 50")
    browser.run("(s => (s.value = '2', s.dispatchEvent(new Event('change'))))(document.querySelector('#from'))")
    browser.wait("document.querySelector('#lanelets-text').innerText.includes('0 parts')")
    assert browser.errors == []
    browser.run(f"{drop}('<osm/>')")
    browser.wait("document.querySelector('#lanelets-text').innerText.includes('holds no lanelet')")


def test_an_equal_or_empty_range_says_so(browser: Chromium, url: str) -> None:
    open_page(browser, url)
    browser.run("(s => (s.value = '2', s.onchange()))(document.querySelector('#from'))")
    browser.wait("document.querySelector('#tally').innerText === 'Choose two different versions.'")
    browser.run("(s => (s.value = '1', s.onchange()))(document.querySelector('#from'))")
    browser.run("(s => (s.value = '1', s.onchange()))(document.querySelector('#to'))")
    browser.wait("document.querySelectorAll('#changes li').length === 0")


def test_a_new_server_says_what_is_missing(browser: Chromium, tmp_path: Path) -> None:
    Store.create(f"sqlite:///{tmp_path / 's.db'}", make_map({})).close()
    with serving_here(tmp_path / "s.db", log=tmp_path / "log") as url:
        open_page(browser, url)
        assert "Changes appear once vehicles have voted" in browser.text("#tally")
        assert browser.text("#coverage-note") == "No ballot has come yet."
        assert browser.text("#notice") == "This map has no tiles yet."
        assert browser.errors == []
        browser.open("about:blank")


def test_the_browser_keeps_the_key_and_sends_it_for_every_list(browser: Chromium, town: Path, tmp_path: Path) -> None:
    shutil.copy(town, tmp_path / "s.db")
    store = Store.open(f"sqlite:///{tmp_path / 's.db'}")
    vehicle, key = keys.issue(store, "v1", "vehicle"), keys.issue(store, "boss", "operator")
    store.close()
    with serving_here(tmp_path / "s.db", log=tmp_path / "log") as url:
        assert httpx2.get(url).status_code == 401
        answer = httpx2.get(f"{url}/v1/vehicles", headers={"Authorization": f"Bearer {vehicle}"}, timeout=60.0)
        assert answer.status_code == 403, "who contradicts whom"
        browser.open(url)
        browser.wait("!!document.querySelector('form #key')")
        assert "This map needs a key" in browser.text("main")
        type_key(browser, "wrong")
        browser.wait("document.querySelector('[role=alert]')?.innerText.includes('unknown')")
        type_key(browser, key)
        browser.wait(SHOWN)
        browser.errors.clear()  # the form itself is an answer of status 401
        browser.wait("document.querySelector('#vehicles').innerText.includes('liar')")
        asked = (
            "fetch(new URL(a.getAttribute('href'), location.origin + location.pathname)).then(answer => answer.status)"
        )
        assert (
            browser.run(f"Promise.all([...document.querySelectorAll('a[download]')].map(a => {asked}))") == [200] * 12
        )
        assert browser.run("[localStorage.length, sessionStorage.length, document.cookie]") == [0, 0, ""]
        assert browser.errors == []
        browser.open("about:blank")
    assert key not in (tmp_path / "log").read_text()


def test_a_server_that_fails_is_reported_in_its_own_words(browser: Chromium, town: Path, tmp_path: Path) -> None:
    shutil.copy(town, tmp_path / "s.db")
    with sqlite3.connect(tmp_path / "s.db") as database:
        database.execute("ALTER TABLE ballot_tiles RENAME TO lost")
    with serving_here(tmp_path / "s.db", log=tmp_path / "log") as url:
        said = httpx2.get(f"{url}/v1/coverage", timeout=60.0).json()["detail"]
        browser.open(url)
        browser.wait(f"document.querySelector('#notice').innerText === {said!r}")
        browser.open("about:blank")
