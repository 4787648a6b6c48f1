"""What a store of 10,000 tiles, 100,000 ballots on tiles and 200 versions costs, beside one of 100 tiles.

python benchmarks/large_store.py [--tiles 100 10000] [--database sqlite]

The store is filled by SQL, for that is what is large: tiles of a few points, votes of a few cells. Then, with the
server's own code: a ballot on one tile is taken in, a version that changes one tile is published, and somebody asks for
what changed since the version before, for the changes, for the coverage. The median of five, milliseconds: on SQLite of
CPU, on PostgreSQL of time.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from mapvote.codec.ballot import encode, pack_plane
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote.server.store import schema
from mapvote.server.store.admission import Intake, examine
from mapvote.server.store.database import insert_rows
from mapvote.server.store.planes import pack_tile
from mapvote.server.store.policy import Policy
from mapvote.server.store.publish import publish
from mapvote.server.store.schema import sum_of_planes
from mapvote.server.store.store import Store
from mapvote.server.views.history import changes_between, coverage
from postgres_cluster import PostgresCluster

WALL = [(10, 10 + c) for c in range(8)]
VERSIONS, ROWS_A_TILE, TILES_A_BALLOT = 200, 10, 20
DAY_NS = 86_400 * 10**9


def fill(store: Store, tiles: int) -> None:
    """Versions that each set some tiles again as they were, and old ballots on all of them."""
    side = max(1, int(tiles**0.5))
    places = [(i // side, i % side) for i in range(tiles)]
    hashes = pack_tile(make_tile(wall(WALL, [0.05, 0.45])))[0]
    planes = hashes.points, hashes.ground, None, None, None
    states = pack_plane(states_plane({(30, 30): CellState.UNCHANGED_EMPTY}), 1)
    nothing = None, None, None, None, None
    total = sum_of_planes(hashes.points, [states, *nothing])
    policy, now = store.policy().model_dump_json(), store.clock()
    ballots = ROWS_A_TILE * tiles // TILES_A_BALLOT
    with store.database.writing() as connection:
        insert_rows(connection, schema.events, [(10 + s, now, "ballot", "old", "") for s in range(ballots + VERSIONS)])
        rows = [(1, *place, *planes) for place in places if place != (0, 0)]
        insert_rows(connection, schema.version_tiles, rows)
        kinds = "publish", None, now, "x", "", 10 + ballots, policy, None
        insert_rows(connection, schema.versions, [(n, n - 1, *kinds) for n in range(2, VERSIONS + 1)])
        again = [(n, *places[(7 * n + k) % tiles], *planes) for n in range(2, VERSIONS + 1) for k in range(5)]
        insert_rows(connection, schema.version_tiles, sorted(set(again)))
        told = [(10 + s, 10 + s, None, f"v{s % 90}", f"d{s}", f"{s:064x}") for s in range(ballots)]
        stamps = now - 20 * DAY_NS, now - 20 * DAY_NS, now, "5e771465" * 8, "columns, two-stage", 2_000, 1
        insert_rows(connection, schema.ballots, [(*one, *stamps) for one in told])
        for s in range(ballots):
            mine = {places[(TILES_A_BALLOT * s + k) % tiles] for k in range(TILES_A_BALLOT)}
            insert_rows(
                connection,
                schema.ballot_tiles,
                [(*place, 10 + s, hashes.points, states, *nothing, total) for place in mine],
            )


def clock_of(url: str) -> Callable[[], float]:
    """SQLite works in this thread."""
    return time.thread_time if url.startswith("sqlite") else time.perf_counter


def measure(url: str, tiles: int) -> dict[str, float]:
    """Milliseconds of each thing."""
    first = make_map({(0, 0): make_tile(wall(WALL, [0.05, 0.45]))})
    store = Store.create(url, first, Policy(fuse=FuseSettings(max_deleted_share=1.0)))
    fill(store, tiles)
    intake, spent, clock = Intake(store), dict[str, list[float]](), clock_of(url)
    store.manifest()

    def timed(name: str, act: Callable[[], object]) -> None:
        start = clock()
        act()
        spent.setdefault(name, []).append(1e3 * (clock() - start))

    publish(store)  # the first after another policy decides everything
    for turn in range(6):
        newest = store.current()
        base = {(0, 0): store.manifest(since=1).tiles[0, 0].points if turn else store.manifest().tiles[0, 0].points}
        say = Say(states_plane({WALL[turn]: CellState.CHANGED_EMPTY}))
        for vehicle in ("a", "b"):
            ballot = make_ballot(first, {(0, 0): say}, vehicle, f"d{turn}", store.clock(), base=base, version=newest)
            data = encode(ballot)
            timed("put", lambda data=data: intake.accept([examine(data)]))
        timed("publish", lambda: publish(store))
        assert store.current() == newest + 1
        timed("since", lambda newest=newest: store.manifest(since=newest))
        timed("changes", lambda newest=newest: changes_between(store, newest, newest + 1))
        timed("coverage", lambda: coverage(store))
    store.close()
    return {name: statistics.median(values[1:]) for name, values in spent.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tiles", type=int, nargs="+", default=[100, 10_000])
    parser.add_argument("--database", choices=["sqlite", "postgresql"], default="sqlite")
    asked = parser.parse_args()
    cluster = PostgresCluster() if asked.database == "postgresql" else None
    try:
        with tempfile.TemporaryDirectory() as folder:
            for tiles in asked.tiles:
                url = cluster.create(f"t{tiles}") if cluster else f"sqlite:///{folder}/{tiles}.db"
                found = measure(url, tiles)
                print(
                    f"| {asked.database}, {tiles} tiles | "
                    + " | ".join(f"{k} {v:.1f}" for k, v in found.items())
                    + " |"
                )
    finally:
        if cluster:
            cluster.close()


if __name__ == "__main__":
    main()
