"""Honest clients among hostile ones: each attack in turn, then all at once, against the same server when idle.

    python benchmarks/hostile.py                       # every attack
    python benchmarks/hostile.py pipelined reads       # some

Attackers run in a process of their own. Meanwhile a vehicle sends a ballot every 100 ms. Two probes ask for /livez and
/healthz. An operator issues a key, changes the policy, takes a ballot back and revokes the key; the new key asks for
the map at once. Prints each wait's p50, p99 and worst in ms, and p50 and p99 as multiples of the idle server's. Ends
with 1 if an honest request is refused, or waits longer than LIMITS_MS.
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
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hand_made import Say, base_hash, make_ballot, states_plane
from mapvote.codec.ballot import Ballot, tile_key
from mapvote.core.grid import CELL_SIZE
from mapvote.core.types import CellState
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from server import Address, Answer, Row, Site, as_drive, ask, percentiles, pillars, site, typical_ballot
from stores import send

TILES = [(row, col) for row in range(6) for col in range(10)]
CELLS = [(r, c) for r in range(4, 252, 24) for c in range(4, 252, 24)]
LIMITS_MS = {"livez": (None, 100.0), "healthz": (None, 100.0), "ballot": (100.0, 300.0), "command": (None, 1000.0)}
"""Longest p50 and p99."""
HERE: set[int] = set()
"""Half-open connections that have been made once."""


@dataclass
class Target:
    """Knowledge of the attackers: the address, a key for each name, and bodies that were made before."""

    address: Address
    keys: dict[str, str]
    dear: dict[str, bytes]


def history(store: Store) -> None:
    """Ten vehicles that saw half of the pillars gone, in a second version: something to look at at length."""
    point_map, rng = store.point_map(), np.random.default_rng(1)
    gone = {tile: [cell for cell in CELLS if rng.random() < 0.5] for tile in TILES}
    says = {
        tile: Say(states_plane(dict.fromkeys(cells, CellState.CHANGED_EMPTY), fill=CellState.UNCHANGED_EMPTY))
        for tile, cells in gone.items()
    }
    for i in range(10):
        send(store, make_ballot(point_map, says, f"v{i}", "d", time.time_ns()))
    publish(store, override=True)


def dear_ballot(store: Store) -> Ballot:
    """All cells of every tile changed, with eleven new points each: the dearest to unpack for its size."""
    side = (np.arange(256, dtype=np.float32) + 0.5) * np.float32(CELL_SIZE)
    height = np.arange(11, dtype=np.float32) * np.float32(0.3) + np.float32(0.45)
    x, y, z = np.meshgrid(side, side, height, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    say = Say(states_plane(fill=CellState.CHANGED_OCCUPIED), new_points=points)
    point_map = store.point_map()
    one = make_ballot(point_map, {TILES[0]: say}, "bad2", "dear", time.time_ns())
    tiles = [msgspec.structs.replace(one.tiles[0], tile=tile) for tile in TILES]
    base = {tile_key(tile): base_hash(point_map.tiles[tile]) for tile in TILES}
    return msgspec.structs.replace(one, tiles=tiles, base=base)


async def hold(address: Address, sent: bytes, read: bool = True) -> None:
    """One connection that says this, and reads for ever."""
    reader, writer = await asyncio.open_connection(*address)
    try:
        writer.write(sent)
        while read and await reader.read(1 << 16):
            pass
    finally:
        writer.close()


def head(line: str, key: str = "", more: str = "") -> bytes:
    authorization = f"Authorization: Bearer {key}\r\n" if key else ""
    return f"{line} HTTP/1.1\r\nHost: localhost\r\n{authorization}{more}\r\n".encode()


async def greedy_read(at: Target, turn: int) -> None:
    await ask(at.address, "GET", "/v1/changes?from=1&to=2", at.keys["bad0"])


async def mixed_read(at: Target, turn: int) -> None:
    x, y = 76.8 * (turn % 6) + 3.1, 3.1
    paths = ["/v1/changes?from=1&to=2", f"/v1/cells?x={x}&y={y}", "/v1/coverage", "/v1/vehicles", "/v1/map/versions"]
    await ask(at.address, "GET", paths[turn % len(paths)], at.keys["reviewer"])


async def pipelined(at: Target, turn: int) -> None:
    """Fifty requests in one go, never read; again after two seconds."""
    _, writer = await asyncio.open_connection(*at.address)
    try:
        writer.write(head("GET /v1/map") * 50)
        await asyncio.sleep(2.0)
    finally:
        writer.transport.abort()


async def manifest(at: Target, turn: int) -> None:
    """A cheap answer, again and again."""
    await ask(at.address, "GET", "/v1/map", at.keys["bad7"])


async def stream(at: Target, turn: int) -> None:
    await hold(at.address, head("GET /v1/events", at.keys["bad1"]))


async def dear_upload(at: Target, turn: int) -> None:
    vehicle = f"bad{turn + 2}"
    await ask(at.address, "PUT", f"/v1/ballots/{vehicle}/dear", at.keys[vehicle], at.dear[vehicle])


async def other_drive(at: Target, turn: int) -> None:
    """The dear ballot of another vehicle, refused by its envelope."""
    await ask(at.address, "PUT", f"/v1/ballots/bad{turn}/far", at.keys[f"bad{turn}"], at.dear["bad2"])


async def stalled_upload(at: Target, turn: int) -> None:
    vehicle = f"bad{turn % 8}"
    _, writer = await asyncio.open_connection(*at.address)
    sent = head(f"PUT /v1/ballots/{vehicle}/s{turn}", at.keys[vehicle], "Content-Length: 10000000\r\n")
    writer.write(sent + bytes(100_000))
    try:
        while True:
            writer.write(b"x")
            await writer.drain()
            await asyncio.sleep(1.0)
    finally:
        writer.close()


async def half_open(at: Target, turn: int) -> None:
    await asyncio.sleep(1.0 if turn in HERE else 4.0 * turn / ATTACKS["half-open"][0])
    HERE.add(turn)
    await hold(at.address, b"GET /v1/map HTTP/1.1\r\nHost: localhost\r\nX-Never: ")


async def wrong_key(at: Target, turn: int) -> None:
    await ask(at.address, "GET", "/v1/map", f"wrong-{turn}-{time.monotonic_ns()}")


async def many_headers(at: Target, turn: int) -> None:
    await hold(at.address, head("GET /v1/map", more="".join(f"{i:x}:\r\n" for i in range(5000))))


async def large_head(at: Target, turn: int) -> None:
    reader, writer = await asyncio.open_connection(*at.address)
    try:
        writer.write(b"GET /v1/map HTTP/1.1\r\nHost: localhost\r\nX-Long: ")
        for _ in range(40):
            writer.write(b"a" * 1_000_000)
            await writer.drain()
        await reader.read(100)
    finally:
        writer.close()


ATTACKS: dict[str, tuple[int, Callable[[Target, int], Awaitable[None]]]] = {
    "reads": (40, greedy_read),
    "mixed reads": (48, mixed_read),
    "manifests": (200, manifest),
    "pipelined": (200, pipelined),
    "streams": (40, stream),
    "dear ballots": (4, dear_upload),
    "foreign ballots": (4, other_drive),
    "uploads": (30, stalled_upload),
    "half-open": (1100, half_open),
    "wrong keys": (24, wrong_key),
    "headers": (8, many_headers),
    "heads": (8, large_head),
}
"""Number of clients, and what each does again and again."""


def attack(at: Target, kinds: set[str]) -> None:
    """The process of those who attack, until it is killed."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard if hard != resource.RLIM_INFINITY else 1 << 16, hard))

    async def again(kind: str, turn: int) -> None:
        while True:
            with suppress(OSError, IndexError, ValueError):
                await ATTACKS[kind][1](at, turn)
            await asyncio.sleep(0.001)

    async def everybody() -> None:
        await asyncio.gather(*(again(kind, turn) for kind in kinds for turn in range(ATTACKS[kind][0])))

    asyncio.run(everybody())


class Honest:
    """Clients that each do one thing after another, and note how long they wait and what is refused."""

    def __init__(self, at: Site, ballot: Ballot, seconds: float, prefix: str) -> None:
        self._at = at
        self._ballot = ballot
        self._prefix = prefix
        self._end_s = time.perf_counter() + seconds
        self.waits: dict[str, list[float]] = {}
        self.refused: list[str] = []

    async def run(self) -> None:
        """All of them, until the time is over."""
        await asyncio.gather(*(self._every(act) for act in (self._livez, self._healthz, self._vote, self._command)))

    async def _every(self, act: Callable[[int], Awaitable[None]]) -> None:
        turn = 0
        while time.perf_counter() < self._end_s:
            turn, begun = turn + 1, time.perf_counter()
            await act(turn)
            await asyncio.sleep(max(0.0, 0.1 - (time.perf_counter() - begun)))

    async def _timed(self, name: str, request: Awaitable[Answer]) -> bytes:
        begun = time.perf_counter()
        try:
            status, content = await asyncio.wait_for(request, 60.0)
        except (OSError, IndexError, TimeoutError) as error:
            status, content = 0, repr(error).encode()
        self.waits.setdefault(name, []).append(time.perf_counter() - begun)
        if status not in (200, 201):
            self.refused.append(f"{name}: {status} {content[:200]!r}")
        return content

    async def _livez(self, turn: int) -> None:
        await self._timed("livez", ask(self._at.address, "GET", "/livez", ""))

    async def _healthz(self, turn: int) -> None:
        await self._timed("healthz", ask(self._at.address, "GET", "/healthz", self._at.keys["reader"]))

    async def _vote(self, turn: int) -> None:
        path, body = as_drive(self._ballot, "honest", f"{self._prefix}{turn}")
        await self._timed("ballot", ask(self._at.address, "PUT", path, self._at.keys["honest"], body))

    async def _command(self, turn: int) -> None:
        """Issue, policy, un-vote, revoke; and a right key that the server has not seen before."""
        name = f"{self._prefix}{turn}"
        key = json.loads(await self._command_of("POST", "/v1/keys", {"name": name}) or b"{}").get("key", "")
        await self._timed("new key", ask(self._at.address, "GET", "/v1/map", key))
        await self._command_of("PATCH", "/v1/policy", {"values": {"fuse.min_votes": 2 + turn % 2}})
        drive = f"u{name}"
        path, body = as_drive(self._ballot, "honest", drive)
        await self._timed("ballot", ask(self._at.address, "PUT", path, self._at.keys["honest"], body))
        await self._command_of("DELETE", path, {})
        await self._command_of("POST", "/v1/keys/revoke", {"name": name})

    async def _command_of(self, method: str, path: str, body: dict[str, object]) -> bytes:
        sent = json.dumps(body).encode() if body else b""
        return await self._timed("command", ask(self._at.address, method, path, self._at.keys["operator"], sent))


def measured(at: Site, ballot: Ballot, seconds: float, prefix: str) -> tuple[Row, list[str]]:
    """The waits of honest clients for so many seconds, and what was refused."""
    clients = Honest(at, ballot, seconds, prefix)
    asyncio.run(clients.run())
    row: Row = {}
    for name, waits_s in clients.waits.items():
        row |= percentiles(name, waits_s)
    return row, clients.refused


def under_attack(at: Site, target: Target, ballot: Ballot, kinds: set[str], seconds: float) -> tuple[Row, list[str]]:
    """The result of :func:`measured`, after an attack has unfolded and while it goes on."""
    process = multiprocessing.get_context("spawn").Process(target=attack, args=(target, kinds))
    process.start()
    try:
        time.sleep(5.0)
        row, refused = measured(at, ballot, seconds, "".join(sorted(kind[:2] for kind in kinds)).replace(" ", ""))
        if not process.is_alive():
            raise SystemExit("the attackers gave up: nothing was measured")
    finally:
        process.kill()
        process.join()
    return row, refused


def too_late(row: Row) -> list[str]:
    """The waits beyond LIMITS_MS."""
    return [
        f"{name} {quantile} {row[f'{name}_{quantile}_ms']} ms > {limit:g}"
        for name, limits in LIMITS_MS.items()
        for quantile, limit in zip(("p50", "p99"), limits, strict=True)
        if limit is not None and row[f"{name}_{quantile}_ms"] > limit
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("attacks", nargs="*", help="some of them; default: each, and all at once")
    parser.add_argument("--database", choices=("sqlite", "postgresql"), default="sqlite")
    parser.add_argument("--seconds", type=float, default=8.0)
    options = parser.parse_args()
    unknown = set(options.attacks) - {*ATTACKS, "all"}
    if unknown:
        parser.error(f"no such attack: {', '.join(sorted(unknown))}; there are {', '.join(ATTACKS)}, all")
    faults: list[str] = []
    with site(options.database, pillars(TILES, CELLS), history, ["honest", *(f"bad{i}" for i in range(8))]) as at:
        store = Store.open(at.url)
        ballot = typical_ballot(store.point_map())
        dear = dear_ballot(store)
        target = Target(at.address, at.keys, {f"bad{i}": as_drive(dear, f"bad{i}", "dear")[1] for i in range(2, 6)})
        store.close()
        gc.freeze()  # a collection here would look like a wait there
        measured(at, ballot, 3.0, "warm")
        idle, _ = measured(at, ballot, options.seconds, "idle")
        print(json.dumps({"attack": "none", "load": round(os.getloadavg()[0], 1)} | idle), flush=True)
        for name in options.attacks or [*ATTACKS, "all"]:
            kinds = set(ATTACKS) if name == "all" else {name}
            row, refused = under_attack(at, target, ballot, kinds, options.seconds)
            ratios = {
                f"{key[:-3]}_x": round(row[key] / idle[key], 1) for key in row if key.endswith(("p50_ms", "p99_ms"))
            }
            late = too_late(row)
            faults += [f"{name}: {fault}" for fault in (*late, *refused[:3])]
            about = {
                "attack": name,
                "load": round(os.getloadavg()[0], 1),
                "refused": len(refused),
                "first": refused[:2],
            }
            print(json.dumps(about | row | ratios), flush=True)
    if faults:
        raise SystemExit("\n".join(faults))


if __name__ == "__main__":
    main()
