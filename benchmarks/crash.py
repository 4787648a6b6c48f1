"""Kill the server's process at random moments, again and again, and see whether anything acknowledged was lost.

    python benchmarks/crash.py --kills 200 --database sqlite
    python benchmarks/crash.py --kills 200 --database postgresql

A child takes in ballots on one thread and publishes on another; the parent kills it with SIGKILL after a random number
of acknowledgements (with PostgreSQL, every fourth time the database server itself), then opens the store as a new
process would and checks: every acknowledged ballot is there, every version is whole, the next publish succeeds. Ends
with 1 at the first failure.

With ``--server`` what is killed is `mapvote serve` itself, to which vehicles send ballots by HTTP while an operator
publishes again and again. That takes some seconds a kill.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import httpx2
import numpy as np
import sqlalchemy as sa

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from live_server import serving
from mapvote.client import MapClient
from mapvote.codec.ballot import Ballot, encode
from mapvote.config import FuseSettings
from mapvote.core.grid import TileIndex
from mapvote.core.tile import Tile
from mapvote.core.types import CellState, MapvoteError
from mapvote.server.errors import Conflict, Unavailable
from mapvote.server.store import schema
from mapvote.server.store.admission import Receipt, accept, examine
from mapvote.server.store.publish import publish
from mapvote.server.store.store import Store
from postgres_cluster import PostgresCluster

POLICY = FuseSettings(min_votes=2, max_deleted_share=1.0)
TILES = [(row, col) for row in range(2) for col in range(4)]
CELLS = [(r, c) for r in range(10, 40, 3) for c in range(10, 40, 3)]
HEIGHTS = [0.45, 0.75, 1.05]
S = 1_000_000_000
MOST = 20
"""Acknowledgements before a kill."""
LAST_S = 0.02
"""At most so long after the last of them."""
VEHICLES = 4
"""Pairs of vehicles that send to a server at once."""
Drives = list[tuple[str, str]]
"""(vehicle, drive) of what was acknowledged."""
Kill = Callable[[str, int, random.Random, "PostgresCluster | None"], Drives]
"""(database URL, number, moment, the cluster to kill too) -> what was acknowledged before."""


def first_map(url: str) -> None:
    """A store of eight tiles with a hundred pillars each."""
    tile = make_tile(np.concatenate([wall(CELLS, [0.05]), wall(CELLS, HEIGHTS)]))
    Store.create(url, make_map(dict.fromkeys(TILES, tile))).close()


def votes_on(
    content: Tile, version: int, tile: TileIndex, cell: tuple[int, int], vehicle: str, drive: str
) -> list[Ballot]:
    """Two vehicles of this version that agree: what stands in the cell is gone, or what does not stand is back."""
    point_map, points = make_map({tile: content}), content.points
    inside = (np.floor(points[:, 1] / 0.3) == cell[0]) & (np.floor(points[:, 0] / 0.3) == cell[1])
    stands = bool((inside & (points[:, 2] > 0.3)).any())
    state = CellState.CHANGED_EMPTY if stands else CellState.CHANGED_OCCUPIED
    say = Say(states_plane({cell: state}), new_points=None if stands else wall([cell], HEIGHTS))
    now = time.time_ns()
    return [make_ballot(point_map, {tile: say}, f"{vehicle}{i}", drive, now - S + i, version=version) for i in range(2)]


def newest(store: Store, tile: TileIndex) -> tuple[Tile, int]:
    """A tile of the newest version, and the version's number."""
    version = store.current()
    content = store.tile(version, tile)
    assert content is not None
    return content, version


def work(url: str, seed: int, acknowledge: int) -> None:
    """Take in ballots and publish until killed; one line per acknowledged ballot goes to ``acknowledge``."""
    store = Store.open(url)
    rng = random.Random(seed)

    def publish_for_ever() -> None:
        while True:
            with contextlib.suppress(Unavailable):  # the database may be gone already
                publish(store, POLICY)
            time.sleep(0.002)

    for ballot in votes_on(*newest(store, TILES[0]), TILES[0], CELLS[0], "warm", "warm"):
        examine(encode(ballot))  # compiled code is loaded before the clock starts
    threading.Thread(target=publish_for_ever, daemon=True).start()
    os.write(acknowledge, b"ready\n")
    turn = 0
    while True:
        turn += 1
        tile = rng.choice(TILES)
        ballots = votes_on(*newest(store, tile), tile, rng.choice(CELLS), "v", f"{seed}.{turn}")
        for receipt in accept(store, [examine(encode(ballot)) for ballot in ballots]):
            if isinstance(receipt, Receipt):
                os.write(acknowledge, f"{receipt.vehicle} {receipt.drive}\n".encode())
            elif not isinstance(receipt, Conflict):  # published meanwhile: an honest refusal
                raise receipt


def killed_once(url: str, seed: int, rng: random.Random, cluster: PostgresCluster | None) -> Drives:
    """Start a worker, kill it (or the database under it); what it had acknowledged."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        try:
            work(url, seed, writing)
        finally:
            os._exit(7)
    os.close(writing)
    with os.fdopen(reading) as lines:
        if lines.readline() != "ready\n":
            raise SystemExit(f"kill {seed}: the worker ended before it began (status {os.waitpid(child, 0)[1]})")
        told = [lines.readline() for _ in range(rng.randint(1, MOST))]
        time.sleep(rng.uniform(0.0, LAST_S))
        if cluster is not None:
            cluster.stop(crash=True)
        os.kill(child, signal.SIGKILL)
        acknowledged = [(words[0], words[1]) for line in (*told, *lines) if len(words := line.split()) == 2]
    status = os.waitpid(child, 0)[1]
    if cluster is not None:
        cluster.start()
    elif os.WTERMSIG(status) != signal.SIGKILL:
        raise SystemExit(f"kill {seed}: the worker ended by itself (status {status})")
    return acknowledged


class Traffic:
    """Vehicles and an operator at one server, until it is gone."""

    def __init__(self, url: str, seed: int, home: Path) -> None:
        self.acknowledged: Drives = []
        self._news = threading.Condition()
        self._url, self._seed, self._home = url, seed, home
        self._over = threading.Event()
        self._threads = [threading.Thread(target=self._vehicles, args=(i,)) for i in range(VEHICLES)]
        self._threads.append(threading.Thread(target=self._operator))
        for thread in self._threads:
            thread.start()

    def wait(self, acknowledged: int) -> None:
        """Until so many ballots are acknowledged."""
        with self._news:
            if not self._news.wait_for(lambda: len(self.acknowledged) >= acknowledged, 120.0):
                raise SystemExit(f"kill {self._seed}: {len(self.acknowledged)} ballots were acknowledged in 120 s")

    def end(self) -> None:
        """After the kill: wait until everybody has noticed."""
        self._over.set()
        for thread in self._threads:
            thread.join()

    def _vehicles(self, number: int) -> None:
        rng, turn = random.Random(self._seed * VEHICLES + number), 0
        with MapClient(self._url, home=self._home / str(number), attempts=1) as client:
            while not self._over.is_set():
                turn += 1
                tile, cell = rng.choice(TILES), rng.choice(CELLS)
                with contextlib.suppress(MapvoteError):  # gone, or published meanwhile: an honest refusal
                    point_map = client.fetch()
                    content, version = point_map.tiles[tile], point_map.version or 1
                    for ballot in votes_on(content, version, tile, cell, f"v{number}", f"{self._seed}.{turn}"):
                        if client.send(ballot) != "spooled":
                            with self._news:
                                self.acknowledged.append((ballot.vehicle, ballot.drive))
                                self._news.notify_all()

    def _more_than(self, seen: int) -> bool:
        return len(self.acknowledged) > seen

    def _operator(self) -> None:
        seen = 0
        with httpx2.Client(base_url=self._url, timeout=10.0) as http:
            while not self._over.is_set():
                with self._news:  # without a pause no vehicle ever has the newest map on a slow machine
                    self._news.wait_for(partial(self._more_than, seen), 0.5)
                    seen = len(self.acknowledged)
                with contextlib.suppress(httpx2.TransportError):
                    http.request("POST", "/v1/publish", json={"override": True})


def killed_server(url: str, seed: int, rng: random.Random, cluster: PostgresCluster | None) -> Drives:
    """Start a server, kill it (and the database under it)."""
    with tempfile.TemporaryDirectory() as name:
        folder, log = Path(name), Path(name) / "log"
        (folder / "server.toml").write_text("[server]\ndrives_a_day = 1000000\n")
        store = url.removeprefix("sqlite:///")
        with serving(store, "--config", folder / "server.toml", log=log) as (address, process):
            traffic = Traffic(address, seed, folder)
            try:
                traffic.wait(rng.randint(1, MOST))
                time.sleep(rng.uniform(0.0, LAST_S))
                if cluster is not None:
                    cluster.stop(crash=True)
                if process.poll() is not None:
                    raise SystemExit(f"kill {seed}: the server ended by itself: {log.read_text()[-4000:]}")
            finally:
                process.kill()
                traffic.end()
        if "Traceback" in log.read_text():
            raise SystemExit(f"kill {seed}: the server stumbled: {log.read_text()[-4000:]}")
    if cluster is not None:
        cluster.start()
    return traffic.acknowledged


def check(url: str, acknowledged: set[tuple[str, str]], whole: set[int]) -> int:
    """Open the store anew, look at everything, publish; the newest version. SystemExit says what is wrong."""
    store = Store.open(url)
    try:
        with store.database.reading() as connection:
            if store.database.is_sqlite:
                verdict = connection.exec_driver_sql("PRAGMA integrity_check").scalar_one()
                if verdict != "ok":
                    raise SystemExit(f"SQLite is damaged: {verdict}")
            b = schema.ballots.c
            known = {(row.vehicle, row.drive) for row in connection.execute(sa.select(b.vehicle, b.drive))}
        lost = acknowledged - known
        if lost:
            raise SystemExit(f"{len(lost)} acknowledged ballots are lost, for example {sorted(lost)[0]}")
        versions = [version.number for version in store.versions()]
        if versions != list(range(1, len(versions) + 1)):
            raise SystemExit(f"versions have gaps: {versions}")
        for number in versions:
            if number not in whole:
                if len(store.point_map(number).tiles) != len(TILES):  # every plane is checked against its hash
                    raise SystemExit(f"version {number} lacks tiles")
                whole.add(number)
        publish(store, POLICY)
        return store.current()
    except MapvoteError as error:
        raise SystemExit(f"after the kill: {type(error).__name__}: {error}") from error
    finally:
        store.close()


def run(url: str, kills: int, seed: int, cluster: PostgresCluster | None, kill: Kill) -> None:
    """``kills`` rounds on one store; prints a line at the end."""
    first_map(url)
    rng = random.Random(seed)
    acknowledged: set[tuple[str, str]] = set()
    whole: set[int] = set()
    newest = 1
    for i in range(kills):
        power_cut = cluster if cluster is not None and i % 4 == 3 else None
        acknowledged |= set(kill(url, seed * 1000 + i, rng, power_cut))
        newest = check(url, acknowledged, whole)
        if i % 10 == 9:
            print(f"{i + 1} kills, {len(acknowledged)} acknowledged ballots", file=sys.stderr)
    print(f"{kills} kills: {len(acknowledged)} acknowledged ballots, all there; {newest} versions, all whole")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--database", choices=("sqlite", "postgresql"), default="sqlite")
    parser.add_argument("--server", action="store_true", help="kill `mapvote serve` under HTTP load")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    kill: Kill = killed_server if options.server else killed_once
    if options.database == "sqlite":
        with tempfile.TemporaryDirectory() as folder:
            run(f"sqlite:///{folder}/store.db", options.kills, options.seed, None, kill)
        return
    cluster = PostgresCluster()
    try:
        run(cluster.create("crash"), options.kills, options.seed, cluster, kill)
    finally:
        cluster.close()


if __name__ == "__main__":
    main()
