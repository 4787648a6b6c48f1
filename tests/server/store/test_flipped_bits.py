"""One bit of a store is flipped: ``check`` names it, and everything else is published as if nothing had been.

A store of six tiles, three versions and a round of ballots under way; each time a fresh copy of it.
``FLIPS=100 pytest -m slow`` of this file flips so many.
"""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from mapvote.codec.manifest import TileHashes
from mapvote.codec.tile_planes import unpack_points_plane
from mapvote.config import FuseSettings
from mapvote.core.grid import TileIndex
from mapvote.core.types import CellState
from mapvote_server.store import schema
from mapvote_server.store.integrity import check
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from postgres_cluster import PostgresCluster
from stores import send

TILES = [(0, col) for col in range(6)]
CELLS = [(10, 10 + c) for c in range(4)]
TABLES = [table for table in schema.metadata.sorted_tables if table.name != "quarantine"]
Place = tuple[sa.Table, sa.Column[Any], dict[str, Any]]


Copied = Callable[[str], Store]


def damageable(url: str) -> None:
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
            say.fields = {"intensity": np.array([51, 204], dtype=np.uint8)}
            send(store, make_ballot(base, dict.fromkeys(TILES, say), vehicle, f"d{step}", store.clock() - 10**9))
        if step < 2:
            assert publish(store).published
    store.close()


@pytest.fixture
def copied(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Copied]:
    """Opens a copy of this name of one store, on the database that is the parameter."""
    stores: list[Store] = []
    cluster: PostgresCluster | None = None
    if request.param == "postgresql":
        cluster = request.getfixturevalue("postgres_cluster")
    damageable(cluster.create("whole") if cluster else f"sqlite:///{tmp_path}/whole.db")

    def copy(name: str) -> Store:
        url = cluster.create(name, like="whole") if cluster else ""
        stores.append(Store.open(url or f"sqlite:///{shutil.copy(tmp_path / 'whole.db', tmp_path / f'{name}.db')}"))
        return stores[-1]

    yield copy
    for store in stores:
        store.close()
    if cluster:
        for name in ("whole", *(f"copy_{n}" for n in range(len(stores)))):
            cluster.drop(name)


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
    return (key.get("row", index[0]), key.get("col", index[1])) == index


def flip_some(copied: Copied, flips: int, every_table: bool) -> None:
    """A bit at a time, each by its own seed."""
    whole = copied("copy_0")
    publish(whole)
    expected = whole.tiles()
    for n in range(flips):
        store = copied(f"copy_{n + 1}")
        before, place = store.tiles(), flip(store, random.Random(n), every_table)
        assert check(store), place
        publish(store)
        after = store.tiles()
        others = [index for index in TILES if not touches(place, index, before[index])]
        assert [index for index in others if after[index] != expected[index]] == [], place
        for index in others:
            unpack_points_plane(store.blob(after[index].points), after[index].points)


@pytest.mark.slow
@pytest.mark.parametrize("copied", ["sqlite", "postgresql"], indirect=True)
def test_a_bit_flipped_anywhere_is_named_and_all_else_is_published(copied: Copied) -> None:
    flip_some(copied, int(os.environ.get("FLIPS", "30")), every_table=False)


@pytest.mark.parametrize("copied", ["sqlite"], indirect=True)
def test_a_bit_flipped_in_any_table_is_named(copied: Copied) -> None:
    flip_some(copied, 6, every_table=True)
