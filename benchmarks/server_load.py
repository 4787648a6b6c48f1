"""How many ballots a second a real server process acknowledges durably, and how long one waits.

    python benchmarks/server_load.py --seconds 20 --connections 24
    python benchmarks/server_load.py --database postgresql

Every connection is a vehicle of its own, with a key of its own, that sends one ballot of about 20 kB after another and
waits for each answer. An answer comes only once the transaction that holds the ballot is on disk (SQLite: WAL,
synchronous=FULL; PostgreSQL: fsync and synchronous_commit on). Server and senders share this machine; the senders are
prepared bytes on raw sockets, in a process apart from the server, so that they take little of it. Every answer is
looked at, and afterwards every acknowledged ballot is looked up in the store.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import sqlalchemy as sa
import uvloop

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from live_server import serving
from mapvote.codec.ballot import Ballot, encode
from mapvote.core.point_map import PointMap
from mapvote.core.types import CellState
from mapvote.server.store import schema
from mapvote.server.store.keys import issue
from mapvote.server.store.store import Store
from postgres_cluster import PostgresCluster

TILES = [(0, col) for col in range(8)]
CELLS = [(r, c) for r in range(10, 40, 3) for c in range(10, 40, 3)]


def typical_ballot() -> Ballot:
    """About 20 kB: eight tiles of states with noisy borders and a few hundred new points, as after a 500 m drive."""
    rng = np.random.default_rng(1)
    point_map = first_map()
    says = {}
    for tile in TILES:
        states = states_plane(fill=CellState.UNCHANGED_EMPTY)
        ragged = rng.random(states.shape) < 0.023
        states[ragged] = rng.integers(0, 5, int(ragged.sum()))
        cells = [(int(r), int(c)) for r, c in rng.integers(0, 256, (20, 2))]
        says[tile] = Say(states, new_points=wall(cells, [0.45, 0.75]))
    return make_ballot(point_map, says, "vehicle", "drive", end_ns=time.time_ns())


def first_map() -> PointMap:
    """Eight tiles with a hundred pillars each."""
    tile = make_tile(np.concatenate([wall(CELLS, [0.05]), wall(CELLS, [0.45, 0.75, 1.05])]))
    return make_map(dict.fromkeys(TILES, tile))


@dataclass
class Load:
    """What the senders saw."""

    waits_s: list[float] = field(default_factory=list)
    acknowledged: set[tuple[str, str]] = field(default_factory=set)
    refused: list[str] = field(default_factory=list)


class Vehicle(asyncio.Protocol):
    """One connection: one drive after another until ``stop_s``. Only the drive's name differs, so the bytes around it
    are prepared."""

    def __init__(self, ballot: Ballot, key: str, prefix: str, stop_s: float, load: Load) -> None:
        self.done = asyncio.get_running_loop().create_future()
        self._load, self._stop_s, self._turns = load, stop_s, itertools.count()
        self._name, self._prefix = ballot.vehicle, prefix
        marker = "D" * (len(prefix) + 8)
        body = encode(msgspec.structs.replace(ballot, drive=marker))
        before, after = body.split(marker.encode())
        line, rest = (
            f"PUT /v1/ballots/{ballot.vehicle}/",
            f" HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {key}\r\n",
        )
        self._head, self._tail = line.encode(), after
        self._middle = f"{rest}Content-Length: {len(body)}\r\n\r\n".encode() + before

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._send()

    def _send(self) -> None:
        self._drive, self._answer = f"{self._prefix}{next(self._turns):08d}", b""
        drive = self._drive.encode()
        self._start = time.perf_counter()
        self._transport.write(b"".join((self._head, drive, self._middle, drive, self._tail)))

    def data_received(self, data: bytes) -> None:
        self._answer += data
        header, end, content = self._answer.partition(b"\r\n\r\n")
        if not end or len(content) < int(header.lower().split(b"content-length:")[1].split(b"\r\n")[0]):
            return
        now = time.perf_counter()
        if header.startswith(b"HTTP/1.1 201"):
            self._load.waits_s.append(now - self._start)
            self._load.acknowledged.add((self._name, self._drive))
        else:
            self._load.refused.append(f"{header.splitlines()[0].decode()} {content.decode()}")
        if now < self._stop_s:
            self._send()
        else:
            self._transport.close()

    def connection_lost(self, error: Exception | None) -> None:
        self.done.set_result(error)


async def send_all(url: str, ballot: Ballot, keys: Sequence[str], seconds: float, prefix: str) -> Load:
    """All vehicles at once for so long."""
    host, port = url.removeprefix("http://").split(":")
    load, stop_s = Load(), time.perf_counter() + seconds
    vehicles = [
        Vehicle(msgspec.structs.replace(ballot, vehicle=f"v{i}"), key, prefix, stop_s, load)
        for i, key in enumerate(keys)
    ]
    loop = asyncio.get_running_loop()
    for vehicle in vehicles:
        await loop.create_connection(lambda vehicle=vehicle: vehicle, host, int(port))
    await asyncio.gather(*(vehicle.done for vehicle in vehicles))
    return load


def cpu_seconds(pid: int) -> float:
    """Processor time that a process has used so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(store_name: str, database_url: str, connections: int, seconds: float, folder: Path) -> dict[str, Any]:
    """Start a server on a new store, load it, look up what it acknowledged; SystemExit if anything is missing."""
    store = Store.create(database_url, first_map())
    secrets = [issue(store, f"v{i}", "vehicle") for i in range(connections)]
    store.close()
    config = folder / "server.toml"
    config.write_text("[server]\nballots_per_minute = 1e9\ndrives_a_day = 1000000000\n")
    ballot = typical_ballot()
    with serving(store_name, "--config", config, log=folder / "log") as (url, server):
        uvloop.run(send_all(url, ballot, secrets, 2.0, "warm"))
        start, cpu_s, own_s = time.perf_counter(), cpu_seconds(server.pid), time.process_time()
        load = uvloop.run(send_all(url, ballot, secrets, seconds, "d"))
        took, cpu_s = time.perf_counter() - start, cpu_seconds(server.pid) - cpu_s
        own_s = time.process_time() - own_s
    if load.refused:
        raise SystemExit(f"{len(load.refused)} ballots refused, for example: {load.refused[0]}")
    store = Store.open(database_url)
    with store.database.reading() as connection:
        b = schema.ballots.c
        there = {(row.vehicle, row.drive) for row in connection.execute(sa.select(b.vehicle, b.drive))}
    store.close()
    if not load.acknowledged <= there:
        raise SystemExit(f"{len(load.acknowledged - there)} acknowledged ballots are not in the store")
    p50, p99 = np.percentile(load.waits_s, [50, 99])
    return {
        "ballots_per_s": round(len(load.waits_s) / took),
        "p50_ms": round(1e3 * p50, 1),
        "p99_ms": round(1e3 * p99, 1),
        "max_ms": round(1e3 * max(load.waits_s), 1),
        "server_cpu_ms_per_ballot": round(1e3 * cpu_s / len(load.waits_s), 2),
        "sender_cpu_ms_per_ballot": round(1e3 * own_s / len(load.waits_s), 2),
        "ballots": len(load.waits_s),
        "ballot_bytes": len(encode(ballot)),
        "connections": connections,
        "cores": len(os.sched_getaffinity(0)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--connections", type=int, default=24)
    parser.add_argument("--database", choices=("sqlite", "postgresql"), default="sqlite")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if options.database == "sqlite":
            store = str(folder / "store.db")
            found = measure(store, f"sqlite:///{store}", options.connections, options.seconds, folder)
        else:
            cluster = PostgresCluster()
            try:
                url = cluster.create("load")
                found = measure(url, url, options.connections, options.seconds, folder)
            finally:
                cluster.close()
    print(json.dumps({"database": options.database} | found))


if __name__ == "__main__":
    main()
