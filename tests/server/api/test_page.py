"""The page in 3D on a real server, in a browser with WebGL in software: the cloud, the desk, and who can use it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from msgspec.structs import replace

from chromium import Chromium, browsing
from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from live_server import serving
from mapvote.codec.ballot import pack_path
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote.shapes.cutout import whole_page
from mapvote_server.questions.changes import changes_between, cutouts_between
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import send

HOUSE = [(r, c) for r in range(40, 60) for c in range(40, 70) if r in (40, 59) or c in (40, 69)]
SHED = [(r, c) for r in range(150, 160) for c in range(150, 160) if r in (150, 159) or c in (150, 159)]
HEIGHTS = [0.45, 1.05, 1.65, 2.55, 3.15, 4.35]
PIXELS = """(wanted => { const c = document.querySelector('#cloud'), p = document.createElement('canvas');
    p.width = c.width; p.height = c.height; const g = p.getContext('2d'); g.drawImage(c, 0, 0);
    const d = g.getImageData(0, 0, p.width, p.height).data, rgb = parseInt(wanted.slice(1), 16); let n = 0;
    for (let i = 0; i < d.length; i += 4) n += (d[i] << 16 | d[i + 1] << 8 | d[i + 2]) === rgb;
    return n; })"""
"""A function: how many pixels of the cloud have one colour."""
A_MOMENT = "new Promise((go) => setTimeout(go, 200))"
AXE = Path(__file__).parents[2] / "vendor" / "axe.min.js"


@pytest.fixture
def store(tmp_path: Path) -> Path:
    village(f"sqlite:///{tmp_path / 'store.db'}")
    return tmp_path / "store.db"


def village(database: str) -> None:
    """A store of a village where a house was taken down in version 2, and a shed would go with the next."""
    ground = wall([(r, c) for r in range(0, 256, 2) for c in range(0, 256, 2)], [0.05])
    houses = np.concatenate([ground, wall(HOUSE, HEIGHTS), wall(SHED, HEIGHTS)])
    bright = {"intensity": (1000 * houses[:, 2]).astype(np.uint16)}
    opened = Store.create(database, make_map({(0, 0): make_tile(houses).but(fields=bright)}))
    lax = opened.policy().model_copy(update={"fuse": FuseSettings(max_deleted_share=1.0)})
    opened.set_policy(lax, by="test")
    for number, gone in enumerate((HOUSE, SHED)):
        for name in ("v1", "v2"):
            states = states_plane(dict.fromkeys(gone, CellState.CHANGED_EMPTY), fill=CellState.UNCHANGED_EMPTY)
            base = opened.point_map()
            ballot = make_ballot(base, {(0, 0): Say(states)}, name, f"d{number}", end_ns=opened.clock())
            ballot = replace(ballot, path=pack_path([np.array([x, 30.0]) for x in range(4, 74, 5)], opened.lattice))
            send(opened, ballot)
        if number == 0:
            publish(opened, by="<b>boss</b>", reason="<script>alert(1)</script>")
    opened.close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Chromium]:
    with browsing(webgl=True) as found:
        yield found


def press(browser: Chromium, key: str) -> None:
    """Type one key: a letter, Tab or Enter."""
    told: dict[str, object] = {"key": key}
    if len(key) == 1:
        told["text"] = key
    else:
        told |= {"code": key, "windowsVirtualKeyCode": {"Tab": 9, "Enter": 13}[key]}
        told |= {"text": "\r"} if key == "Enter" else {}
    for kind in ("keyDown", "keyUp"):
        browser.call("Input.dispatchKeyEvent", type=kind, **told)


def enter(browser: Chromium, chosen: str) -> None:
    """Go to a control by its JavaScript expression, as Tab would, and press Enter there."""
    browser.run(f"{chosen}.focus()")
    press(browser, "Enter")


def hold_next_answer(browser: Chromium, path: str) -> None:
    """Keep the next answer to a path from the page until ``release()``; ``held`` is true once it is there."""
    browser.run(f"""(() => {{ const real = window.fetch; window.held = false;
        const free = new Promise((go) => (window.release = go));
        window.fetch = async (...asked) => {{
          if (!new URL(asked[0], location).pathname.endsWith({path!r})) return real(...asked);
          window.fetch = real;
          const answer = await real(...asked);
          window.held = true;
          await free;
          return answer; }}; }})()""")


@contextmanager
def page_of(browser: Chromium, store: Path | str, home: Path) -> Iterator[str]:
    """The address of the page, once it shows all of a store."""
    with serving(store, log=home / "log") as (url, _):
        ready(browser, url)
        yield url


def ready(browser: Chromium, url: str) -> None:
    browser.open(url)
    browser.wait("performance.getEntriesByName('all-in-view').length", 60)
    browser.wait("document.querySelectorAll('#pending button').length", 60)


@pytest.mark.slow
def test_the_cloud_is_drawn_and_nobody_else_is_asked(browser: Chromium, store: Path, tmp_path: Path) -> None:
    with page_of(browser, store, tmp_path) as url:
        assert "0 built" in browser.text("#tally")
        browser.wait("document.querySelector('#labels').innerText.startsWith('pending: × demolished 4 m')")
        colours = """(() => { const c = document.querySelector('#cloud'), p = document.createElement('canvas');
            p.width = c.width; p.height = c.height; const g = p.getContext('2d'); g.drawImage(c, 0, 0);
            const d = g.getImageData(0, 0, p.width, p.height).data, seen = new Set();
            for (let i = 0; i < d.length; i += 4) seen.add(d[i] << 16 | d[i + 1] << 8 | d[i + 2]);
            return seen.size; })()"""
        browser.wait(f"{colours} > 20")
        press(browser, "2")
        assert browser.run("!document.querySelector('#map').hidden && document.querySelector('#cloud').hidden")
        press(browser, "3")
        for way in ("before", "swipe", "blink", "after"):
            browser.run(f"(s => (s.value = '{way}', s.onchange()))(document.querySelector('#compare'))")
        browser.wait("!document.querySelector('#colour [value=intensity]').disabled")
        for colour in ("intensity", "plain", "age", "votes", "probability", "state", "height"):
            browser.run(f"(s => (s.value = '{colour}', s.onchange()))(document.querySelector('#colour'))")
            if colour == "intensity":
                browser.wait(f"{PIXELS}('#31446b') > 50")  # the ground is dark, and drawn in the ramp's first colour
            if colour == "state":
                browser.wait("location.hash.includes('vehicle=v1')")
        for low, told in (("3", "above 3.0 m"), ("-2", "all heights")):
            browser.run(f"(s => (s.value = '{low}', s.oninput()))(document.querySelector('#slice-low'))")
            assert browser.run("document.querySelector('#slice-text').textContent") == told
        enter(browser, "document.querySelector('#measure')")
        for x, y in ((420, 420), (520, 440)):
            told = browser.text("#measured-text")
            browser.click(x, y)
            browser.wait(f"document.querySelector('#measured-text').innerText !== {told!r}")
        assert " m (level " in browser.text("#measured-text")
        enter(browser, "document.querySelector('#measure')")
        browser.run("document.querySelector('#fit').click()")  # the page opened on the pending change alone
        before = browser.run(f"{PIXELS}('#c26a00')")
        browser.run("document.querySelector('#paths').click()")
        browser.wait("document.querySelector('#paths-text').innerText === '4 drives, 0.3 km'")
        browser.wait(f"{PIXELS}('#c26a00') > {before} + 50")
        browser.wait("location.hash.includes('paths=1')")
        browser.run("document.querySelector('#next').click()")
        browser.wait("document.querySelector('#next-text').innerText === 'no cell waits for one more pass'")
        browser.wait("location.hash.includes('next=1')")
        browser.run("document.querySelector('#changes button').click()")
        browser.wait("location.hash.includes('change=demolished.v2')")
        browser.wait("location.hash.includes('eye=')")
        assert "mean of its cells" in browser.text("#details")
        assert "<script>alert(1)</script>" in browser.text("#versions"), "text stays text"
        shared = browser.run("location.href").replace("compare=", "was=") + "&compare=swipe&swipe=30"
        asked = list(browser.requests)
        assert browser.errors == []
        browser.open(shared)
        browser.wait("document.querySelector('#swipe-bar').style.left === '30%'")
        browser.wait("document.querySelector('#details').innerText.includes('Demolished')")
        assert {urlsplit(u).netloc for u in asked + browser.requests if u.startswith("http")} == {urlsplit(url).netloc}
        assert browser.errors == []


@pytest.mark.slow
def test_the_desk_is_worked_by_keyboard_and_publishing_obeys(
    browser: Chromium, database_url: str, tmp_path: Path
) -> None:
    village(database_url)
    with page_of(browser, database_url, tmp_path):
        enter(browser, "document.querySelector('#pending button')")
        assert browser.text("#labels").startswith("pending: ×")
        marked = f"{PIXELS}('#2f62c4')"
        browser.wait(f"{marked} > 100")  # the points that would go are blue crosses
        browser.wait("document.querySelectorAll('#pending-sides button').length === 3")
        enter(browser, "document.querySelector('#pending-sides button')")
        browser.wait("document.querySelector('#which').innerText === 'before'")
        browser.wait("location.hash.includes('pending=demolished.')")
        press(browser, "r")
        browser.wait("document.querySelector('#pending').innerText.includes('rejected by operator')")
        assert browser.run("document.querySelector('#publish').disabled")
        enter(browser, "document.querySelector('#pending button')")
        press(browser, "u")
        browser.wait("!document.querySelector('#pending').innerText.includes('rejected')")
        enter(browser, "document.querySelector('#dry-run')")
        browser.wait("document.querySelector('#difference').innerText.includes('1 tiles')")
        enter(browser, "document.querySelector('#publish')")
        browser.wait("document.activeElement.className === 'yes'")
        press(browser, "Enter")
        browser.wait("document.querySelector('#which-map').innerText.endsWith('version 3')")
        browser.wait("document.querySelector('#tally').innerText.includes('1 demolished')")
        enter(browser, "[...document.querySelectorAll('#versions .link')].find(b => b.innerText === 'Go back to it')")
        browser.wait("document.activeElement.className === 'yes'")
        press(browser, "Enter")
        browser.wait("document.querySelector('#which-map').innerText.endsWith('version 4')")
        # a level of a tile asked for while it is published may be proposed no more
        assert [said for said in browser.errors if "404" not in said or "/v1/clouds/" not in said] == []


@pytest.mark.slow
def test_who_decides_after_another_is_told_so_on_the_page(browser: Chromium, store: Path, tmp_path: Path) -> None:
    with page_of(browser, store, tmp_path):
        enter(browser, "document.querySelector('#pending button')")
        change = browser.run("document.querySelector('#pending button').dataset.change")
        asked = {"change": change, "verdict": "accepted", "comment": "I was there"}
        told = {"method": "POST", "headers": {"Content-Type": "application/json"}, "body": json.dumps(asked)}
        browser.run(
            f"fetch('v1/desk/reviews', {json.dumps(told)}).then(() => document.querySelector('#rejected').click())"
        )
        browser.wait("document.querySelector('#desk-said').innerText")
        assert "operator" in browser.text("#desk-said")
        browser.wait("document.querySelector('#pending').innerText.includes('accepted by operator')")


@pytest.mark.slow
def test_what_is_chosen_while_a_verdict_is_on_its_way_stays_chosen(
    browser: Chromium, store: Path, tmp_path: Path
) -> None:
    with page_of(browser, store, tmp_path):
        enter(browser, "document.querySelector('#pending button')")
        hold_next_answer(browser, "v1/desk/reviews")
        press(browser, "r")
        browser.wait("document.querySelector('#pending').innerText.includes('rejected by operator')")  # by the event
        enter(browser, "document.querySelector('#pending button')")
        asked = "performance.getEntriesByType('resource').filter(e => e.name.endsWith('v1/desk')).length"
        before = browser.run(asked)
        browser.run("release()")
        browser.wait(f"{asked} > {before}")  # the desk was looked at once more
        browser.run(A_MOMENT)
        assert browser.run("document.querySelector('#pending button').ariaCurrent") == "true"
        assert not browser.run("document.querySelector('#verdict-form').hidden")


@pytest.mark.slow
@pytest.mark.parametrize("key", ["r", "u"])
def test_a_key_pressed_twice_judges_once(browser: Chromium, store: Path, tmp_path: Path, key: str) -> None:
    with page_of(browser, store, tmp_path):
        for pressed in "r", "u":
            browser.wait("document.querySelectorAll('#pending button').length")
            enter(browser, "document.querySelector('#pending button')")
            for _ in range(1 + (pressed == key)):
                press(browser, pressed)
            rejected = (
                f"document.querySelector('#pending').innerText.includes('rejected') === {json.dumps(pressed == 'r')}"
            )
            browser.wait(rejected)
            browser.run(A_MOMENT)
            assert browser.text("#desk-said") == ""


@pytest.mark.slow
def test_the_focus_stays_on_a_row_that_is_made_anew(browser: Chromium, store: Path, tmp_path: Path) -> None:
    with page_of(browser, store, tmp_path):
        enter(browser, "document.querySelector('#pending button')")
        browser.run("document.querySelector('#pending button').before = true")
        press(browser, "h")
        browser.wait("document.querySelector('#pending').innerText.includes('held by operator')")
        assert not browser.run("document.querySelector('#pending button').before")
        assert browser.run("document.activeElement === document.querySelector('#pending button')")


@pytest.mark.slow
def test_an_older_answer_that_comes_later_is_not_shown(browser: Chromium, store: Path, tmp_path: Path) -> None:
    with page_of(browser, store, tmp_path):
        enter(browser, "document.querySelector('#pending button')")
        hold_next_answer(browser, "v1/desk")
        browser.run("document.querySelector('#dry-run').click()")
        browser.wait("window.held")  # it says that nobody has judged
        press(browser, "r")
        browser.wait("document.querySelector('#pending').innerText.includes('rejected by operator')")
        browser.run("release()")
        browser.run(A_MOMENT)
        assert "rejected by operator" in browser.text("#pending")


@pytest.mark.slow
def test_what_lies_in_the_middle_is_chosen_by_keyboard(browser: Chromium, store: Path, tmp_path: Path) -> None:
    with page_of(browser, store, tmp_path):
        for key, canvas in (("3", "#cloud"), ("2", "#map")):
            press(browser, key)
            enter(browser, f"document.querySelector('{canvas}')")
            browser.wait("!document.querySelector('#details').hidden")
            enter(browser, "document.querySelector('#details .close')")


@pytest.mark.slow
def test_tab_alone_comes_to_every_control_that_is_shown(browser: Chromium, store: Path, tmp_path: Path) -> None:
    with page_of(browser, store, tmp_path):
        enter(browser, "document.querySelector('#changes button')")
        browser.wait("location.hash.includes('change=')")
        asked = "a[href], button, select, input, textarea, summary"
        shown = f"[...document.querySelectorAll({asked!r})].filter(e => !e.disabled && e.checkVisibility())"
        # The list beside the cloud holds what its signs say, in order; arrows choose among radio buttons.
        shown += ".filter(e => !e.matches('.sign') && (e.type !== 'radio' || e.checked))"
        count = browser.run(f"{shown}.length")
        assert count > 20
        browser.run("document.body.focus()")
        for _ in range(2 * count):
            press(browser, "Tab")
            browser.run("document.activeElement.reached = true")
        assert browser.run(f"{shown}.filter(e => !e.reached).map(e => e.outerHTML.slice(0, 80))") == []


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height", "zoom"), [(360, 740, 1), (1280, 800, 1), (1280, 800, 2)])
def test_axe_finds_nothing_and_nothing_is_cut_off(
    browser: Chromium, store: Path, tmp_path: Path, width: int, height: int, zoom: int
) -> None:
    size = {"width": width // zoom, "height": height // zoom, "deviceScaleFactor": zoom, "mobile": False}
    browser.call("Emulation.setDeviceMetricsOverride", **size)
    try:
        with page_of(browser, store, tmp_path):
            browser.run("document.querySelector('#changes button').click()")
            browser.call("Runtime.evaluate", expression=AXE.read_text())
            told = "axe.run().then(r => r.violations.map(v => `${v.id}: ${v.nodes.map(n => n.html)}`))"
            assert browser.run(told) == []
            assert browser.run("document.documentElement.scrollWidth <= innerWidth")
    finally:
        browser.call("Emulation.setDeviceMetricsOverride", width=1280, height=800, deviceScaleFactor=1, mobile=False)


def test_a_change_in_a_file_of_its_own_can_be_looked_at_offline(browser: Chromium, store: Path, tmp_path: Path) -> None:
    opened = Store.open(f"sqlite:///{store}")
    cutouts = cutouts_between(opened, 1, 2, changes_between(opened, 1, 2))
    opened.close()
    page = tmp_path / "changes.html"
    page.write_text(whole_page("</title><script>alert(1)</script>", cutouts))
    browser.open(page.as_uri())
    browser.wait("document.querySelectorAll('.row button').length === 4")
    assert browser.text("h1") == "</title><script>alert(1)</script>"
    browser.run("document.querySelectorAll('.row button')[2].click()")
    assert browser.run("document.querySelectorAll('.row button')[2].getAttribute('aria-pressed')") == "true"
    assert not [u for u in browser.requests if u.startswith("http")]
    assert browser.errors == []
    assert page.stat().st_size < 2_000_000
