"""A fleet of one vehicle: what waits is told, and drives of different days are voters where the policy says so."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from command_line import typed
from hand_made import Say, make_ballot, make_tile, states_plane, two_walls, wall
from mapvote.config import FuseSettings
from mapvote.core.rule import SURFACES
from mapvote.core.types import CellState
from mapvote.fusion.fuse import fuse_tile
from mapvote.fusion.tile_vote import DAY_NS, Vote, newest_votes
from mapvote_server.questions.coverage import waiting_votes, wanted_passes
from mapvote_server.questions.explain import explain_cell
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import Clock, send

CE, UO = CellState.CHANGED_EMPTY, CellState.UNCHANGED_OCCUPIED
WALL = [(10, 10), (10, 11), (10, 12)]
START_NS = 1_700_000_000 * 10**9
SENTENCE = "3 cells wait: 2 drives say so, all by car_1; a second vehicle or `fuse.min_votes = 1` decides"


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """One vehicle drove twice, on two days, and saw both times that the wall is gone."""
    clock = Clock(START_NS)
    made = Store.create(f"sqlite:///{tmp_path / 'fleet.db'}", two_walls(), clock=clock)
    made.set_policy(Policy(fuse=FuseSettings(max_deleted_share=1.0)))
    for day in range(2):
        clock.now += DAY_NS
        say = Say(states_plane(dict.fromkeys(WALL, CE)))
        send(made, make_ballot(made.point_map(), {(0, 0): say}, "car_1", f"d{day}", clock.now))
    return made


def test_publish_coverage_and_the_cell_tell_what_lacks_only_the_quorum(store: Store, tmp_path: Path) -> None:
    assert not publish(store).published
    assert str(waiting_votes(store)) == SENTENCE
    told = wanted_passes(store)
    assert (told.cells, told.without_path, told.waits, told.features) == (3, 3, SENTENCE, [])
    assert "1 cell waits: 2 drives say so, all by car_1" in explain_cell(store, 3.1, 3.1).thing
    hidden = explain_cell(store, 3.1, 3.1, with_names=False).thing
    assert "waits" in hidden
    assert "car_1" not in hidden, "readers see pseudonyms"
    store.close()
    for verb in (["publish"], ["publish", "--dry-run"], ["coverage"]):
        printed = typed(*verb, tmp_path / "fleet.db")
        assert SENTENCE in " ".join(printed.split()), printed
        assert "no cell waits" not in printed


def test_a_vote_that_is_spent_or_opposed_or_joined_by_a_second_vehicle_does_not_wait(store: Store) -> None:
    say = Say(states_plane({WALL[0]: UO, WALL[1]: CE}))
    send(store, make_ballot(store.point_map(), {(0, 0): say}, "car_2", "d1", store.clock()))
    waits = waiting_votes(store)
    assert waits is None, "two vehicles vote on the tile"
    assert wanted_passes(store).waits.startswith("1 cell waits: 2 drives"), "the third cell of the wall"
    store.set_policy(Policy(fuse=FuseSettings(max_deleted_share=1.0, min_votes=1)))
    assert publish(store).published
    store.set_policy(Policy(fuse=FuseSettings(max_deleted_share=1.0)))
    assert wanted_passes(store).waits == ""


def test_by_days_the_drives_of_two_days_decide_and_of_one_day_do_not(store: Store) -> None:
    days = FuseSettings(max_deleted_share=1.0, one_vehicle="days")
    store.set_policy(Policy(fuse=days))
    assert publish(store).points_deleted == 9
    assert [vote.counted_in for vote in explain_cell(store, 3.1, 3.1).votes] == [(2,), (2,)]


def test_by_days_two_drives_of_one_day_are_one_voter(tmp_path: Path) -> None:
    clock = Clock(START_NS)
    made = Store.create(f"sqlite:///{tmp_path / 'fleet.db'}", two_walls(), clock=clock)
    made.set_policy(Policy(fuse=FuseSettings(max_deleted_share=1.0, one_vehicle="days")))
    for drive in range(3):
        clock.now += 60 * 10**9
        say = Say(states_plane(dict.fromkeys(WALL, CE)))
        send(made, make_ballot(made.point_map(), {(0, 0): say}, "car_1", f"d{drive}", clock.now))
    assert not publish(made).published


@given(st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 5), st.sampled_from([UO, CE])), min_size=1, max_size=8))
@settings(max_examples=30, deadline=None)
def test_by_days_a_tile_is_fused_as_if_each_day_of_a_vehicle_were_a_vehicle(said: list[tuple[str, int, int]]) -> None:
    tile = make_tile(wall(WALL, [0.45, 0.75]))
    votes = [
        Vote(name, (20_000 + day) * DAY_NS + i, f"d{i}", states=states_plane(dict.fromkeys(WALL, state)))
        for i, (name, day, state) in enumerate(said)
    ]
    renamed = [replace(vote, vehicle=f"{vote.vehicle}{vote.end_ns // DAY_NS}") for vote in votes]
    found = []
    for drives, policy in ((votes, "days"), (renamed, "once")):
        fuse = FuseSettings.model_validate({"one_vehicle": policy, "latest_vehicles": 4})
        counting = newest_votes(drives, fuse)
        found.append((fuse_tile(tile, counting, SURFACES, fuse, 2, partial(list, counting)), len(counting)))
    (one, n), (other, m) = found
    assert n == m
    assert np.array_equal(one[0].states, other[0].states)
    assert one[1].points.tobytes() == other[1].points.tobytes()
