"""Flip one bit of a store, a hundred times: does `mapvote check` name it, and is everything else still published?

python benchmarks/flipped_bits.py --database sqlite
python benchmarks/flipped_bits.py --database postgresql

A store of six tiles, three versions, a round of ballots under way. Each time a fresh copy of it, and one bit of one
value turned: of a random byte of all that it stores (``--every-table``: of a random table's instead, so that small
tables are met as often as large ones). Named: check tells of the damage. Then a publish: whatever the bit did not touch
must come out as it would have. Served: every plane of every other tile can be fetched and is what its hash says. Ends
with 1 otherwise.
"""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from mapvote.codec.manifest import TileHashes
from mapvote.codec.tile_planes import unpack_points_plane
from mapvote.config import FuseSettings
from mapvote.core.grid import TileIndex
from mapvote.core.types import CellState, MapvoteError
from mapvote.server.store import schema
from mapvote.server.store.integrity import check
from mapvote.server.store.policy import Policy
from mapvote.server.store.publish import publish
from mapvote.server.store.store import Store
from postgres_cluster import cluster_for
from stores import send

TILES = [(0, col) for col in range(6)]
CELLS = [(10, 10 + c) for c in range(4)]
TABLES = [table for table in schema.metadata.sorted_tables if table.name != "quarantine"]
Place = tuple[sa.Table, sa.Column[Any], dict[str, Any]]


def make(url: str) -> None:
    """The store that is damaged again and again."""
    tiles = {
        index: make_tile(wall(CELLS, [0.05, 0.45, 0.75 + 0.01 * index[1]]), ground=0.001 * index[1], index=index)
        for index in TILES
    }
    for index, tile in tiles.items():  # no two tiles carry the same
        bright = np.arange(len(tile.points), dtype=np.uint16) + 100 * index[1]
        tiles[index] = tile.but(fields={"intensity": bright, "gps_time": bright * 0.5})
    store = Store.create(url, make_map(tiles), Policy(fuse=FuseSettings(max_deleted_share=1.0)))
    for step, cell in enumerate(CELLS[:3]):
        base = store.point_map()
        for vehicle in ("a", "b", "c"):
            built = (50, 50 + step)
            states = {cell: CellState.CHANGED_EMPTY, built: CellState.CHANGED_OCCUPIED}
            say = Say(states_plane(states, fill=CellState.UNDETERMINED), new_points=wall([built], [0.45, 0.75]))
            say.intensity = np.array([51, 204], dtype=np.uint8)
            send(store, make_ballot(base, dict.fromkeys(TILES, say), vehicle, f"d{step}", store.clock() - 10**9))
        if step < 2:
            assert publish(store).published
    store.close()


def flip(store: Store, rng: random.Random, every_table: bool) -> Place:
    """Turn one bit of a random byte; where."""
    with store.database.writing() as connection:
        found = [
            (len(row[column.name]), (table, column, {key.name: row[key.name] for key in table.primary_key}))
            for table in TABLES
            for row in connection.execute(sa.select(table)).mappings()
            for column in table.columns
            if isinstance(row[column.name], bytes | memoryview | str) and not column.primary_key and row[column.name]
        ]
        if every_table:
            name = rng.choice(sorted({place[0].name for _, place in found}))
            found = [(size, place) for size, place in found if place[0].name == name]
        ((_, place),) = rng.choices(found, weights=[size for size, _ in found])
        table, column, key = place
        where = sa.and_(*(table.c[name] == value for name, value in key.items()))
        value = connection.execute(sa.select(column).where(where)).scalar_one()
        raw = bytearray(value.encode() if isinstance(value, str) else bytes(value))
        raw[rng.randrange(len(raw))] ^= 1 << rng.randrange(3 if isinstance(value, str) else 8)  # text stays text
        turned = raw.decode() if isinstance(value, str) else bytes(raw)
        connection.execute(table.update().where(where).values({column: turned}))
    return place


def touches(place: Place, index: TileIndex, hashes: TileHashes) -> bool:
    """Whether the damage is of this tile or of its votes."""
    table, _, key = place
    if table is schema.blobs:
        return key["hash"] in (hashes.points, hashes.ground, hashes.free, hashes.memory, hashes.fields)
    return key.get("row", index[0]) == index[0] and key.get("col", index[1]) == index[1]


def try_once(url: str, rng: random.Random, every_table: bool, expected: dict[TileIndex, TileHashes]) -> tuple[str, ...]:
    """(where, named or not, how the rest fared)."""
    store = Store.open(url)
    try:
        before = store.tiles()
        place = flip(store, rng, every_table)
        where, named = f"{place[0].name}.{place[1].name}", "named" if check(store) else "not named"
        try:
            publish(store)
            after = store.tiles()
            others = [index for index in TILES if not touches(place, index, before[index])]
            wrong = [index for index in others if after[index] != expected[index]]
            for index in others:
                unpack_points_plane(store.blob(after[index].points), after[index].points)
            return where, named, f"{len(wrong)} other tiles were not published" if wrong else "all else published"
        except MapvoteError as error:
            return where, named, f"not published: {error}"[:100]
    finally:
        store.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--database", choices=["sqlite", "postgresql"], default="sqlite")
    parser.add_argument("--flips", type=int, default=100)
    parser.add_argument("--every-table", action="store_true")
    asked = parser.parse_args()
    results: Counter[tuple[str, ...]] = Counter()
    with tempfile.TemporaryDirectory() as folder, cluster_for(asked.database) as cluster:

        def copied(name: str) -> str:
            if cluster:
                return cluster.create(name, like="first")
            return f"sqlite:///{shutil.copy(f'{folder}/first.db', f'{folder}/{name}.db')}"

        make(cluster.create("first") if cluster else f"sqlite:///{folder}/first.db")
        store = Store.open(copied("expected"))
        publish(store)
        expected = dict(store.tiles())
        store.close()
        for n in range(asked.flips):
            results[try_once(copied(f"s{n}"), random.Random(n), asked.every_table, expected)] += 1
            if cluster:
                cluster.drop(f"s{n}")
    print(f"| {asked.database}: where the bit was | flips | check | the rest |\n|---|---|---|---|")
    for (where, named, rest), count in sorted(results.items()):
        print(f"| `{where}` | {count} | {named} | {rest} |")
    named = sum(count for (_, found, _), count in results.items() if found == "named")
    whole = sum(count for (_, _, rest), count in results.items() if rest == "all else published")
    print(f"{asked.flips} flips: {named} named, all else published after {whole}")
    sys.exit(min(named, whole) < asked.flips)


if __name__ == "__main__":
    main()
