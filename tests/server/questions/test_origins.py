"""The version and the votes behind each point, on a street whose history is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hand_made import Cell, Say, make_ballot, make_map, make_tile, states_plane, wall
from mapvote.core.tile import Tile
from mapvote.core.types import NO_VOTE, CellState
from mapvote_server.questions.origins import with_origins
from mapvote_server.store.publish import publish
from mapvote_server.store.rollback import rollback
from mapvote_server.store.store import Store
from stores import send

OLD: list[Cell] = [(10, 10), (10, 11), (10, 12)]
NEW: list[Cell] = [(40, 40), (40, 41), (40, 42)]
HEIGHTS = [0.45, 0.75, 1.05]


def street(path: Path) -> Store:
    ground = wall([(r, c) for r in range(5, 50) for c in range(5, 50)], [0.05])
    return Store.create(
        f"sqlite:///{path}", make_map({(0, 0): make_tile(np.concatenate([ground, wall(OLD, HEIGHTS)]))})
    )


def came(store: Store, cells: list[Cell], vehicles: str, drive: str) -> None:
    """Vehicles see something new in these cells, and the old wall where it was."""
    states = states_plane(dict.fromkeys(cells, CellState.CHANGED_OCCUPIED), NO_VOTE)
    states[tuple(np.transpose(OLD))] = CellState.UNCHANGED_OCCUPIED
    say = Say(states, new_points=wall(cells, HEIGHTS))
    base = store.point_map()
    send(store, *[make_ballot(base, {(0, 0): say}, one, drive, end_ns=store.clock()) for one in vehicles])
    assert publish(store, override=True).published


def tile_of(store: Store, version: int | None = None) -> Tile:
    return with_origins(store, store.point_map(version)).tiles[0, 0]


def among(tile: Tile, cells: list[Cell]) -> np.ndarray:
    """Indices of a tile's points above the ground of these cells."""
    flat = [row * 256 + col for row, col in cells]
    return np.flatnonzero(np.isin(tile.cells, flat) & (tile.points[:, 2] > 0.3))


def test_a_point_has_the_version_that_brought_it_and_the_vehicles_that_voted_for_it(tmp_path: Path) -> None:
    store = street(tmp_path / "s.db")
    assert set(tile_of(store).fields["source_version"]) == {1}
    assert not tile_of(store).fields["votes"].any()
    came(store, NEW, "abc", "monday")
    tile = tile_of(store)
    new = among(tile, NEW)
    old = among(tile, OLD)
    assert len(new)
    assert set(tile.fields["source_version"][new]) == {2}
    assert set(tile.fields["source_version"][old]) == {1}
    assert set(tile.fields["votes"][new]) == set(tile.fields["votes"][old]) == {3}
    spoken = [row * 256 + col for row, col in [*OLD, *NEW]]
    assert not tile.fields["votes"][~np.isin(tile.cells, spoken)].any()
    store.close()


def test_later_versions_change_the_origin_of_no_point_that_stays(tmp_path: Path) -> None:
    store = street(tmp_path / "s.db")
    came(store, NEW, "abc", "monday")
    came(store, [(30, 20), (30, 21), (30, 22)], "ab", "tuesday")
    tile = tile_of(store)
    new = among(tile, NEW)
    assert set(tile.fields["source_version"][new]) == {2}
    assert set(tile.fields["votes"][new]) == {3}
    assert set(tile.fields["source_version"][among(tile, [(30, 21)])]) == {3}
    assert set(tile.fields["votes"][among(tile, OLD)]) == {3}, "the latest vehicles that confirm it"
    store.close()


def test_a_point_that_a_rollback_brings_back_comes_from_the_rollback(tmp_path: Path) -> None:
    store = street(tmp_path / "s.db")
    came(store, NEW, "ab", "monday")
    rollback(store, 1)
    rollback(store, 2)
    tile = tile_of(store)
    assert set(tile.fields["source_version"][among(tile, NEW)]) == {4}
    assert set(tile.fields["source_version"][among(tile, OLD)]) == {1}
    assert set(tile_of(store, 2).fields["source_version"][among(tile_of(store, 2), NEW)]) == {2}
    store.close()
