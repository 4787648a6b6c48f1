"""A city at once: every tile of a large map is published in one version while readers read.

    python benchmarks/city.py                                     # 1,000 and 3,000 tiles
    python benchmarks/city.py --tiles 1000 28000                  # the city: some 15 minutes of CPU
    python benchmarks/city.py --tiles 1000 --database postgresql
    python benchmarks/city.py --versions                          # views after 3 and after 300 versions

Nine vehicles vote on every tile: one house fell, one kiosk rose (fusion.py). The ballots of a block of 100 tiles go
through admission; the rows of that block are then copied over the city, for what a row says does not depend on where
its tile lies. So the planes of the map and of the new version repeat, and the database is smaller than that of a city;
the server treats every tile by itself all the same.

CPU is that of the server's process without the share of the readers, which is measured while nothing is published.
``memory_mb`` is its highest resident memory: before the publish, when it has ended, and after the readers have fetched
what has changed. Readers ask for what has changed in the map, and for a plane of a tile.

A second server, with a store of 100 tiles, has readers of the same kind and publishes nothing. It waits for the cores
as the first does: ``beside`` are its waits during the publish, so ``meanwhile`` against ``beside`` is what the publish
itself costs a reader, whatever else the machine does.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import sqlalchemy as sa

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fusion import Fleet, street
from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from live_server import serving
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote_server.store import schema
from mapvote_server.store.database import insert_rows
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from postgres_cluster import cluster_for
from server import Answer, Row, Site, ask, percentiles
from stores import send

BLOCK = 10
"""Tiles on a side of the block that vehicles vote on."""
LIMITS = "[server]\nquestion_s = 600.0\nrows_per_minute = 1e12\nwork_s_per_minute = 1e9\n"
OPEN_POLICY = Policy(fuse=FuseSettings(max_deleted_share=1.0, max_freed_share=1.0, max_change_m2=1e6))


# The store ----------------------------------------------------------------------------------------------------------


def build(url: str, tiles: int, vehicles: int) -> None:
    """A store with so many tiles, a multiple of the block's, on each of which all vehicles have voted."""
    places = [(row, col) for row in range(BLOCK) for col in range(BLOCK)]
    store = Store.create(url, street(places), OPEN_POLICY)
    Fleet(store, places, vehicles).vote(vehicles)
    blocks = tiles // len(places)
    a_side = 1
    while a_side * a_side < blocks:
        a_side += 1
    with store.database.writing() as connection:
        for block in range(1, blocks):
            spread(connection, block, BLOCK * (block // a_side), BLOCK * (block % a_side))
    store.close()


def spread(connection: sa.Connection, block: int, rows: int, cols: int) -> None:
    """Copy the first block's tiles and votes by so many rows and columns."""
    b = schema.ballots
    e = schema.events
    ballots = connection.execute(sa.select(b).where(b.c.drive == "d").order_by(b.c.seq)).all()
    first = connection.execute(sa.select(sa.func.max(e.c.seq))).scalar_one() + 1 - ballots[0].seq
    events = connection.execute(sa.select(e).where(e.c.seq.in_([one.seq for one in ballots])).order_by(e.c.seq)).all()
    insert_rows(connection, e, [(one.seq + first, *tuple(one)[1:-1]) for one in events])
    copied = []
    for one in ballots:
        said = dict(one._mapping) | {"seq": one.seq + first, "first_seq": one.first_seq + first, "drive": f"d{block}"}
        copied.append(tuple(said.values())[:-1])
    insert_rows(connection, b, copied)
    for table, moved in ((schema.version_tiles, {"row": rows, "col": cols}), (schema.ballot_tiles, {})):
        moved = {"row": rows, "col": cols} | ({"ballot": first} if table is schema.ballot_tiles else moved)
        columns = [c + moved[c.name] if c.name in moved else c for c in table.c]
        of_block = table.c.row.between(0, BLOCK - 1) & table.c.col.between(0, BLOCK - 1)
        connection.execute(table.insert().from_select(list(table.c.keys()), sa.select(*columns).where(of_block)))


# The server ---------------------------------------------------------------------------------------------------------


def memory_mb(at: Site) -> int:
    """Highest resident memory of the server so far."""
    status = Path(f"/proc/{at.process.pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) // 1024


def site_of(address: str, process: subprocess.Popen[str]) -> Site:
    """A server that runs."""
    host, port = address.removeprefix("http://").split(":")
    return Site((host, int(port)), process, "", {})


async def rest(at: Site) -> None:
    """Wait until the server has made the overview of its first version."""
    used_s = 1.0
    while used_s > 0.05:
        before_s = at.cpu_s()
        await asyncio.sleep(3.0)
        used_s = at.cpu_s() - before_s


async def timed(at: Site, path: str) -> tuple[float, Answer]:
    """Milliseconds that an answer takes, and the answer; SystemExit if it is an error."""
    start = time.perf_counter()
    status, content = await ask(at.address, "GET", path, "")
    took = 1e3 * (time.perf_counter() - start)
    if status != 200:
        raise SystemExit(f"{path}: {status} {content[:300]!r}")
    return took, (status, content)


@dataclass
class Readers:
    """Clients that read all the time."""

    at: Site
    paths: list[str]
    pause_s: float
    waits: list[tuple[float, float]] = field(default_factory=list)
    """(when asked, how long it took), seconds."""
    done: asyncio.Event = field(default_factory=asyncio.Event)

    async def read(self) -> None:
        """One of them."""
        while not self.done.is_set():
            await asyncio.sleep(random.uniform(0.0, 2.0 * self.pause_s))
            start = time.perf_counter()
            status, content = await ask(self.at.address, "GET", random.choice(self.paths), "")
            self.waits.append((start, time.perf_counter() - start))
            if status != 200:
                raise SystemExit(f"a reader got {status}: {content[:300]!r}")

    def between(self, start: float, end: float) -> list[float]:
        """Waits of the answers that were on their way then, seconds."""
        return [wait for asked, wait in self.waits if asked + wait > start and asked < end]


async def readers_of(at: Site, readers: int) -> tuple[Readers, list[asyncio.Task[None]]]:
    """Readers of the newest version, who have begun."""
    _, (_, content) = await timed(at, "/v1/map")
    manifest = json.loads(content)
    planes = sorted({hashes["points"] for hashes in manifest["tiles"].values()})
    reading = Readers(at, [f"/v1/map?since={manifest['version']}", f"/v1/tiles/{planes[0]}"], 1.0)
    return reading, [asyncio.create_task(reading.read()) for _ in range(readers)]


async def measured(at: Site, beside: Site, tiles: int, readers: int, idle_s: float) -> Row:
    """One publish of all tiles."""
    await timed(at, "/v1/map")
    coverage = [(await timed(at, "/v1/coverage"))[0] for _ in range(3)]
    await rest(at)
    before_mb = memory_mb(at)
    await rest(beside)
    reading, tasks = await readers_of(at, readers)
    reading_beside, tasks_beside = await readers_of(beside, readers)
    await asyncio.sleep(2.0)
    start = time.perf_counter()
    cpu_s = at.cpu_s()
    await asyncio.sleep(idle_s)
    idle = reading.between(start, time.perf_counter())
    a_read_s = (at.cpu_s() - cpu_s) / len(idle)
    cpu_s = at.cpu_s()
    start = time.perf_counter()
    status, content = await ask(at.address, "POST", "/v1/publish", "", b'{"override": true}')
    end = time.perf_counter()
    published_mb = memory_mb(at)
    used_s = at.cpu_s() - cpu_s - a_read_s * len(reading.between(start, end))
    told = json.loads(content)
    if status != 200 or len(told["tiles"]) != tiles:
        raise SystemExit(f"publish: {status} {content[:500]!r}")
    await asyncio.sleep(3.0)
    for one in (reading, reading_beside):
        one.done.set()
    await asyncio.gather(*tasks, *tasks_beside)
    after = [(await timed(at, "/v1/coverage"))[0] for _ in range(2)]
    return {
        "tiles": tiles,
        "publish_s": round(end - start, 1),
        "cpu_ms_a_tile": round(1e3 * used_s / tiles, 2),
        "memory_before_mb": before_mb,
        "memory_published_mb": published_mb,
        "memory_mb": memory_mb(at),
        "coverage_first_ms": round(coverage[0], 1),
        "coverage_again_ms": round(min(coverage[1:]), 1),
        "coverage_after_ms": [round(one, 1) for one in after],
        **percentiles("idle", idle),
        **percentiles("meanwhile", reading.between(start, end)),
        **percentiles("beside", reading_beside.between(start, end)),
        **percentiles("after", reading.between(end, end + 3.0)),
        "reads": len(reading.waits),
        "load": [round(one, 1) for one in os.getloadavg()],
    }


def city(options: argparse.Namespace, tiles: int) -> Row:
    """One store, one server, one publish."""
    with tempfile.TemporaryDirectory(dir=options.folder) as name, cluster_for(options.database) as cluster:
        url = cluster.create("bench") if cluster else f"sqlite:///{name}/store.db"
        start = time.perf_counter()
        build(url, tiles, options.vehicles)
        built_s = time.perf_counter() - start
        small = Path(name) / "beside.db"
        build(f"sqlite:///{small}", BLOCK**2, 2)
        with (
            serving(url.removeprefix("sqlite:///"), log=Path(name) / "log", settings=LIMITS) as served,
            serving(small, log=Path(name) / "log_beside", settings=LIMITS) as served_beside,
        ):
            at = site_of(*served)
            found = asyncio.run(measured(at, site_of(*served_beside), tiles, options.readers, options.idle))
        size = 0 if cluster else sum(file.stat().st_size for file in Path(name).glob("store.db*"))
    return found | {"built_s": round(built_s, 1), "store_mb": size // 2**20}


# Versions -----------------------------------------------------------------------------------------------------------


def pillar_gone(store: Store, version: int) -> None:
    """A version that takes one pillar from one tile."""
    place = 0, version % 8
    states = states_plane({(10 + 2 * (version // 8), 10): CellState.CHANGED_EMPTY})
    base = store.point_map()
    for vehicle in "ab":
        send(store, make_ballot(base, {place: Say(states)}, vehicle, f"d{version}", end_ns=10**12 * version))
    if not publish(store, override=True).published:
        raise SystemExit(f"version {version} changed nothing")


def versions(folder: Path) -> list[Row]:
    """Views after 3 and after 300 versions of one changed tile each."""
    cells = [(10 + 2 * i, 10) for i in range(60)]
    points = wall(cells, [0.05, 0.45, 0.75, 1.05])
    file = folder / "versions.db"
    store = Store.create(f"sqlite:///{file}", make_map({(0, col): make_tile(points) for col in range(8)}), OPEN_POLICY)
    rows = []
    for number in range(1, 300):
        pillar_gone(store, number)
        if store.current() in (3, 300):
            rows.append(asyncio.run(viewed(file, folder / "log", store.current(), number)))
    store.close()
    return rows


async def viewed_at(at: Site, newest: int, last: int) -> Row:
    """CPU of the first answer and of further ones, milliseconds."""
    y = (10 + 2 * (last // 8) + 0.5) * 0.3
    x = (last % 8) * 76.8 + 10.5 * 0.3
    row: Row = {"versions": newest}
    paths = {"changes": f"/v1/changes?from={newest - 1}&to={newest}", "explain": f"/v1/cells?x={x}&y={y}"}
    await timed(at, paths["explain"])  # compiles what both need
    for name, path in paths.items():
        for turn, times in (("first", 1), ("again", 40)):
            cpu_s = at.cpu_s()
            for _ in range(times):
                await timed(at, path)
            row[f"{name}_{turn}_ms"] = round(1e3 * (at.cpu_s() - cpu_s) / times, 1)
    return row


async def viewed(file: Path, log: Path, newest: int, last: int) -> Row:
    """The same of a server that has just begun."""
    with serving(file, log=log, settings=LIMITS) as served:
        at = site_of(*served)
        await timed(at, "/v1/info")
        return await viewed_at(at, newest, last)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tiles", type=int, nargs="+", default=[1000, 3000])
    parser.add_argument("--vehicles", type=int, default=9)
    parser.add_argument("--database", choices=("sqlite", "postgresql"), default="sqlite")
    parser.add_argument("--readers", type=int, default=20)
    parser.add_argument("--idle", type=float, default=15.0, help="seconds of reading before the publish")
    parser.add_argument("--versions", action="store_true")
    parser.add_argument("--folder", type=Path, help="where the databases lie meanwhile")
    options = parser.parse_args()
    if options.versions:
        with tempfile.TemporaryDirectory(dir=options.folder) as name:
            for row in versions(Path(name)):
                print(json.dumps(row), flush=True)
        return
    for tiles in options.tiles:
        print(json.dumps({"database": options.database} | city(options, tiles)), flush=True)


if __name__ == "__main__":
    main()
