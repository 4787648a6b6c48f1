"""CPU of each view of a server in a small and in a large city.

    python benchmarks/views.py                                            # 300 and 3,000 tiles
    python benchmarks/views.py --against OTHER/bin/python OTHER/tests     # and another version of mapvote, in turns
    python benchmarks/views.py --liar 300                                 # what a vehicle costs that lies everywhere

Every tile has been voted on by five vehicles, whose drives cover five tiles each. Sixty tiles differ between the two
versions, in some 1,000 things. So views of one place, or of what has changed, show the same in both cities. Columns,
milliseconds of CPU of the server's process:

``first``: first answer after the start. ``again``: mean of further ones. ``ballot``: an answer after a ballot on five
tiles. Of the other version only the first two, and only the first where that takes more than 300 ms.
``start`` is the start itself, ``new version`` a publish that changes five tiles; both until the server rests.
"""

from __future__ import annotations

import argparse
import json
import os
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx2
import msgspec
import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests"))

from hand_made import Cell, Say, make_ballot, make_map, make_tile, states_plane, wall
from live_server import serving
from mapvote import write_map
from mapvote.codec.ballot import Ballot, encode, pack_path
from mapvote.core.grid import TILE_CELLS, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.types import CellState
from mapvote.fusion.tile_vote import Vote

TILES_A_ROW = 20
TILES_A_DRIVE = 5
VEHICLES = ("a", "b", "c", "d", "e")
CHANGED_TILES = 60
PIECES = 17
"""Things that went from each changed tile."""
HEIGHTS_M = [0.05, 0.45, 0.75, 1.05]
SIDE_M = 76.8
START_NS = 1_780_000_000 * 10**9
LIMITS = "[server]\nballots_per_minute = 1e9\ndrives_a_day = 1000000000\n"
LEAST_S = 0.3
"""Seconds of CPU over which further answers are averaged."""
LEAST_TOLD_S = 0.002
"""Less is not told apart: the clock of a process ticks every 10 ms."""
MOST_ASKED = 200
MOST_VOTED = 5
Row = dict[str, Any]


def city(tiles: int) -> PointMap:
    """Rows of tiles with ground, walls, and the pieces that will go."""
    rng = np.random.default_rng(1)
    ground = wall([(r, c) for r in range(0, 256, 8) for c in range(0, 256, 8)], [0.05])
    pieces = wall([cell for i in range(PIECES) for cell in piece(i)], HEIGHTS_M)
    made = {}
    for i in range(tiles):
        index = divmod(i, TILES_A_ROW)
        walls = rng.uniform((0.0, 60.0, 0.0), (SIDE_M, 70.0, 8.0), (2_000, 3)).astype(np.float32)
        made[index] = make_tile(np.concatenate([ground, pieces, walls]), index=index)
    return make_map(made)


def piece(number: int) -> list[Cell]:
    """Nine cells of one thing in a tile; no two of them touch."""
    row, col = divmod(number, 6)
    return [(20 + 40 * row + r, 20 + 40 * col + c) for r in range(3) for c in range(3)]


def drives(point_map: PointMap) -> Iterator[Ballot]:
    """Of every vehicle along every row, in parts."""
    every = list(point_map.tiles)
    changed = set(every[:: len(every) // CHANGED_TILES][:CHANGED_TILES])
    for number, vehicle in enumerate(VEHICLES):
        for start in range(0, len(every), TILES_A_DRIVE):
            some = every[start : start + TILES_A_DRIVE]
            yield drive(point_map, vehicle, number, some, changed)


def drive(
    point_map: PointMap, vehicle: str, number: int, tiles: list[TileIndex], changed: set[TileIndex], day: int = 0
) -> Ballot:
    """Empty ground with some noise, a ghost that only this vehicle sees, and what went from the changed tiles."""
    rng = np.random.default_rng([number, day, *tiles[0]])
    says = {}
    for tile in tiles:
        states = states_plane(fill=CellState.UNCHANGED_EMPTY)
        noise = rng.integers(0, TILE_CELLS, (2, 1_000))
        states[noise[0], noise[1]] = CellState.UNDETERMINED
        row, col = 150, 20 + 10 * number
        states[row : row + 3, col : col + 3] = CellState.CHANGED_OCCUPIED
        ghost = wall([(row + r, col + c) for r in range(3) for c in range(3)], [0.45, 0.75])
        if tile in changed:
            for cell in (cell for i in range(PIECES) for cell in piece(i)):
                states[cell] = CellState.CHANGED_EMPTY
        says[tile] = Say(states, new_points=ghost)
    end_ns = START_NS + (number + 10 * day) * 3_600 * 10**9
    name = f"d{day}-{tiles[0][0]}-{tiles[0][1]}"
    path = pack_path([np.array([x, SIDE_M * (tiles[0][0] + 0.5)]) for x in _along(tiles)], point_map.lattice)
    return msgspec.structs.replace(make_ballot(point_map, says, vehicle, name, end_ns), path=path)


def _along(tiles: list[TileIndex]) -> list[float]:
    return np.arange(SIDE_M * tiles[0][1] + 1.0, SIDE_M * (tiles[-1][1] + 1) - 1.0, 5.0).tolist()


# One server -----------------------------------------------------------------------------------------------------------


def fill(store: Path, tiles: int) -> None:
    """A store with the city, its drives and a version that they made."""
    point_map, folder = city(tiles), store.with_suffix(".map")
    write_map(point_map, folder)
    with (
        serving(store, "--map", folder, log=store.with_suffix(".log"), settings=LIMITS) as (address, _),
        httpx2.Client(base_url=address, timeout=600.0) as client,
    ):
        for ballot in drives(point_map):
            send(client, ballot)
        client.post("/v1/publish", json={"override": True}).raise_for_status()


def serve_city(filled: Path, tiles: int) -> None:
    """Serve a copy of a store, which is filled if there is none yet; print address and process, and wait for the end of
    stdin."""
    if not filled.exists():
        fill(filled, tiles)
    with TemporaryDirectory() as folder:
        store = Path(folder) / "store.db"
        with closing(sqlite3.connect(filled)) as source, closing(sqlite3.connect(store)) as copied:
            source.backup(copied)
        with serving(store, log=filled.with_suffix(".log"), settings=LIMITS) as (address, process):
            print(json.dumps({"address": address, "pid": process.pid}), flush=True)
            sys.stdin.read()


def send(client: httpx2.Client, ballot: Ballot) -> None:
    """One ballot, by the settings of the server's round, acknowledged."""
    settings_hash = client.get("/v1/policy").json()["policy"]["round"]["settings_hash"]
    ballot = msgspec.structs.replace(ballot, settings_hash=settings_hash)
    answer = client.put(f"/v1/ballots/{ballot.vehicle}/{ballot.drive}", content=encode(ballot))
    if not answer.is_success:
        raise SystemExit(f"a ballot was refused: {answer.text[:300]}")


@dataclass
class Site:
    """A server under measurement."""

    name: str
    client: httpx2.Client
    pid: int
    map: PointMap
    later: int = 0
    """Ballots sent since the start."""
    rows: dict[str, Row] = field(default_factory=dict)

    def cpu_s(self) -> float:
        """Processor time that the server has used so far."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def rest(self) -> None:
        """Until it makes nothing ahead any more."""
        before = -1.0
        while self.cpu_s() - before > 0.03:
            before = self.cpu_s()
            time.sleep(3.0)

    def ask(self, view: str) -> None:
        """One answer; a question beyond its time limit is asked again."""
        while True:
            method, path = self.requests[view]
            answer = self.client.request(method, path, json={} if method == "POST" else None)
            if "takes longer than" not in answer.text:
                break
        answer.raise_for_status()

    @property
    def requests(self) -> dict[str, tuple[str, str]]:
        """Method and path of every view."""
        tile = next(iter(self.map.tiles))
        hashes = self.hashes
        return {
            "map": ("GET", "/v1/map"),
            "map since": ("GET", "/v1/map?since=1"),
            "map/versions": ("GET", "/v1/map/versions"),
            "tile": ("GET", f"/v1/tiles/{hashes['points']}"),
            "changes": ("GET", "/v1/changes?from=1&to=2"),
            "changes/page": ("GET", "/v1/changes/page?from=1&to=2"),
            "cells": ("GET", "/v1/cells?x=6.2&y=6.2"),
            "coverage": ("GET", "/v1/coverage"),
            "coverage/passes": ("GET", "/v1/coverage/passes"),
            "vehicles": ("GET", "/v1/vehicles"),
            "policy": ("GET", "/v1/policy"),
            "info": ("GET", "/v1/info"),
            "log": ("GET", "/v1/log?events=100"),
            "paths": ("GET", "/v1/paths?vehicle=a"),
            "evidence": ("GET", f"/v1/evidence/{tile[0]}/{tile[1]}"),
            "overview": ("GET", "/v1/clouds/overview"),
            "level": ("GET", f"/v1/clouds/{hashes['points']}/{hashes['ground']}/3"),
            "clouds/changed": ("GET", "/v1/clouds/changed?from=1&to=2"),
            "desk": ("GET", "/v1/desk"),
            "publish": ("POST", "/v1/publish"),
        }

    @property
    def hashes(self) -> dict[str, str]:
        """Of one tile."""
        if not hasattr(self, "_hashes"):
            tiles = self.client.get("/v1/map").json()["tiles"]
            self._hashes: dict[str, str] = tiles[sorted(tiles)[0]]
        return self._hashes

    def timed(self, view: str, most: int = 1) -> float:
        """Mean seconds of CPU of an answer."""
        before, asked = self.cpu_s(), 0
        while asked < most and (asked == 0 or self.cpu_s() - before < LEAST_S):
            self.ask(view)
            asked += 1
        return (self.cpu_s() - before) / asked

    def after_ballots(self, view: str) -> float:
        """Mean seconds of CPU of an answer, each after one ballot."""
        self.ask(view)
        spent: list[float] = []
        while len(spent) < MOST_VOTED and sum(spent) < LEAST_S:
            self.vote()
            spent.append(self.timed(view))
        return sum(spent) / len(spent)

    def vote(self, number: int = 0, gone: bool = False) -> None:
        """One vehicle drives over five tiles once more. ``gone``: it misses what stood there."""
        self.later += 1
        every = list(self.map.tiles)
        start = TILES_A_DRIVE * (1 if gone else self.later + 1) % len(every)
        some = every[start : start + TILES_A_DRIVE]
        send(self.client, drive(self.map, VEHICLES[number], number, some, set(some) if gone else set(), self.later))

    def new_version(self) -> float:
        """Seconds of CPU of a publish that changes five tiles, and of what the server makes ahead for it."""
        for number in range(3):
            self.vote(number, gone=True)
        before = self.cpu_s()
        done = self.client.post("/v1/publish", json={"override": True}).json()
        if not done.get("published"):
            raise SystemExit(f"nothing was published: {done}")
        self.rest()
        return self.cpu_s() - before


@contextmanager
def site(name: str, tiles: int, stores: Path, python: str, tests: Path | None) -> Iterator[Site]:
    """A server on a copy of the store of this name in the folder ``stores``."""
    command = [python, __file__, "--serve", str(stores / f"{name}-{tiles}.db"), "--tiles", str(tiles)]
    environment = dict(os.environ)
    if tests is not None:
        environment["PYTHONPATH"] = os.pathsep.join([str(tests), str(tests.parent / "src")])
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
    assert child.stdout is not None
    assert child.stdin is not None
    told = json.loads(child.stdout.readline())
    try:
        with httpx2.Client(base_url=told["address"], timeout=3_600.0) as client:
            yield Site(name, client, told["pid"], city(tiles))
    finally:
        child.stdin.close()
        child.wait(60)


def measure(sites: list[Site]) -> None:
    """Every view of every server, in turns."""
    for one in sites:
        one.rest()
        one.rows["start"] = {"first": one.cpu_s()}
    for one in sites:
        one.rows["new version"] = {"first": one.new_version()}
    for view in sites[0].requests:
        for one in sites:
            one.rows[view] = {"first": one.timed(view)}
    for view in sites[0].requests:
        for one in sites:
            if one is sites[0] or one.rows[view]["first"] < LEAST_S:
                one.rows[view]["again"] = one.timed(view, MOST_ASKED)
    for view in sites[0].requests:
        sites[0].rows[view]["ballot"] = sites[0].after_ballots(view)


def table(found: dict[int, list[Site]]) -> str:
    """Seconds of every view at every size, and the ratio of the largest to the smallest city."""
    columns = [(tiles, one, column) for tiles, sites in found.items() for one in sites for column in COLUMNS]
    columns = [c for c in columns if any(c[2] in row for row in c[1].rows.values())]
    heads = [f"{tiles}: {one.name} {column}" for tiles, one, column in columns]
    lines = ["| view | " + " | ".join(heads) + " | ratio again | ratio ballot |", "|---" * (len(heads) + 3) + "|"]
    small, large = found[min(found)][0].rows, found[max(found)][0].rows
    for view in small:
        cells = [f"{1e3 * one.rows[view][c]:.1f}" if c in one.rows[view] else "" for _, one, c in columns]
        ratios = [ratio(small[view], large[view], column) for column in COLUMNS[1:]]
        lines.append("| " + " | ".join([view, *cells, *ratios]) + " |")
    return "\n".join(lines)


def compare_liar(tiles: int) -> str:
    """CPU of comparing a vehicle that says the opposite in every other cell with four that agree."""
    from mapvote.core.grid import Lattice
    from mapvote_server.questions.contradictions import compare
    from mapvote_server.questions.vehicles import standings_of

    rng, compared = np.random.default_rng(1), []
    empty = states_plane(fill=CellState.UNCHANGED_EMPTY)
    begun_s = time.process_time()
    for i in range(tiles):
        lies = np.where(rng.random(empty.shape) < 0.5, np.uint8(CellState.CHANGED_OCCUPIED), empty)
        said = (("a", 0, empty), ("b", 1, empty), ("liar", 2, lies), ("c", 3, empty), ("d", 4, empty))
        compared += compare((0, i), [Vote(name, end_ns, "", states=states) for name, end_ns, states in said])
    compared_s = time.process_time()
    *_, liar = standings_of(compared, Lattice())
    told_s = time.process_time()
    a_tile_ms, question_ms = 1e3 * (compared_s - begun_s) / tiles, 1e3 * (told_s - compared_s)
    return f"{a_tile_ms:.1f} ms a tile, once; {question_ms:.0f} ms a question; {liar.vehicle} {liar.verdict}"


COLUMNS = "first", "again", "ballot"


def ratio(small: Row, large: Row, column: str) -> str:
    """Of the large city to the small one, of at least 2 ms each."""
    if column not in small or column not in large:
        return ""
    return f"{max(large[column], LEAST_TOLD_S) / max(small[column], LEAST_TOLD_S):.2f}"


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tiles", type=int, nargs="+", default=[300, 3_000])
    parser.add_argument("--against", nargs=2, metavar=("PYTHON", "TESTS"))
    parser.add_argument("--stores", type=Path, help="folder that keeps the filled stores for another run")
    parser.add_argument("--liar", type=int, metavar="TILES", help="on so many tiles, without a server")
    parser.add_argument("--serve", type=Path, metavar="STORE", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.serve is not None:
        serve_city(asked.serve, asked.tiles[0])
        return
    if asked.liar is not None:
        print(compare_liar(asked.liar))
        return
    found: dict[int, list[Site]] = {}
    for tiles in asked.tiles:
        with ExitStack() as stack:
            stores = asked.stores or Path(stack.enter_context(TemporaryDirectory()))
            sites = [stack.enter_context(site("now", tiles, stores, sys.executable, None))]
            if asked.against:
                python, tests = asked.against
                sites.append(stack.enter_context(site("other", tiles, stores, python, Path(tests))))
            measure(sites)
            found[tiles] = sites
        print(table(found), flush=True)


if __name__ == "__main__":
    main()
