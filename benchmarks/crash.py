"""Kill `mapvote serve` at random moments, again and again, and see whether anything acknowledged was lost.

    python benchmarks/crash.py --kills 200 --database sqlite
    python benchmarks/crash.py --kills 200 --database postgresql

Vehicles send ballots by HTTP while an operator publishes again and again; the server is killed with SIGKILL after a
random number of acknowledgements (with PostgreSQL, every fourth time the database server too). Then the store is opened
as a new process would open it: every acknowledged ballot is there, every version is whole, the next publish succeeds.
Ends with 1 at the first failure.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import sys
import tempfile
import threading
import time
from pathlib import Path

import httpx2
import numpy as np
import sqlalchemy as sa

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from live_server import serving
from mapvote.client import MapClient
from mapvote.codec.ballot import Ballot
from mapvote.config import FuseSettings
from mapvote.core.grid import TileIndex
from mapvote.core.tile import Tile
from mapvote.core.types import CellState, MapvoteError
from mapvote_server.store import schema
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from postgres_cluster import PostgresCluster, cluster_for

POLICY = FuseSettings(min_votes=2, max_deleted_share=1.0)
TILES = [(row, col) for row in range(2) for col in range(4)]
CELLS = [(r, c) for r in range(10, 40, 3) for c in range(10, 40, 3)]
HEIGHTS = [0.45, 0.75, 1.05]
MOST = 20
"""Acknowledgements before a kill."""
LAST_S = 0.02
"""At most so long after the last of them."""
VEHICLES = 4
"""Pairs of vehicles that send to a server at once."""
Drives = list[tuple[str, str]]
"""(vehicle, drive) of what was acknowledged."""


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
    return [
        make_ballot(point_map, {tile: say}, f"{vehicle}{i}", drive, now - 10**9 + i, version=version) for i in range(2)
    ]


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

    def _operator(self) -> None:
        seen = 0
        with httpx2.Client(base_url=self._url, timeout=10.0) as http:
            while not self._over.is_set():
                with self._news:  # without a pause no vehicle ever has the newest map on a slow machine
                    self._news.wait_for(lambda seen=seen: len(self.acknowledged) > seen, 0.5)
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--database", choices=("sqlite", "postgresql"), default="sqlite")
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    rng, newest, whole = random.Random(asked.seed), 1, set[int]()
    acknowledged = set[tuple[str, str]]()
    with tempfile.TemporaryDirectory() as folder, cluster_for(asked.database) as cluster:
        url = cluster.create("crash") if cluster else f"sqlite:///{folder}/store.db"
        tile = make_tile(np.concatenate([wall(CELLS, [0.05]), wall(CELLS, HEIGHTS)]))
        Store.create(url, make_map(dict.fromkeys(TILES, tile))).close()
        for i in range(asked.kills):
            acknowledged |= set(killed_server(url, asked.seed * 1000 + i, rng, cluster if i % 4 == 3 else None))
            newest = check(url, acknowledged, whole)
            if i % 10 == 9:
                print(f"{i + 1} kills, {len(acknowledged)} acknowledged ballots", file=sys.stderr)
    print(f"{asked.kills} kills: {len(acknowledged)} acknowledged ballots, all there; {newest} versions, all whole")


if __name__ == "__main__":
    main()
