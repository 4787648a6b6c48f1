"""A real server process on loopback, with keys, under two kinds of load (attacks: hostile.py).

    python benchmarks/server.py load --seconds 20          # ballots a second, each durable before its answer
    python benchmarks/server.py readers --tiles 1000       # one publish while a hundred clients read the manifest
    .. --database postgresql

``load``: every connection is a vehicle that sends one ballot of about 20 kB after another and waits for each answer;
afterwards every acknowledged ballot is looked up in the store.
``readers``: waits are those of answers that were on their way while it published, or up to 2 s after: the new manifest
is made then. Every manifest must be wholly of one version. Then 64 operators publish at once: exactly one may win.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import sqlalchemy as sa

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hand_made import Cell, Say, make_ballot, make_map, make_tile, states_plane, wall
from live_server import serving
from mapvote.codec.ballot import Ballot, encode
from mapvote.core.grid import TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.types import CellState
from mapvote_server.store import schema
from mapvote_server.store.keys import ROLES, issue
from mapvote_server.store.store import Store
from postgres_cluster import cluster_for
from stores import send

Address = tuple[str, int]
Answer = tuple[int, bytes]
Row = dict[str, Any]
LIMITS = "[server]\nballots_per_minute = 1e9\ndrives_a_day = 1000000000\n"
HEIGHTS = [0.45, 0.75, 1.05]


# One harness --------------------------------------------------------------------------------------------------------


def pillars(tiles: list[TileIndex], cells: list[Cell]) -> PointMap:
    """A map of tiles that all carry the same pillars, each a little higher than the one before."""
    points = np.concatenate([wall(cells, [0.05]), wall(cells, HEIGHTS)])
    return make_map({t: make_tile(points + np.float32(1e-3 * (i % 90)), index=t) for i, t in enumerate(tiles)})


def typical_ballot(point_map: PointMap) -> Ballot:
    """About 24 kB: eight tiles of states with noisy borders and a few new points, as after a 500 m drive."""
    rng, says = np.random.default_rng(1), {}
    for tile in list(point_map.tiles)[:8]:
        states = states_plane(fill=CellState.UNCHANGED_EMPTY)
        ragged = rng.random(states.shape) < 0.023
        states[ragged] = rng.integers(0, 5, int(ragged.sum()))
        cells = [(int(r), int(c)) for r, c in rng.integers(0, 256, (20, 2))]
        says[tile] = Say(states, new_points=wall(cells, [0.45, 0.75]))
    return make_ballot(point_map, says, "vehicle", "drive", end_ns=time.time_ns())


def as_drive(ballot: Ballot, vehicle: str, drive: str) -> tuple[str, bytes]:
    """(path, body) of the same votes, of another drive."""
    body = encode(msgspec.structs.replace(ballot, vehicle=vehicle, drive=drive))
    return f"/v1/ballots/{vehicle}/{drive}", body


@dataclass
class Site:
    """A server on a store, and a key for each name."""

    address: Address
    process: Any
    url: str
    keys: dict[str, str]

    def cpu_s(self) -> float:
        """Processor time that the server has used so far."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def site(database: str, point_map: PointMap, fill: Callable[[Store], object], vehicles: list[str]) -> Iterator[Site]:
    """Started on a new store that ``fill`` has filled; SystemExit if it stumbles."""
    with tempfile.TemporaryDirectory() as name, cluster_for(database) as cluster:
        url = cluster.create("bench") if cluster else f"sqlite:///{name}/store.db"
        store = Store.create(url, point_map)
        fill(store)
        keys = {vehicle: issue(store, vehicle, "vehicle") for vehicle in vehicles}
        keys |= {role: issue(store, role, role) for role in ROLES if role != "vehicle"}
        store.close()
        config, log = Path(name) / "server.toml", Path(name) / "log"
        config.write_text(LIMITS)
        with serving(url.removeprefix("sqlite:///"), "--config", config, log=log) as (address, process):
            host, port = address.removeprefix("http://").split(":")
            yield Site((host, int(port)), process, url, keys)
        if "Traceback" in log.read_text():
            raise SystemExit(f"the server stumbled: {log.read_text()[-3000:]}")


async def ask(address: Address, method: str, path: str, key: str, body: bytes = b"") -> Answer:
    """One request on a connection of its own; without a key, if that is empty."""
    reader, writer = await asyncio.open_connection(*address)
    try:
        head = f"{method} {path} HTTP/1.1\r\nHost: localhost\r\n"
        head += f"Authorization: Bearer {key}\r\n" if key else ""
        head += f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
        writer.write(head.encode() + body)
        answer = await reader.read()
    finally:
        writer.close()
    header, _, content = answer.partition(b"\r\n\r\n")
    return int(header.split()[1]), content


def percentiles(name: str, waits_s: list[float]) -> Row:
    """p50, p99 and worst, ms."""
    p50, p99, worst = np.percentile(waits_s, [50, 99, 100]) * 1e3
    return {f"{name}_p50_ms": round(p50, 1), f"{name}_p99_ms": round(p99, 1), f"{name}_max_ms": round(worst, 1)}


# Load ---------------------------------------------------------------------------------------------------------------


async def send_drives(at: Site, ballot: Ballot, vehicle: str, stop_s: float, waits_s: list[float]) -> list[str]:
    """One drive after another on one connection; the drives that were acknowledged."""
    reader, writer = await asyncio.open_connection(*at.address)
    drives = []
    while time.perf_counter() < stop_s:
        drive, start = f"d{time.monotonic_ns()}", time.perf_counter()
        path, body = as_drive(ballot, vehicle, drive)
        head = f"PUT {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {at.keys[vehicle]}\r\n"
        writer.write(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body)
        header = await reader.readuntil(b"\r\n\r\n")
        content = await reader.readexactly(int(header.lower().split(b"content-length:")[1].split(b"\r\n")[0]))
        if not header.startswith(b"HTTP/1.1 201"):
            raise SystemExit(f"refused: {header.splitlines()[0].decode()} {content.decode()}")
        waits_s.append(time.perf_counter() - start)
        drives.append(drive)
    writer.close()
    return drives


def load(options: argparse.Namespace) -> Row:
    """Ballots a second, and how long one waits."""
    point_map = pillars([(0, col) for col in range(8)], [(r, c) for r in range(10, 40, 3) for c in range(10, 40, 3)])
    ballot, vehicles = typical_ballot(point_map), [f"v{i}" for i in range(options.connections)]

    async def all_at_once(at: Site, seconds: float, waits_s: list[float]) -> set[tuple[str, str]]:
        stop_s = time.perf_counter() + seconds
        sent = await asyncio.gather(*(send_drives(at, ballot, vehicle, stop_s, waits_s) for vehicle in vehicles))
        return {(vehicle, drive) for vehicle, drives in zip(vehicles, sent, strict=True) for drive in drives}

    waits_s: list[float] = []
    with site(options.database, point_map, lambda store: None, vehicles) as at:
        asyncio.run(all_at_once(at, 2.0, []))
        start, cpu_s = time.perf_counter(), at.cpu_s()
        acknowledged = asyncio.run(all_at_once(at, options.seconds, waits_s))
        took, cpu_s = time.perf_counter() - start, at.cpu_s() - cpu_s
        store = Store.open(at.url)
        with store.database.reading() as connection:
            b = schema.ballots.c
            there = {(row.vehicle, row.drive) for row in connection.execute(sa.select(b.vehicle, b.drive))}
        store.close()
    if not acknowledged <= there:
        raise SystemExit(f"{len(acknowledged - there)} acknowledged ballots are not in the store")
    found = {"ballots_per_s": round(len(waits_s) / took), "server_cpu_ms": round(1e3 * cpu_s / len(waits_s), 2)}
    return found | percentiles("ballot", waits_s) | {"ballots": len(waits_s), "bytes": len(encode(ballot))}


# Readers ------------------------------------------------------------------------------------------------------------


def vote_away(store: Store, pillar: Cell) -> None:
    """Two vehicles that saw one pillar gone in every tile."""
    point_map, say = store.point_map(), Say(states_plane({pillar: CellState.CHANGED_EMPTY}))
    for vehicle in ("a", "b"):
        send(store, make_ballot(point_map, dict.fromkeys(point_map.tiles, say), vehicle, "d", time.time_ns()))


async def publish_while_read(at: Site, readers: int, pause_s: float) -> Row:
    """One publish meanwhile; SystemExit if a version ever shows two faces."""
    done, waits_s, faces = asyncio.Event(), list[tuple[float, float]](), dict[int, frozenset[str]]()

    async def read() -> None:
        while not done.is_set():  # the first time after a pause too: vehicles do not all wake at once
            await asyncio.sleep(random.uniform(0.0, 2.0 * pause_s))
            start = time.perf_counter()
            status, content = await ask(at.address, "GET", "/v1/map", at.keys["reader"])
            waits_s.append((start, time.perf_counter() - start))
            manifest = json.loads(content)
            hashes = frozenset(f"{key} {planes['points']}" for key, planes in manifest["tiles"].items())
            if status != 200 or faces.setdefault(manifest["version"], hashes) != hashes:
                raise SystemExit(f"{status}: version {manifest.get('version')} is a mixture")

    reading = [asyncio.create_task(read()) for _ in range(readers)]
    await asyncio.sleep(2.0 * pause_s + 1.0)
    start = time.perf_counter()
    status, content = await ask(at.address, "POST", "/v1/publish", at.keys["operator"], b'{"override": true}')
    end = time.perf_counter()
    await asyncio.sleep(2.0 * pause_s + 1.0)
    done.set()
    await asyncio.gather(*reading)
    if status != 200 or set(faces) != {1, 2} or faces[1] & faces[2]:
        raise SystemExit(f"publish: {status} {content[:300]!r}; versions {set(faces)}, every tile should differ")
    meanwhile = [wait for asked, wait in waits_s if asked + wait > start and asked < end + 2.0]
    return {"publish_s": round(end - start, 2), "manifests_read": len(waits_s)} | percentiles("read", meanwhile)


def readers(options: argparse.Namespace) -> Row:
    """One publish of many tiles among readers, then many publishers of a few."""
    side, two = int(np.ceil(np.sqrt(options.tiles))), [(10, 10), (10, 20)]
    tiles = [(i // side, i % side) for i in range(options.tiles)]
    with site(options.database, pillars(tiles, two), lambda store: vote_away(store, two[0]), []) as at:
        found = asyncio.run(publish_while_read(at, options.readers, 2.0))
    with site(options.database, pillars(tiles[:4], two), lambda store: vote_away(store, two[0]), []) as at:

        async def at_once() -> list[Answer]:
            body, key = b'{"override": true, "parent": 1}', at.keys["operator"]
            return await asyncio.gather(*(ask(at.address, "POST", "/v1/publish", key, body) for _ in range(64)))

        answers = Counter(status for status, _ in asyncio.run(at_once()))
    if answers != {200: 1, 409: 63}:
        raise SystemExit(f"64 publishers got {dict(answers)}")
    return {"tiles": options.tiles, "readers": options.readers} | found | {"64_publishers": dict(answers)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["load", "readers"])
    parser.add_argument("--database", choices=("sqlite", "postgresql"), default="sqlite")
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--connections", type=int, default=24)
    parser.add_argument("--tiles", type=int, default=1000)
    parser.add_argument("--readers", type=int, default=100)
    options = parser.parse_args()
    measure = {"load": load, "readers": readers}[options.what]
    print(json.dumps({"what": options.what, "database": options.database} | measure(options)))


if __name__ == "__main__":
    main()
