"""How sure vehicles are, what probability that gives, and which deletions wait."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, wall
from mapvote.codec.ballot import MOST_STEPS, UNSAID, Odds
from mapvote.config import FuseSettings, load_settings
from mapvote.core.grid import Lattice
from mapvote.core.point_map import PointMap
from mapvote.core.types import NO_VOTE, U8, CellState, MapvoteError
from mapvote.fusion.fuse import update_map
from mapvote.fusion.loss_budget import (
    PendingDeletions,
    agreed_odds,
    alike_beside,
    beyond_budget,
    change_probability,
    false_deletion_probability,
    pack_agreed,
    standing_beside,
    unpack_agreed,
    waypoints,
)
from mapvote.fusion.tile_vote import Vote, fold, silenced

CELL, FLAT = (10, 10), 10 * 256 + 10
EMPTY, STANDS = CellState.CHANGED_EMPTY, CellState.UNCHANGED_OCCUPIED
GRID = Lattice().tile((0, 0))
DECIDED = states_plane({CELL: EMPTY})


def vote(vehicle: str, steps: int | None, state: int = EMPTY) -> Vote:
    odds = None if steps is None or state != EMPTY else Odds(np.array([FLAT]), np.array([steps], np.int8))
    return Vote(vehicle, 0, vehicle, states=states_plane({CELL: state}), odds=odds)


def taken(says: list[int | None], quorum: int, against: int = 0) -> int:
    """The agreed confidence of the voters' statements on CELL."""
    votes = [vote(f"v{i}", steps) for i, steps in enumerate(says)]
    votes += [vote(f"w{i}", None, STANDS) for i in range(against)]
    return int(agreed_odds(votes, DECIDED, quorum).at(np.array([FLAT]))[0])


@pytest.mark.parametrize(
    ("says", "quorum", "told"),
    [
        ([10, 20, 30], 2, 20),
        ([10, 30], 2, 10),
        ([10, 20, 30, 40], 2, 20),
        ([10, 20, 30, 40, 50], 2, 30),
        ([10, 20, 30], 3, 10),
        ([7], 1, 7),
        ([10, None], 2, UNSAID),
        ([10, None, 30], 2, 10),
        ([None, None], 1, UNSAID),
    ],
)
def test_the_median_is_taken_and_never_more_than_the_quorum_says(
    says: list[int | None], quorum: int, told: int
) -> None:
    assert {taken(list(order), quorum) for order in itertools.permutations(says)} == {told}
    assert taken(says, quorum, against=2) == told, "who votes otherwise is not asked"


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 3), st.data())
def test_liars_fewer_than_the_quorum_never_talk_it_above_what_an_honest_vehicle_says(
    k: int, data: st.DataObject
) -> None:
    honest = data.draw(st.lists(st.integers(-MOST_STEPS, MOST_STEPS), min_size=1, max_size=5))
    if len(honest) + k >= k + 1:
        assert taken([*honest, *[MOST_STEPS] * k], k + 1) <= max(honest)


def test_a_later_drive_says_how_sure_its_vehicle_is_and_a_silent_one_overrides_nothing() -> None:
    early, late = vote("a", 5), replace(vote("a", 50), end_ns=1, digest="late")
    silent = Vote("a", 2, "silent", states=states_plane({}, fill=NO_VOTE))
    folded = fold([late, silent, early], GRID)
    assert folded.odds is not None
    assert folded.odds.at(np.array([FLAT])).tolist() == [50]
    assert fold([silent, replace(silent, digest="other")], GRID).odds is None
    votes = [silenced(vote(name, 9), np.array([FLAT])) for name in "ab"]
    assert agreed_odds(votes, DECIDED, 2).at(np.array([FLAT])).tolist() == [UNSAID]


def test_what_was_taken_is_stored_a_byte_a_changed_cell() -> None:
    other = (20, 20)
    states = states_plane({CELL: EMPTY, other: CellState.CHANGED_OCCUPIED})
    data = pack_agreed(Odds(np.array([FLAT]), np.array([-3], np.int8)), states)
    assert unpack_agreed(data, states).at(np.array([FLAT, 20 * 256 + 20, 0])).tolist() == [-3, UNSAID, UNSAID]
    assert pack_agreed(Odds.none(), states) is None
    assert not len(unpack_agreed(None, states).cells)
    with pytest.raises(MapvoteError, match="decision: odds"):
        unpack_agreed(data, states_plane())


@pytest.mark.parametrize("state", [CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY])
def test_votes_and_cells_beside_raise_the_probability_of_a_change_and_who_stands_that_of_harm(state: int) -> None:
    votes, against, beside = np.array([[2, 0, 3], [3, 0, 3], [2, 0, 4], [2, 1, 3], [3, 0, 8], [10, 0, 8]]).T
    two, three, more_beside, denied, most, ten = change_probability(np.full(6, state, np.uint8), votes, against, beside)
    assert two < min(three, more_beside)
    assert denied <= two
    assert most == ten < 1.0, "it was fitted to three vehicles"
    by_standing = false_deletion_probability(np.array([0, 1, 3, 8]), np.full(4, 8, np.int8))
    assert by_standing[0] < by_standing[1] < by_standing[2] == by_standing[3], "three are a row; more add nothing"
    by_odds = false_deletion_probability(np.zeros(3, np.int64), np.array([-80, 0, 80], np.int8))
    assert (np.diff(by_odds) < 0).all()
    unsaid = false_deletion_probability(np.array([0, 1, 3, 8]), np.full(4, UNSAID, np.int8))
    assert ((unsaid > 0) & (unsaid < 1)).all()


@given(st.dictionaries(st.tuples(st.integers(-6, 6), st.integers(-6, 6)), st.sampled_from([2, 3]), max_size=60))
def test_cells_of_a_kind_are_counted_around_each_as_by_hand(cells: dict[tuple[int, int], int]) -> None:
    rows, cols = (np.array([cell[k] for cell in cells], np.int64) for k in (0, 1))
    counted = alike_beside(rows, cols, np.array(list(cells.values()), np.int64))
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    assert counted.tolist() == [
        sum(cells.get((r + i, c + j)) == kind for i, j in steps) for (r, c), kind in cells.items()
    ]


CELLS = [(10, 10), (10, 11), (10, 12)]


def street() -> PointMap:
    return make_map({(0, 0): make_tile(wall(CELLS, [0.45, 0.75, 1.05]))})


def said(sure: list[int]) -> Say:
    """All cells of the wall are gone; how sure of each."""
    return Say(states_plane(dict.fromkeys(CELLS, EMPTY)), odds=np.array(sure, np.int8))


def updated(budget: float, *says: Say) -> tuple[int, PendingDeletions]:
    """(points left, what waits) of vehicles that say so."""
    ballots = [make_ballot(street(), {(0, 0): say}, f"v{i}") for i, say in enumerate(says)]
    after, decisions = update_map(street(), ballots, FuseSettings(false_deletions=budget))
    return sum(len(tile.points) for tile in after.tiles.values()), decisions[0, 0].pending


def test_a_cell_beyond_the_budget_keeps_its_points_and_is_pending() -> None:
    unsure = said([40, -MOST_STEPS, 40])
    left, waits = updated(0.01, unsure, unsure)
    assert left == 3, "those of the cell in the middle"
    assert waits.cells.tolist() == [10 * 256 + 11]
    assert waits.probability[0] > 0.01
    assert waits.at((10, 11)) == waits.probability[0]
    assert waits.at((10, 10)) is None
    left, waits = updated(1.0, unsure, unsure)
    assert (left, len(waits.cells)) == (0, 0), "without a budget nothing waits"
    sure, none = said([MOST_STEPS] * 3), said([-MOST_STEPS] * 3)
    assert updated(0.01, sure, none, none)[0] == 9, "one who is sure does not carry two who are not"
    assert updated(0.01, sure, sure, none)[0] == 0


def test_of_ballots_that_do_not_say_the_votes_and_what_stands_beside_are_asked() -> None:
    silent = Say(states_plane(dict.fromkeys(CELLS, EMPTY)))
    before = Say(states_plane(dict.fromkeys(CELLS, EMPTY) | {(11, c): STANDS for c in range(9, 14)}))
    assert updated(0.01, silent, silent)[0] == 0
    assert updated(0.01, before, before)[0] == 9, "a row before a wall that stands"


@settings(max_examples=30, deadline=None)
@given(st.dictionaries(st.integers(0, 65535), st.sampled_from(range(5)), max_size=60), st.floats(1e-6, 0.9))
def test_a_smaller_budget_never_lets_more_go(cells: dict[int, int], budget: float) -> None:
    states = states_plane().reshape(-1)
    states[list(cells)] = list(cells.values())
    plane: U8 = states.reshape(256, 256)
    odds = Odds(np.array(sorted(cells), np.int64), np.array([c % 255 - MOST_STEPS for c in sorted(cells)], np.int8))
    waits = [
        set(beyond_budget(plane, odds, FuseSettings(false_deletions=b)).cells.tolist()) for b in (budget, budget / 2)
    ]
    assert waits[0] <= waits[1] <= set(np.flatnonzero(states == EMPTY).tolist())


@settings(max_examples=30, deadline=None)
@given(st.sets(st.tuples(st.integers(0, 255), st.integers(0, 255)), max_size=60), st.integers(0, 65535))
def test_what_stands_beside_is_counted_as_by_hand(stands: set[tuple[int, int]], cell: int) -> None:
    states = states_plane(dict.fromkeys(stands, int(STANDS)))
    row, col = divmod(cell, 256)
    rows, cols = ([min(max(at + step, 0), 255) for step in (-1, 0, 1)] for at in (row, col))
    around = [(r, c) for i, r in enumerate(rows) for j, c in enumerate(cols) if (i, j) != (1, 1)]
    assert standing_beside(states, np.array([cell])).tolist() == [sum(one in stands for one in around)]


def test_waypoints_lie_in_the_middle_of_what_waits_the_largest_first() -> None:
    lattice = Lattice(x0=100.0, y0=50.0)
    near = PendingDeletions(np.array([r * 256 + c for r in (5, 6) for c in (5, 6)]), np.array([0.1, 0.3, 0.2, 0.1]))
    found = waypoints(
        {(0, 1): PendingDeletions(np.array([0]), np.array([0.9])), (0, 0): near, (1, 0): PendingDeletions.none()},
        lattice,
    )
    assert [(place.cells, place.probability) for place in found] == [(4, 0.3), (1, 0.9)]
    assert (found[0].x, found[0].y) == pytest.approx((100.0 + 6 * 0.3, 50.0 + 6 * 0.3))
    assert (found[1].x, found[1].y) == pytest.approx((100.0 + 256.5 * 0.3, 50.0 + 0.5 * 0.3))
    assert waypoints({(1, 0): PendingDeletions.none()}, lattice) == []


@pytest.mark.parametrize("value", ["0", "-0.1", "1.5", "never"])
def test_a_budget_that_is_no_probability_is_one_clear_error(value: str) -> None:
    with pytest.raises(MapvoteError, match=r"fuse\.false_deletions"):
        load_settings(env={"MAPVOTE_FUSE__FALSE_DELETIONS": value})
