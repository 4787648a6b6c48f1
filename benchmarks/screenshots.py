"""The pictures of the page in docs/pictures, taken anew: a real server, headless Chromium, software WebGL.

    mapvote demo --full --keep --out out
    python benchmarks/screenshots.py out/work/server/store.db
    python benchmarks/screenshots.py out/work/server/store.db --only dark,phone --to /tmp/pictures

Needs Chromium (apt-get install chromium).
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from PIL import Image

from chromium import Chromium
from hand_made import make_map
from live_server import serving
from mapvote.server.store import keys
from mapvote.server.store.store import Store
from mapvote.server.views.history import changes_between, page_between

PICTURES = Path(__file__).parents[1] / "docs/pictures"
SHOWN = "performance.getEntriesByName('first-points').length > 0"
LISTED = "document.querySelectorAll('#changes button').length > 0"


def settled(browser: Chromium, seconds: float = 6.0) -> None:
    """Wait until all that is in view has come."""
    browser.wait(SHOWN, 90)
    count, since = -1, time.monotonic()
    while time.monotonic() - since < seconds:
        with suppress(TimeoutError):  # a busy machine draws for minutes
            browser.wait("document.querySelector('#busy').hidden", 40)
        now = browser.run("performance.getEntriesByType('resource').length")
        if now != count:
            count, since = now, time.monotonic()
        time.sleep(0.2)


ALONG = "118,40,3,128,-2.25,0.42"
"""The eye on the middle of the street, from the south-west: x, y, z, distance, bearing, elevation."""


def of_demo(browser: Chromium, url: str) -> None:
    """Along the street."""
    browser.open(f"{url}/#eye={ALONG}")
    browser.wait(LISTED, 90)
    settled(browser)


def of_swipe(browser: Chromium, url: str) -> None:
    """Before and after beside a bar, with the paths of those who voted."""
    browser.open(f"{url}/#compare=swipe&swipe=50&paths=1&eye={ALONG}")
    browser.wait(LISTED, 90)
    settled(browser)


def from_above(browser: Chromium, url: str, also: str = "") -> None:
    """Without WebGL, or by a key."""
    browser.open(f"{url}/#view=2d&paths=1{also}")
    browser.wait(LISTED, 90)
    time.sleep(10.0)


def of_change(browser: Chromium, url: str) -> None:
    """The eye on the largest change, told beside it."""
    browser.open(url)
    browser.wait(LISTED, 90)
    browser.run("document.querySelector('#changes button').click()")
    settled(browser)


def of_demolition(browser: Chromium, url: str) -> None:
    """The eye on the largest demolition."""
    browser.open(url)
    browser.wait(LISTED, 90)
    browser.run("[...document.querySelectorAll('#changes button')].find(b => b.innerText.includes('Demo')).click()")
    settled(browser)


def as_seen_without_red(browser: Chromium, url: str) -> None:
    """As of_change, to someone who cannot tell red from green."""
    browser.call("Emulation.setEmulatedVisionDeficiency", type="deuteranopia")
    of_change(browser, url)


def while_loading(browser: Chromium, url: str) -> None:
    """Over a slow line: the first points are there, more is coming."""
    browser.call("Network.emulateNetworkConditions", offline=False, latency=400, downloadThroughput=120_000,
                 uploadThroughput=60_000)  # fmt: skip
    browser.open(url)
    browser.wait(SHOWN, 120)


def nothing_yet(browser: Chromium, url: str) -> None:
    """A store with its first map, before anybody has driven."""
    browser.open(url)
    browser.wait("!document.querySelector('#content').hidden && document.querySelector('#tally').innerText", 60)


def connection_lost(process: subprocess.Popen[str], browser: Chromium, url: str) -> None:
    """The server has gone; what is shown stays."""
    of_demo(browser, url)
    process.terminate()
    browser.wait("!document.querySelector('#offline').hidden", 60)


Picture = tuple[str, Callable[[Chromium, str], None], dict[str, object]]
DEMO: list[Picture] = [
    ("page", of_demo, {}),
    ("page_change", of_change, {}),
    ("page_dark", of_demolition, {"dark": True}),
    ("page_phone", of_change, {"width": 360, "height": 740}),
    ("page_colour_blind", as_seen_without_red, {}),
    ("page_loading", while_loading, {}),
    ("page_swipe", of_swipe, {}),
    ("page_2d", from_above, {"webgl": False}),
    ("page_next", partial(from_above, also="&next=1"), {"webgl": False}),
]


def take(picture: Picture, url: str, key: str, to: Path) -> None:
    """One picture, by a browser of its own, to an operator; in 256 colours, which is all that it has."""
    name, prepare, how = picture
    browser = Chromium(**{"width": 1400, "height": 900, "webgl": True} | how)  # type: ignore[arg-type]
    browser.call("Network.setExtraHTTPHeaders", headers={"Authorization": f"Bearer {key}"})
    try:
        prepare(browser, url)
        file = to / f"{name}.png"
        browser.screenshot(file)
        Image.open(file).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(file, optimize=True)
        print(file)
    finally:
        browser.close()


def closed(store: Path) -> str:
    """An operator's key to a store, which needs keys from then on."""
    opened = Store.open(f"sqlite:///{store}")
    try:
        return keys.issue(opened, "operator", "operator")
    finally:
        opened.close()


def file_of_changes(store: Path, folder: Path) -> Path:
    """What `mapvote log --html` writes of the newest version."""
    opened = Store.open(f"sqlite:///{store}")
    try:
        newest = opened.current()
        page = page_between(opened, newest - 1, newest, changes_between(opened, newest - 1, newest))
    finally:
        opened.close()
    (folder / "changes.html").write_text(page)
    return folder / "changes.html"


def of_file(browser: Chromium, url: str) -> None:
    """A change in a file of its own."""
    browser.open(url)
    browser.wait("document.querySelectorAll('.row button').length > 0", 60)
    time.sleep(5.0)


def main() -> None:
    """Parse and run."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("store", type=Path, help="of the demo")
    asked.add_argument("--to", type=Path, default=PICTURES)
    asked.add_argument("--only", default="", help="names without page_, by commas")
    options = asked.parse_args()
    wanted = {f"page_{name}" if name != "page" else name for name in filter(None, options.only.split(","))}
    with tempfile.TemporaryDirectory() as folder:
        log, copy = Path(folder) / "log", Path(folder) / "demo.db"
        shutil.copy(options.store, copy)
        key = closed(copy)
        if not wanted or "page_file" in wanted:
            take(("page_file", of_file, {}), file_of_changes(copy, Path(folder)).as_uri(), key, options.to)
        with serving(copy, log=log) as (url, process):
            for picture in [*DEMO, ("page_lost", partial(connection_lost, process), {})]:
                if not wanted or picture[0] in wanted:
                    take(picture, url, key, options.to)
        if not wanted or "page_empty" in wanted:
            store = Path(folder) / "empty.db"
            Store.create(f"sqlite:///{store}", make_map({})).close()
            key = closed(store)
            with serving(store, log=log) as (url, _):
                take(("page_empty", nothing_yet, {}), url, key, options.to)


if __name__ == "__main__":
    main()
