"""The page on a town of millions of points: a real server, headless Chromium, software WebGL.

    python benchmarks/page.py                                  # a synthetic town of 10 million points
    python benchmarks/page.py --store demo/work/server/store.db

Prints when the first points and all in view, with what came and went, are on screen (when the frame after theirs
begins), when the last answer came (lists and votes too), what was sent by then, how many frames a second there are
while the eye turns, and how much memory the browser takes beyond an empty page. The first visit is to a server that
has not made its levels of detail yet. Needs Chromium (apt-get install chromium).
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from chromium import Chromium
from live_server import serving
from mapvote.core.grid import Lattice
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.server.store.store import Store

BLOCK_M, STREET_M, SPACING_M = 60.0, 14.0, 0.19
"""Blocks of houses between streets; points as far apart as in a map made at 10 Hz."""


def town(million_points: float) -> PointMap:
    """Streets and blocks of houses of 6 to 25 m, seen from the streets: ground and facades, no roofs."""
    random = np.random.default_rng(0)
    parts: list[np.ndarray] = []
    side, total, block = BLOCK_M + STREET_M, 0, 0
    while total < million_points * 1e6:
        row, col = divmod(block, max(round(np.sqrt(million_points * 6)), 1))
        corner = np.array([col * side, row * side, 0.0])
        parts += [corner + part for part in _block(random)]
        total = sum(map(len, parts))
        block += 1
    return map_from_points(np.concatenate(parts), lattice=Lattice())


def _block(random: np.random.Generator) -> Iterator[np.ndarray]:
    side, along = BLOCK_M + STREET_M, np.arange(0, BLOCK_M, SPACING_M)
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(0, side, SPACING_M), np.arange(0, side, SPACING_M)))
    street = (x > BLOCK_M) | (y > BLOCK_M)
    yield np.column_stack([x[street], y[street], random.normal(0, 0.02, int(street.sum()))])
    for which in range(4):
        heights = np.arange(0, random.uniform(6, 25), SPACING_M)
        a, z = (grid.ravel() for grid in np.meshgrid(along, heights))
        depth = random.normal(0, 0.02, len(a)) + (0.0 if which % 2 == 0 else BLOCK_M)
        yield np.column_stack([depth, a, z] if which < 2 else [a, depth, z])


def memory_mb() -> float:
    """Of all of Chromium's processes, what is shared counted once (PSS)."""
    total = 0
    for status in Path("/proc").glob("[0-9]*/smaps_rollup"):
        try:
            if b"chromium" in (status.parent / "cmdline").read_bytes():
                lines = status.read_text().splitlines()
                total += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
        except (OSError, StopIteration):
            continue
    return total / 1024


def cpu_seconds() -> float:
    """Spent so far by all of Chromium's processes: what a busy machine does not change."""
    ticks = 0
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            name, _, numbers = status.read_text().rpartition(")")
            ticks += sum(map(int, numbers.split()[11:13])) if "chrom" in name else 0
        except OSError:
            continue
    return ticks / os.sysconf("SC_CLK_TCK")


@contextmanager
def browsing() -> Iterator[Chromium]:
    """A browser that is closed at the end."""
    browser = Chromium(1400, 900, webgl=True)
    try:
        yield browser
    finally:
        browser.close()


def visit(url: str, told: str) -> None:
    """Open the page in a browser of its own, and print a row."""
    with browsing() as browser:
        empty = memory_mb()
        browser.open(url)
        browser.wait("performance.getEntriesByName('first-points').length > 0", 120)
        first = browser.run("performance.getEntriesByName('first-points')[0].startTime")
        sent = "performance.getEntriesByType('resource').reduce((sum, e) => sum + e.encodedBodySize, 0)"
        by_then = browser.run(
            "(() => { const at = performance.getEntriesByName('first-points')[0].startTime;"
            "return performance.getEntriesByType('resource').filter(e => e.responseEnd <= at)"
            ".reduce((sum, e) => sum + e.encodedBodySize, 0) })()"
        )
        browser.wait("performance.getEntriesByName('all-in-view').length > 0", 300)
        whole = browser.run("performance.getEntriesByName('all-in-view')[0].startTime")
        last, bytes_whole = settle(browser, sent)
        frames, cpu_ms = frames_while_turning(browser)
        used = memory_mb() - empty
        assert browser.errors == [], browser.errors
    print(
        f"{told:28} first {first / 1000:5.2f} s ({by_then / 1e6:4.1f} MB)   all in view {whole / 1000:5.2f} s "
        f"(last answer {last:5.2f} s, {bytes_whole / 1e6:4.1f} MB)   {frames:4.1f} frames/s "
        f"({cpu_ms:3.0f} ms of CPU each)   {used:4.0f} MB"
    )


def settle(browser: Chromium, sent: str) -> tuple[float, float]:
    """(seconds from the start of the page to the end of the last answer, bytes) once nothing more comes for 2 s."""
    before, since = -1.0, time.monotonic()
    while time.monotonic() - since < 2:
        now = float(browser.run(sent))
        if now != before:
            before, since = now, time.monotonic()
        time.sleep(0.2)
    answers = "performance.getEntriesByType('resource').filter(e => !e.name.includes('events'))"
    last = f"Math.max(...{answers}.map(e => e.responseEnd))"
    return float(browser.run(last)) / 1000, before


def frames_while_turning(browser: Chromium, seconds: float = 16.0) -> tuple[float, float]:
    """(frames a second, milliseconds of CPU a frame) while a key turns the eye, the first half left out: the budget of
    points adapts."""
    browser.run(
        "(() => { window.shown = []; const tick = (t) => { window.shown.push(t); requestAnimationFrame(tick) };"
        "requestAnimationFrame(tick); document.querySelector('#cloud').focus() })()"
    )
    begun, half = time.monotonic(), (0.0, 0)
    while (now := time.monotonic() - begun) < seconds:
        if now > seconds / 2 and not half[1]:
            half = cpu_seconds(), browser.run("window.shown.length")
        for kind in ("keyDown", "keyUp"):
            browser.call("Input.dispatchKeyEvent", type=kind, key="ArrowLeft", code="ArrowLeft", modifiers=8)
        time.sleep(0.02)
    drawn = browser.run("window.shown.length") - half[1]
    spent = cpu_seconds() - half[0]
    late = f"const late = window.shown.slice({half[1]})"
    rate = float(browser.run(f"(() => {{ {late}; return 1000 * (late.length - 1) / (late.at(-1) - late[0]) }})()"))
    return rate, 1000 * spent / max(drawn, 1)


def main() -> None:
    """Parse and run."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--store", type=Path, help="a store to look at; else a town is made")
    asked.add_argument("--points", type=float, default=10.0, metavar="MILLION")
    options = asked.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        store = options.store
        if store is None:
            store = Path(folder) / "store.db"
            made = town(options.points)
            Store.create(f"sqlite:///{store}", made).close()
            points = sum(len(tile.points) for tile in made.tiles.values())
            print(f"a town of {points / 1e6:.1f} million points in {len(made.tiles)} tiles")
        with serving(store, log=Path(folder) / "log") as (url, _):
            visit(url, "first visit to the server")
            visit(url, "second visit, another browser")


if __name__ == "__main__":
    main()
