"""Points that hang on a demolished house fall with it at the server, over the borders of tiles, and can be
explained."""

from __future__ import annotations

import numpy as np
import pytest

from hand_made import Cell, Say, make_ballot, make_map, make_tile, states_plane, wall, words_plane
from mapvote.codec.ballot import Ballot
from mapvote.config import FuseSettings
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, TileIndex
from mapvote.core.point_map import PointMap, all_points
from mapvote.core.types import CellState
from mapvote.fusion.fuse import update_map
from mapvote_server.questions.changes import changes_between
from mapvote_server.questions.desk import desk, review
from mapvote_server.questions.explain import explain_cell
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import preview, publish
from mapvote_server.store.reviews import undo
from mapvote_server.store.rollback import replay, rollback
from mapvote_server.store.store import Store
from stores import Clock, NewStore, send

FUSE = FuseSettings(min_votes=2, max_deleted_share=1.0)
START_NS = 1_700_000_000 * 10**9
FRONT: list[Cell] = [(250, col) for col in range(250, 262)]
"""A facade in two tiles."""
ROOF: list[Cell] = [(row, col) for row in range(250, 260) for col in range(250, 262)]
"""It hangs on the facade, in four tiles; nobody sees it."""
HIGH = [(bit + 0.5) * CELL_SIZE for bit in range(1, 19)]
TOP = [(bit + 0.5) * CELL_SIZE for bit in (18, 19)]


POINTS = len(FRONT) * len(HIGH) + len(ROOF) * len(TOP)


def split(cells: list[Cell]) -> dict[TileIndex, list[Cell]]:
    found: dict[TileIndex, list[Cell]] = {}
    for row, col in cells:
        found.setdefault((row // TILE_CELLS, col // TILE_CELLS), []).append((row % TILE_CELLS, col % TILE_CELLS))
    return found


def house() -> PointMap:
    facade, roof = split(FRONT), split(ROOF)
    tiles = {
        index: make_tile(np.concatenate([wall(facade.get(index, []), HIGH), wall(cells, TOP)]), index=index)
        for index, cells in roof.items()
    }
    return make_map(tiles)


@pytest.fixture
def clock() -> Clock:
    return Clock(START_NS)


@pytest.fixture
def store(new_store: NewStore, clock: Clock) -> Store:
    return new_store(house(), Policy(fuse=FUSE), clock=clock)


def says_gone(base: PointMap, vehicle: str, cells: list[Cell] = FRONT, end_ns: int = START_NS) -> Ballot:
    seen = 0x3FFFE if cells is FRONT else 0xFFFFE  # of the facade nobody sees the top
    says = {
        index: Say(
            states_plane(dict.fromkeys(mine, CellState.CHANGED_EMPTY)), gone=words_plane(dict.fromkeys(mine, seen))
        )
        for index, mine in split(cells).items()
    }
    return make_ballot(base, says, vehicle, f"{vehicle}{end_ns}", end_ns)


def vote(store: Store, vehicles: str, cells: list[Cell] = FRONT) -> None:
    base = store.point_map()
    send(store, *[says_gone(base, name, cells, store.clock()) for name in vehicles])


def at(cell: Cell) -> tuple[float, float]:
    return (cell[1] + 0.5) * CELL_SIZE, (cell[0] + 0.5) * CELL_SIZE


def test_the_server_publishes_what_update_makes(store: Store) -> None:
    base = store.point_map()
    vote(store, "ab")
    offline, _ = update_map(base, [says_gone(base, name) for name in "ab"], FUSE)
    outcome = publish(store)
    assert set(outcome.tiles) == {"0,0", "0,1", "1,0", "1,1"}, "two of them without a vote"
    assert outcome.points_deleted == POINTS
    assert len(all_points(store.point_map())) == len(all_points(offline)) == 0


def test_a_cell_that_fell_says_with_which_object(store: Store) -> None:
    vote(store, "ab")
    publish(store)
    (thing,) = changes_between(store, 1, 2).features
    assert (thing.properties.cells, thing.properties.fell) == (len(ROOF), len(ROOF))
    for cell in ((259, 261), (259, 250), (252, 255)):
        story = explain_cell(store, *at(cell))
        assert [d.fell for d in story.decisions] == [f"fell with object {thing.id}: nothing holds it"]
        assert story.probability is None


def test_a_review_of_the_house_covers_what_falls_with_it(store: Store) -> None:
    vote(store, "ab")
    (change,) = desk(store).answer.pending.features
    assert change.properties.cells == len(ROOF)
    number = review(store, change.id, "rejected", by="olga")
    assert preview(store).tiles == []
    undo(store, number, by="olga")
    assert publish(store).points_deleted == POINTS


def test_what_a_reviewer_holds_does_not_fall_with_the_house_next_door(store: Store, clock: Clock) -> None:
    vote(store, "ab", ROOF[-3:])
    (change,) = desk(store).answer.pending.features
    review(store, change.id, "held", by="olga")
    clock.now += 10**9
    vote(store, "ab")
    publish(store)
    assert len(all_points(store.point_map())) == len(ROOF) * len(TOP) + len(FRONT), "the roof hangs on what is held"


def test_without_the_vehicle_that_decided_the_house_nothing_fell(store: Store) -> None:
    before = {index: hashes.points for index, hashes in store.tiles(1).items()}
    vote(store, "ab")
    publish(store)
    replay(store, "b", dry_run=False)
    assert {index: hashes.points for index, hashes in store.tiles(3).items()} == before


def test_without_a_vehicle_that_was_not_needed_everything_stays_fallen(store: Store, clock: Clock) -> None:
    vote(store, "abc")
    publish(store)
    made = {index: hashes.points for index, hashes in store.tiles(2).items()}
    clock.now += 10**9
    replay(store, "c", dry_run=False)
    assert {index: hashes.points for index, hashes in store.tiles().items()} == made


def test_a_rollback_brings_back_what_fell(store: Store) -> None:
    before = {index: hashes.points for index, hashes in store.tiles(1).items()}
    vote(store, "ab")
    publish(store)
    rollback(store, 1)
    assert {index: hashes.points for index, hashes in store.tiles(3).items()} == before


def test_a_round_that_is_asked_again_lets_the_same_fall(store: Store) -> None:
    vote(store, "a")
    assert preview(store).tiles == []
    vote(store, "b")
    first = preview(store)
    vote(store, "c", [(100, 100)])
    assert preview(store).points_deleted == first.points_deleted == POINTS
