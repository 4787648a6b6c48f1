"""An honest vehicle at a server that others try to keep busy: how long its ballots wait, and a look at its health.

    python benchmarks/hostile.py --seconds 30
    python benchmarks/hostile.py --database postgresql

A real server process on loopback, with keys. Against it, in a process of their own, everything at once or each alone:
48 clients that ask for the most expensive reads again and again, 30 uploads that announce 10 MB and send a byte a
second, 1,100 connections that never finish their headers and come back a second after they are cut, 8 clients with
wrong keys, 8 clients whose headers have 40 MB each.
Meanwhile one vehicle sends a ballot of about 20 kB every 100 ms, and somebody asks for /healthz as often, each on a
connection of its own. Ends with 1 if, with everything at once, one ballot in a hundred waits longer than 1 s or one
look at the health longer than 100 ms, or if any is refused.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import multiprocessing
import os
import resource
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Coroutine
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from live_server import serving
from mapvote.codec.ballot import Ballot, encode
from mapvote.config import FuseSettings
from mapvote.core.point_map import PointMap
from mapvote.core.types import CellState
from mapvote.server.store.admission import Receipt, accept, examine
from mapvote.server.store.keys import issue
from mapvote.server.store.publish import publish
from mapvote.server.store.store import Store
from postgres_cluster import PostgresCluster

TILES = [(row, col) for row in range(6) for col in range(6)]
CELLS = [(r, c) for r in range(4, 252, 8) for c in range(4, 252, 8)]
READS, UPLOADS, HALF_OPEN, WRONG, HEADS = 48, 30, 1100, 8, 8
MOST_BALLOT_S, MOST_HEALTH_S = 1.0, 0.1
Address = tuple[str, int]


def first_map() -> PointMap:
    """36 tiles with 961 pillars each."""
    points = np.concatenate([wall(CELLS, [0.05]), wall(CELLS, [0.45, 0.75, 1.05])])
    return make_map({index: make_tile(points, index=index) for index in TILES})


def history(store: Store) -> None:
    """Ten vehicles that saw half of the pillars gone, in a second version: something to look at at length."""
    point_map, rng = first_map(), np.random.default_rng(1)
    away = {tile: [cell for cell in CELLS if rng.random() < 0.5] for tile in TILES}
    for i in range(10):
        says = {}
        for tile in TILES:
            states = states_plane(fill=CellState.UNCHANGED_EMPTY)
            for cell in away[tile]:
                states[cell] = CellState.CHANGED_EMPTY
            says[tile] = Say(states)
        (receipt,) = accept(store, [examine(encode(make_ballot(point_map, says, f"v{i}", "d", time.time_ns())))])
        if not isinstance(receipt, Receipt):
            raise receipt
    publish(store, FuseSettings(max_deleted_share=1.0), override=True)


def typical_ballot(store: Store) -> Ballot:
    """About 20 kB, on eight tiles of the newest map."""
    rng, says = np.random.default_rng(2), {}
    for tile in TILES[:8]:
        states = states_plane(fill=CellState.UNCHANGED_EMPTY)
        ragged = rng.random(states.shape) < 0.023
        states[ragged] = rng.integers(0, 5, int(ragged.sum()))
        says[tile] = Say(states)
    return make_ballot(store.point_map(), says, "honest", "drive", time.time_ns())


async def ask(address: Address, method: str, path: str, key: str, body: bytes = b"") -> tuple[int, bytes]:
    """One request on a connection of its own."""
    reader, writer = await asyncio.open_connection(*address)
    try:
        head = f"{method} {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {key}\r\n"
        writer.write(f"{head}Content-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode() + body)
        answer = await reader.read()
    finally:
        writer.close()
    header, _, content = answer.partition(b"\r\n\r\n")
    return int(header.split()[1]), content


# The hostile side -----------------------------------------------------------------------------------------------------


async def again(work: Callable[[], Coroutine[Any, Any, object]]) -> None:
    """For ever, whatever comes."""
    while True:
        with suppress(OSError, IndexError, ValueError):
            await work()
        await asyncio.sleep(0.001)


async def expensive_read(address: Address, key: str, turn: int) -> None:
    x, y = 76.8 * (turn % 6) + 3.1, 3.1
    paths = ["/v1/changes?from=1&to=2", f"/v1/cells?x={x}&y={y}", "/v1/coverage", "/v1/vehicles", "/v1/map/versions"]
    status, _ = await ask(address, "GET", paths[turn % len(paths)], key)
    ANSWERS[f"read {status}"] += 1


async def stalled_upload(address: Address, vehicle: str, key: str, turn: int) -> None:
    _, writer = await asyncio.open_connection(*address)
    head = f"PUT /v1/ballots/{vehicle}/s{turn} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {key}\r\n"
    writer.write(f"{head}Content-Length: 10000000\r\n\r\n".encode() + bytes(100_000))
    try:
        while True:
            writer.write(b"x")
            await writer.drain()
            await asyncio.sleep(1.0)
    finally:
        ANSWERS["upload cut"] += 1
        writer.close()


async def half_open(address: Address, turn: int) -> None:
    await asyncio.sleep(1.0 if turn in HERE else 4.0 * turn / HALF_OPEN)
    HERE.add(turn)
    reader, writer = await asyncio.open_connection(*address)
    writer.write(b"GET /v1/map HTTP/1.1\r\nHost: localhost\r\nX-Never: ")
    try:
        await reader.read()
    finally:
        ANSWERS["half-open cut"] += 1
        writer.close()


async def wrong_key(address: Address, turn: int) -> None:
    status, _ = await ask(address, "GET", "/v1/map", f"wrong-{turn}-{time.monotonic_ns()}")
    ANSWERS[f"wrong key {status}"] += 1


async def large_head(address: Address) -> None:
    reader, writer = await asyncio.open_connection(*address)
    try:
        writer.write(b"GET /v1/map HTTP/1.1\r\nHost: localhost\r\nX-Long: ")
        for _ in range(40):
            writer.write(bytes(1_000_000).replace(b"\0", b"a"))
            await writer.drain()
        writer.write(b"\r\n\r\n")
        ANSWERS[f"40 MB head {(await reader.read(100)).split()[1].decode()}"] += 1
    finally:
        writer.close()


ANSWERS: Counter[str] = Counter()
HERE: set[int] = set()
"""Half-open connections that have been made once."""


async def attack(address: Address, keys: dict[str, str], kinds: set[str]) -> None:
    """All of the kinds at once, until killed."""
    tasks: list[asyncio.Task[None]] = []

    def start(n: int, work: Callable[[int], Coroutine[Any, Any, object]]) -> None:
        tasks.extend(asyncio.create_task(again(lambda i=i: work(i))) for i in range(n))  # type: ignore[misc]

    if "reads" in kinds:
        start(READS, lambda i: expensive_read(address, keys["reviewer"], i + sum(ANSWERS.values())))
    if "uploads" in kinds:
        start(UPLOADS, lambda i: stalled_upload(address, f"bad{i % 8}", keys[f"bad{i % 8}"], i))
    if "half-open" in kinds:
        start(HALF_OPEN, lambda i: half_open(address, i))
    if "wrong keys" in kinds:
        start(WRONG, lambda i: wrong_key(address, i))
    if "heads" in kinds:
        start(HEADS, lambda i: large_head(address))
    await asyncio.gather(*tasks)


def hostile(address: Address, keys: dict[str, str], kinds: set[str]) -> None:
    """The process of those who attack."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard if hard != resource.RLIM_INFINITY else 1 << 16, hard))
    asyncio.run(attack(address, keys, kinds))


# The honest side ------------------------------------------------------------------------------------------------------


@dataclass
class Waits:
    """What the honest ones saw, in seconds."""

    ballots: list[float] = field(default_factory=list)
    health: list[float] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)


async def measure(address: Address, keys: dict[str, str], ballot: Ballot, seconds: float, prefix: str) -> Waits:
    """A ballot and a look at the health every 100 ms."""
    waits, end = Waits(), time.perf_counter() + seconds

    async def every(took: list[float], send: Callable[[int], Coroutine[Any, Any, tuple[int, bytes]]]) -> None:
        turn = 0
        while time.perf_counter() < end:
            turn += 1
            start = time.perf_counter()
            try:
                status, content = await asyncio.wait_for(send(turn), 30.0)
            except (OSError, IndexError, TimeoutError) as error:
                status, content = 0, repr(error).encode()
            took.append(time.perf_counter() - start)
            if status not in (200, 201):
                waits.refused.append(f"{status} {content[:200]!r}")
            await asyncio.sleep(max(0.0, 0.1 - took[-1]))

    def vote(turn: int) -> Coroutine[Any, Any, tuple[int, bytes]]:
        body = encode(msgspec.structs.replace(ballot, drive=f"{prefix}{turn}"))
        return ask(address, "PUT", f"/v1/ballots/honest/{prefix}{turn}", keys["honest"], body)

    await asyncio.gather(
        every(waits.ballots, vote),
        every(waits.health, lambda turn: ask(address, "GET", "/healthz", keys["honest"])),
    )
    return waits


def row(kinds: set[str], waits: Waits) -> dict[str, Any]:
    """One line of the table."""
    found: dict[str, Any] = {"hostile": ", ".join(sorted(kinds)) or "nobody"}
    for name, took in (("ballot", waits.ballots), ("healthz", waits.health)):
        p50, p99 = np.percentile(took, [50, 99])
        found |= {f"{name}_p50_ms": round(1e3 * p50), f"{name}_p99_ms": round(1e3 * p99)}
        found |= {f"{name}_max_ms": round(1e3 * max(took)), f"{name}s": len(took)}
    return found | {"refused": len(waits.refused)}


def by_the_server(log: Path, start: int) -> dict[str, float]:
    """What the server's own log says of the honest ones since it was ``start`` bytes long: from the headers to the last
    byte of the answer. Without the waits of this process, which shares two cores with the attackers."""
    took: dict[str, list[float]] = {"ballot": [], "healthz": []}
    for line in log.read_bytes()[start:].splitlines():
        told = json.loads(line) if line.startswith(b"{") else {}
        if told.get("key") == "honest":
            took["healthz" if told["path"] == "/healthz" else "ballot"].append(told["ms"])
    p99 = {f"server_{name}_p99_ms": round(float(np.percentile(ms, 99))) for name, ms in took.items()}
    return p99 | {f"server_{name}_max_ms": round(max(ms)) for name, ms in took.items()}


def under_attack(
    address: Address, keys: dict[str, str], ballot: Ballot, kinds: set[str], seconds: float
) -> dict[str, Any]:
    """Start the attack, give it five seconds to unfold, measure."""
    attacker = multiprocessing.get_context("spawn").Process(target=hostile, args=(address, keys, kinds))
    attacker.start()
    try:
        time.sleep(5.0)
        waits = asyncio.run(measure(address, keys, ballot, seconds, "".join(sorted(k[0] for k in kinds)) or "n"))
        if kinds and not attacker.is_alive():
            raise SystemExit("the attackers gave up: nothing was measured")
    finally:
        attacker.kill()
        attacker.join()
    for example in waits.refused[:3]:
        print(f"refused: {example}", file=sys.stderr)
    return row(kinds, waits)


def run(store_name: str, url: str, seconds: float, folder: Path, kinds: list[set[str]]) -> list[dict[str, Any]]:
    """Every row, on one server."""
    store = Store.create(url, first_map())
    history(store)
    keys = {name: issue(store, name, "vehicle") for name in ("honest", *(f"bad{i}" for i in range(8)))}
    keys["reviewer"] = issue(store, "reviewer", "reviewer")
    ballot = typical_ballot(store)
    store.close()
    config = folder / "server.toml"
    config.write_text("[server]\nballots_per_minute = 100000\ndrives_a_day = 1000000\n")
    with serving(store_name, "--config", config, log=folder / "log") as (address, server):
        host, port = address.removeprefix("http://").split(":")
        gc.freeze()  # a collection here would look like a wait there
        asyncio.run(measure((host, int(port)), keys, ballot, 3.0, "warm"))
        rows = []
        for some in kinds:
            start = (folder / "log").stat().st_size
            rows.append(under_attack((host, int(port)), keys, ballot, some, seconds))
            rows[-1] |= by_the_server(folder / "log", start) | {"load": round(os.getloadavg()[0], 1)}
            memory = Path(f"/proc/{server.pid}/status").read_text().split("VmHWM:")[1].split()[0]
            rows[-1]["server_peak_MB"] = int(memory) // 1000
            print(json.dumps(rows[-1]), flush=True)
    if "Traceback" in (folder / "log").read_text():
        raise SystemExit(f"the server stumbled: {(folder / 'log').read_text()[-3000:]}")
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="of each row")
    parser.add_argument("--database", choices=("sqlite", "postgresql"), default="sqlite")
    parser.add_argument("--only-all", action="store_true", help="only everything at once")
    options = parser.parse_args()
    every = {"reads", "uploads", "half-open", "wrong keys", "heads"}
    kinds = [every] if options.only_all else [set(), *({kind} for kind in sorted(every)), every]
    print(json.dumps({"database": options.database, "cores": len(os.sched_getaffinity(0))}), flush=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if options.database == "sqlite":
            store = str(folder / "store.db")
            rows = run(store, f"sqlite:///{store}", options.seconds, folder, kinds)
        else:
            cluster = PostgresCluster()
            try:
                url = cluster.create("hostile")
                rows = run(url, url, options.seconds, folder, kinds)
            finally:
                cluster.close()
    worst = rows[-1]
    if (
        worst["refused"]
        or worst["ballot_p99_ms"] > 1e3 * MOST_BALLOT_S
        or worst["healthz_p99_ms"] > 1e3 * MOST_HEALTH_S
    ):
        raise SystemExit("an honest vehicle was kept waiting, or refused")


if __name__ == "__main__":
    main()
