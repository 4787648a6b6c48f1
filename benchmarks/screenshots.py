"""The pictures of the page in docs/pictures, taken anew: a real server, headless Chromium, software WebGL.

    mapvote demo --full --keep --out out
    python benchmarks/screenshots.py out/work/server/store.db
    python benchmarks/screenshots.py out/work/server/store.db --only dark,phone --to /tmp/pictures

Needs Chromium (apt-get install chromium).
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from PIL import Image

from chromium import Chromium
from hand_made import make_map
from live_server import serving
from mapvote_server.questions.changes import changes_between, page_between
from mapvote_server.store import keys
from mapvote_server.store.store import Store

SHOWN = "performance.getEntriesByName('first-points').length > 0"
LISTED = "document.querySelectorAll('#changes button').length > 0"
TALLIED = "!document.querySelector('#content').hidden && document.querySelector('#tally').innerText"
LARGEST = "document.querySelector('#changes button').click()"
DEMOLITION = "[...document.querySelectorAll('#changes button')].find(b => b.innerText.includes('Demo')).click()"
ALONG = "118,40,3,128,-2.25,0.42"
"""The eye on the middle of the street, from the south-west: x, y, z, distance, bearing, elevation."""
SLOW = {"offline": False, "latency": 400, "downloadThroughput": 120_000, "uploadThroughput": 60_000}


@dataclass(frozen=True)
class Picture:
    """Pages that are opened, elements that are waited for and clicked; without ``still_s`` until all that is in view
    has come."""

    at: str = ""
    until: str = LISTED
    click: str = ""
    still_s: float | None = None
    before: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    """Calls of Chromium's debugging protocol."""
    how: Mapping[str, object] = field(default_factory=dict)


DEMO = {
    "page": Picture(f"#eye={ALONG}"),
    "page_change": Picture(click=LARGEST),
    "page_dark": Picture(click=DEMOLITION, how={"dark": True}),
    "page_phone": Picture(click=LARGEST, how={"width": 360, "height": 740}),
    "page_colour_blind": Picture(
        click=LARGEST, before={"Emulation.setEmulatedVisionDeficiency": {"type": "deuteranopia"}}
    ),
    "page_loading": Picture(until=SHOWN, still_s=0.0, before={"Network.emulateNetworkConditions": SLOW}),
    "page_swipe": Picture(f"#compare=swipe&swipe=50&paths=1&eye={ALONG}"),
    "page_2d": Picture("#view=2d&paths=1", still_s=10.0, how={"webgl": False}),
    "page_next": Picture("#view=2d&paths=1&next=1", still_s=10.0, how={"webgl": False}),
    "page_lost": Picture(f"#eye={ALONG}"),
}
OF_FILE = Picture(until="document.querySelectorAll('.row button').length > 0", still_s=5.0)
EMPTY = Picture(until=TALLIED, still_s=0.0)


def settle(browser: Chromium, seconds: float = 6.0) -> None:
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


def take(picture: Picture, url: str, key: str, file: Path, end: Callable[[], object] | None = None) -> None:
    """One picture, by a browser of its own, to an operator; in 256 colours, which is all that it has. ``end``: takes
    the server away; what is shown stays."""
    browser = Chromium(**{"width": 1400, "height": 900, "webgl": True} | dict(picture.how))  # type: ignore[arg-type]
    browser.call("Network.setExtraHTTPHeaders", headers={"Authorization": f"Bearer {key}"})
    try:
        for method, arguments in picture.before.items():
            browser.call(method, **arguments)
        browser.open(url + picture.at)
        browser.wait(picture.until, 120)
        browser.run(picture.click or "0")
        settle(browser) if picture.still_s is None else time.sleep(picture.still_s)
        if end:
            end()
            browser.wait("!document.querySelector('#offline').hidden", 60)
        browser.screenshot(file)
        Image.open(file).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(file, optimize=True)
        print(file)
    finally:
        browser.close()


def closed(store: Path, page: Path | None = None) -> str:
    """An operator's key to a store, which needs keys from then on; ``page``: gets what `mapvote log --html` writes of
    the newest version."""
    opened = Store.open(f"sqlite:///{store}")
    try:
        if page:
            newest = opened.current()
            page.write_text(page_between(opened, newest - 1, newest, changes_between(opened, newest - 1, newest)))
        return keys.issue(opened, "operator", "operator")
    finally:
        opened.close()


def main() -> None:
    """Parse and run."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("store", type=Path, help="of the demo")
    asked.add_argument("--to", type=Path, default=Path(__file__).parents[1] / "docs/pictures")
    asked.add_argument("--only", default="", help="names without page_, by commas")
    options = asked.parse_args()
    wanted = {f"page_{name}".removesuffix("_page") for name in filter(None, options.only.split(","))}
    wanted = wanted or {*DEMO, "page_file", "page_empty"}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        key = closed(Path(shutil.copy(options.store, folder / "demo.db")), folder / "changes.html")
        if "page_file" in wanted:
            take(OF_FILE, (folder / "changes.html").as_uri(), key, options.to / "page_file.png")
        with serving(folder / "demo.db", log=folder / "log") as (url, process):
            for one in (one for one in DEMO if one in wanted):
                file = options.to / f"{one}.png"
                take(DEMO[one], f"{url}/", key, file, process.terminate if one == "page_lost" else None)
        if "page_empty" in wanted:
            Store.create(f"sqlite:///{folder}/empty.db", make_map({})).close()
            key = closed(folder / "empty.db")
            with serving(folder / "empty.db", log=folder / "log") as (url, _):
                take(EMPTY, f"{url}/", key, options.to / "page_empty.png")


if __name__ == "__main__":
    main()
