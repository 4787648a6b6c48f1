"""Publish a thousand changed tiles in one transaction while a hundred clients read; let 64 operators publish at once.

    python benchmarks/server_readers.py --tiles 1000 --readers 100
    python benchmarks/server_readers.py --database postgresql

A real server process. Waits are those of answers that were on their way while it published, or up to 2 s after: the
new manifest is made then. Every manifest that a reader gets must be wholly of one version; of the publishers exactly
one may win. Ends with 1 otherwise.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from live_server import serving
from mapvote.codec.ballot import encode
from mapvote.core.point_map import PointMap
from mapvote.core.types import CellState
from mapvote.server.store.admission import Receipt, accept, examine
from mapvote.server.store.store import Store
from postgres_cluster import PostgresCluster

PILLARS = [(10, 10), (10, 20)]


async def ask(address: tuple[str, int], method: str, path: str, body: bytes = b"") -> tuple[int, bytes]:
    """One request on a connection of its own."""
    reader, writer = await asyncio.open_connection(*address)
    kind = "Content-Type: application/json\r\n"
    head = (
        f"{method} {path} HTTP/1.1\r\nHost: localhost\r\n{kind}Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    writer.write(head.encode() + body)
    answer = await reader.read()
    writer.close()
    header, _, content = answer.partition(b"\r\n\r\n")
    return int(header.split()[1]), content


def big_map(tiles: int) -> PointMap:
    """So many tiles with two pillars each, none like another."""
    side = int(np.ceil(np.sqrt(tiles)))
    indices = [(i // side, i % side) for i in range(tiles)]
    return make_map(
        {t: make_tile(wall(PILLARS, [0.45, 0.75, 1.05]) + np.float32(1e-3 * (i % 90))) for i, t in enumerate(indices)}
    )


def vote_away(store: Store, point_map: PointMap, pillar: tuple[int, int], drive: str) -> None:
    """Two vehicles that saw one pillar gone in every tile."""
    states = states_plane({pillar: CellState.CHANGED_EMPTY})
    for vehicle in ("a", "b"):
        ballot = make_ballot(point_map, dict.fromkeys(point_map.tiles, Say(states)), vehicle, drive, time.time_ns())
        (receipt,) = accept(store, [examine(encode(ballot))])
        if not isinstance(receipt, Receipt):
            raise receipt


@dataclass
class Observation:
    """What the readers got."""

    versions: Counter[int] = field(default_factory=Counter)
    waits_s: list[tuple[float, float]] = field(default_factory=list)
    """(when asked, how long the answer took)."""
    hashes: dict[int, frozenset[str]] = field(default_factory=dict)


async def read_until(address: tuple[str, int], done: asyncio.Event, seen: Observation, pause_s: float) -> None:
    """Fetch the manifest again and again, the first time after a pause too: vehicles do not all wake at once.
    SystemExit if one version ever shows two faces."""
    await asyncio.sleep(random.uniform(0.0, 2.0 * pause_s))
    while not done.is_set():
        start = time.perf_counter()
        status, content = await ask(address, "GET", "/v1/map")
        seen.waits_s.append((start, time.perf_counter() - start))
        if status != 200:
            raise SystemExit(f"a reader got {status}: {content[:200]!r}")
        manifest = json.loads(content)
        hashes = frozenset(f"{key} {planes['points']}" for key, planes in manifest["tiles"].items())
        if seen.hashes.setdefault(manifest["version"], hashes) != hashes:
            raise SystemExit(f"version {manifest['version']} is a mixture: two readers saw different tiles")
        seen.versions[manifest["version"]] += 1
        await asyncio.sleep(random.uniform(0.0, 2.0 * pause_s))


async def publish_while_read(
    address: tuple[str, int], readers: int, pause_s: float
) -> tuple[Observation, float, list[float]]:
    """(what was read, how long the publish took, how long each answer took that was on its way meanwhile)."""
    seen, done = Observation(), asyncio.Event()
    reading = [asyncio.create_task(read_until(address, done, seen, pause_s)) for _ in range(readers)]
    await asyncio.sleep(2.0 * pause_s + 1.0)
    start = time.perf_counter()
    status, content = await ask(address, "POST", "/v1/publish", b'{"override": true}')
    end = time.perf_counter()
    if status != 200 or not json.loads(content)["published"]:
        raise SystemExit(f"publish: {status} {content[:300]!r}")
    await asyncio.sleep(2.0 * pause_s + 1.0)
    done.set()
    await asyncio.gather(*reading)
    return seen, end - start, [wait for asked, wait in seen.waits_s if asked + wait > start and asked < end + 2.0]


async def publish_at_once(address: tuple[str, int], publishers: int) -> Counter[int]:
    """The answers to so many publishers who all saw version 1."""
    body = b'{"override": true, "parent": 1}'
    asked = [ask(address, "POST", "/v1/publish", body) for _ in range(publishers)]
    return Counter([status for status, _ in await asyncio.gather(*asked)])


def with_readers(store_name: str, url: str, tiles: int, readers: int, pause_s: float, folder: Path) -> dict[str, Any]:
    """One publish of ``tiles`` tiles while ``readers`` read."""
    point_map = big_map(tiles)
    store = Store.create(url, point_map)
    vote_away(store, point_map, PILLARS[0], "first")
    store.close()
    with serving(store_name, log=folder / "log") as (address, _):
        host, port = address.removeprefix("http://").split(":")
        seen, took, waits = asyncio.run(publish_while_read((host, int(port)), readers, pause_s))
    if set(seen.versions) != {1, 2} or seen.hashes[1] & seen.hashes[2]:
        raise SystemExit(f"readers saw versions {dict(seen.versions)}; every tile should differ between 1 and 2")
    p50, p99, most = np.percentile(waits, [50, 99, 100])
    return {
        "tiles": tiles,
        "readers": readers,
        "pause_s": pause_s,
        "publish_s": round(took, 2),
        "manifests_read": len(seen.waits_s),
        "mixtures": 0,
        "read_p50_ms": round(1e3 * p50),
        "read_p99_ms": round(1e3 * p99),
        "read_worst_ms": round(1e3 * most),
    }


def with_rivals(store_name: str, url: str, folder: Path) -> dict[str, int]:
    """64 publishers at once on a small map: one wins, 63 hear that they did not."""
    point_map = big_map(4)
    store = Store.create(url, point_map)
    vote_away(store, point_map, PILLARS[0], "first")
    with serving(store_name, log=folder / "log") as (address, _):
        host, port = address.removeprefix("http://").split(":")
        answers = asyncio.run(publish_at_once((host, int(port)), 64))
    newest = store.current()
    store.close()
    if answers != {200: 1, 409: 63} or newest != 2:
        raise SystemExit(f"64 publishers got {dict(answers)}, newest version {newest}")
    return {str(status): n for status, n in sorted(answers.items())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tiles", type=int, default=1000)
    parser.add_argument("--readers", type=int, default=100)
    parser.add_argument("--pause", type=float, default=2.0, help="seconds between a reader's requests, on average")
    parser.add_argument("--database", choices=("sqlite", "postgresql"), default="sqlite")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if options.database == "sqlite":
            big, small = str(folder / "big.db"), str(folder / "small.db")
            found = with_readers(big, f"sqlite:///{big}", options.tiles, options.readers, options.pause, folder)
            rivals = with_rivals(small, f"sqlite:///{small}", folder)
        else:
            cluster = PostgresCluster()
            try:
                big, small = cluster.create("big"), cluster.create("small")
                found = with_readers(big, big, options.tiles, options.readers, options.pause, folder)
                rivals = with_rivals(small, small, folder)
            finally:
                cluster.close()
    print(json.dumps({"database": options.database} | found | {"64_publishers": rivals}))


if __name__ == "__main__":
    main()
