"""Change objects: what a user reads on the map of changes."""

from __future__ import annotations

import json
from functools import cache

import msgspec
import numpy as np
import pytest

from mapvote.codec.planes import pack_plane
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice, TileIndex
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.tile import Tile
from mapvote.core.types import NO_VOTE, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.fusion.decision_record import Record, pack_edit_votes, pack_tally
from mapvote.fusion.edit import EditVotes
from mapvote.shapes.change_objects import ChangeObject, Decided, change_objects, changed_cells
from mapvote.shapes.geojson import to_geojson

TILE_M = TILE_CELLS * CELL_SIZE
S = 1_000_000_000


def cell_points(col0: int, row0: int, cols: int, rows: int, heights: tuple[float, ...]) -> np.ndarray:
    """One point in the middle of each cell, at each height."""
    c, r, z = np.meshgrid(np.arange(col0, col0 + cols), np.arange(row0, row0 + rows), heights, indexing="ij")
    return np.stack([(c + 0.5) * CELL_SIZE, (r + 0.5) * CELL_SIZE, z], axis=-1).reshape(-1, 3).astype(np.float64)


def street(*houses: np.ndarray) -> PointMap:
    """Flat ground at z = 0 over 2 x 2 tiles, and houses."""
    return _bare() if not houses else map_from_points(np.concatenate([_GROUND, *houses]), map_id="street")


_GROUND = cell_points(-256, -256, 512, 512, (0.0,))


@cache
def _bare() -> PointMap:
    return map_from_points(_GROUND, map_id="street")


def compare(
    before: PointMap, after: PointMap, decided: dict[TileIndex, list[Decided]] | None = None
) -> list[ChangeObject]:
    tiles = sorted(set(before.tiles) | set(after.tiles), reverse=True)
    return change_objects([changed_cells(before.tile(t), after.tile(t), (decided or {}).get(t, ())) for t in tiles])


def test_a_house_over_four_tiles_is_one_object_with_the_outline_of_the_house() -> None:
    house = cell_points(-10, -20, 30, 40, (1.0, 4.6))
    (built,) = compare(street(), street(house))
    assert (built.kind, built.cells, built.points) == ("built", 30 * 40, 2 * 30 * 40)
    assert built.area_m2 == pytest.approx(9.0 * 12.0)
    assert built.height_m == pytest.approx(4.6, abs=0.02)
    assert [[ring.tolist() for ring in polygon] for polygon in built.outline] == [
        [[[-10, -20], [20, -20], [20, 20], [-10, 20], [-10, -20]]]
    ]


def test_nothing_shows_where_tiles_meet() -> None:
    """The same houses, shifted so that tile borders fall elsewhere, are the same objects shifted."""
    houses = [cell_points(-10, -20, 30, 40, (1.0, 4.0)), cell_points(-60, 0, 7, 1, (2.0,))]
    here = compare(street(), street(*houses))
    dx, dy = 100, 64
    there = compare(street(), street(*[h + np.array([dx, dy, 0]) * CELL_SIZE for h in houses]))
    assert [(o.kind, o.cells, o.points, round(o.height_m, 3)) for o in here] == [
        (o.kind, o.cells, o.points, round(o.height_m, 3)) for o in there
    ]
    for a, b in zip(here, there, strict=True):
        assert [(r + np.array([dx, dy])).tolist() for p in a.outline for r in p] == [
            r.tolist() for p in b.outline for r in p
        ]


def test_a_demolished_house_beside_a_built_one_stays_apart() -> None:
    old, new = cell_points(0, 0, 5, 5, (2.0,)), cell_points(5, 0, 5, 5, (3.0,))
    changes = compare(street(old), street(new))
    assert [(c.kind, c.cells) for c in changes] == [("demolished", 25), ("built", 25)]
    assert [c.id for c in changes] == ["demolished.v0.0.0", "built.v0.0.5"]


def test_the_way_back_has_the_other_sign() -> None:
    before, after = street(), street(cell_points(0, 0, 5, 5, (2.0,)))
    forth, back = compare(before, after), compare(after, before)
    assert [c.kind for c in forth] == ["built"]
    assert [c.kind for c in back] == ["demolished"]
    assert forth[0].area_m2 == back[0].area_m2
    assert compare(after, after) == []


def test_a_new_tile_and_unknown_ground() -> None:
    points = np.array([[1.0, 1.0, 5.0], [1.0, 1.0, 7.0]], dtype=np.float32)
    unknown = Tile(Lattice().tile((3, -2)), points, np.full((TILE_CELLS, TILE_CELLS), np.nan, dtype=np.float32))
    cells = changed_cells(Tile.empty(unknown.window), unknown)
    assert cells.rows.tolist() == [3 * TILE_CELLS + 3]
    assert cells.cols.tolist() == [-2 * TILE_CELLS + 3]
    assert cells.top_m.tolist() == [2.0], "without ground, height is measured from its own lowest point"


def test_a_bus_stop_rebuilt_goes_by_the_larger_number() -> None:
    tile = street(cell_points(0, 0, 1, 1, (1.0, 1.4, 2.0))).tiles[(0, 0)]
    moved = street(cell_points(0, 0, 1, 1, (1.1,))).tiles[(0, 0)]
    assert changed_cells(tile, moved).states.tolist() == [CellState.CHANGED_EMPTY]
    assert changed_cells(moved, tile).states.tolist() == [CellState.CHANGED_OCCUPIED]


def test_votes_and_stamps_come_from_the_drives_that_said_so() -> None:
    before, after = street(), street(cell_points(0, 0, 2, 1, (2.0,)))
    states = np.full((TILE_CELLS, TILE_CELLS), NO_VOTE, dtype=np.uint8)
    states[0, :2] = CellState.CHANGED_OCCUPIED
    against = np.full_like(states, NO_VOTE)
    against[0, :2] = CellState.UNCHANGED_EMPTY
    tally = np.zeros((TILE_CELLS, TILE_CELLS, 5), dtype=np.int32)
    tally[0, 0, CellState.CHANGED_OCCUPIED] = 5 * VOTE_UNIT
    tally[0, 1, CellState.CHANGED_OCCUPIED] = 2 * VOTE_UNIT
    drives = [(30 * S, states), (10 * S, states), (99 * S, against)]
    decided = Record(7, pack_plane(states), pack_tally(tally), None, b""), drives
    (built,) = compare(before, after, {(0, 0): [decided]})
    assert (built.votes_min, built.votes_median) == (2, 3.5)
    assert (built.first_seen_ns, built.last_seen_ns) == (10 * S, 30 * S)
    assert (built.id, built.versions) == ("built.v7.0.0", [7])
    overruled = Record(8, pack_plane(against), pack_tally(tally), None, b""), drives
    (still,) = compare(before, after, {(0, 0): [decided, overruled]})
    assert (still.id, still.votes_min, still.versions) == (built.id, 2, [7])


def test_a_cell_edited_though_the_version_states_no_change_has_the_votes_of_the_edit() -> None:
    """Points that noise carried over: the version calls the cell empty, and the points come with the wall."""
    before, after = street(), street(cell_points(0, 0, 2, 1, (2.0,)))
    states = np.full((TILE_CELLS, TILE_CELLS), NO_VOTE, dtype=np.uint8)
    states[0, 0] = CellState.CHANGED_OCCUPIED
    states[0, 1] = CellState.UNCHANGED_EMPTY
    tally = np.zeros((TILE_CELLS, TILE_CELLS, 5), dtype=np.int32)
    tally[0, 0, CellState.CHANGED_OCCUPIED] = 3 * VOTE_UNIT
    came, one, two = np.array([CellState.CHANGED_OCCUPIED], np.uint8), np.array([1], np.int32), np.array([2], np.int32)
    edits = EditVotes(np.array([1]), came, two, one)
    record = Record(7, pack_plane(states), pack_tally(tally), None, b"", pack_edit_votes(edits))
    (built,) = compare(before, after, {(0, 0): [(record, [])]})
    assert (built.votes_min, built.votes_median, built.against_median, built.trimmed) == (2, 2.5, 0.5, 0)


def test_geojson_says_that_it_is_in_map_metres_and_is_the_same_every_time() -> None:
    before = street()
    after = street(cell_points(0, 0, 3, 3, (2.0,)), cell_points(3, 3, 1, 1, (2.0,)))
    first, again = (
        msgspec.json.encode(
            to_geojson(compare(before, after), Lattice(0.3, -0.6), map_id="street", from_version=1, to_version=2)
        )
        for _ in range(2)
    )
    assert first == again
    collection = json.loads(first)
    assert "map metres" in collection["frame"]
    assert not {"coordinates", "geometry", "geometries", "properties", "crs"} & set(collection)  # RFC 7946, 7.1 and 4
    (feature,) = collection["features"]
    assert feature["geometry"] == {
        "type": "MultiPolygon",
        "coordinates": [
            [[[0.3, -0.6], [1.2, -0.6], [1.2, 0.3], [0.3, 0.3], [0.3, -0.6]]],
            [[[1.2, 0.3], [1.5, 0.3], [1.5, 0.6], [1.2, 0.6], [1.2, 0.3]]],
        ],
    }
    assert feature["properties"] == {
        "kind": "built",
        "size": "small",
        "area_m2": 0.9,
        "height_m": 2.0,
        "volume_m3": 0.27,
        "cells": 10,
        "points": 10,
        "votes_min": 0,
        "votes_median": 0.0,
        "against_median": 0.0,
        "share_for": None,
        "probability": None,
        "first_seen": None,
        "last_seen": None,
        "versions": [],
        "box": [[0.3, -0.6], [1.5, 0.6]],
        "trimmed": 0,
        "fell": 0,
        "near": [],
    }


def test_specks_can_be_left_out() -> None:
    before, after = street(), street(cell_points(0, 0, 2, 2, (2.0,)), cell_points(9, 9, 1, 1, (2.0,)))
    tile = changed_cells(before.tiles[(0, 0)], after.tiles[(0, 0)])
    assert [o.cells for o in change_objects([tile])] == [4, 1]
    assert [o.cells for o in change_objects([tile], min_cells=4)] == [4]
    assert change_objects([]) == []


def test_geojson_of_a_map_on_earth_is_longitude_and_latitude() -> None:
    """The corner of MGRS square 54SUE lies at 138.9 degrees east, 35.2 north."""
    before, after = street(), street(cell_points(0, 0, 3, 3, (2.0,)))
    place = {"crs": "EPSG:32654", "offset": "300000.0,3900000.0,0.0"}
    found = to_geojson(compare(before, after), Lattice(), map_id="m", georeference=place, lonlat=True)
    corners = np.array(found.features[0].geometry.coordinates[0])
    assert np.abs(corners - [138.80, 35.22]).max() < 0.05
    assert (np.ptp(corners, axis=0) < 2e-5).all()
    local = to_geojson(compare(before, after), Lattice(), map_id="m", lonlat=True)
    assert "local metres" in local.frame


def test_two_vehicles_that_left_are_no_large_object_and_a_long_low_wall_is() -> None:
    bus, car = cell_points(0, 0, 38, 9, (0.6, 1.5, 3.2)), cell_points(42, 2, 13, 3, (1.2,))
    (left,) = compare(street(bus, car), street())
    assert (left.box[2] - left.box[0]) * CELL_SIZE > 12.0
    assert left.size == "vehicle"
    assert left.longest_m == pytest.approx(11.4)
    (wall,) = compare(street(cell_points(0, 0, 45, 1, (1.5,))), street())
    assert wall.size == "large"
    assert wall.longest_m == pytest.approx(13.5)


def test_a_low_shed_is_no_vehicle_for_it_is_wider_than_any() -> None:
    ring = [(r, c) for r in range(14) for c in range(16) if r in (0, 13) or c in (0, 15)]
    walls = np.concatenate([cell_points(r, c, 1, 1, (0.6, 2.4)) for r, c in ring])
    (shed,) = compare(street(walls), street())
    assert shed.longest_m == pytest.approx(4.8)
    assert shed.width_m == pytest.approx(4.2)
    assert shed.size == "large"
    slanted = np.concatenate([cell_points(i, i, 6, 6, (1.5,)) for i in range(24)])
    (bus,) = compare(street(slanted), street())
    assert bus.width_m < 3.4
    assert bus.size == "vehicle"
