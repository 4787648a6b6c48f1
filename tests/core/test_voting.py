"""The one rule: paper Eq. (1), Table I, Section IV, and the algebra that makes the server exact."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapvote.core.types import N_STATES, NO_VOTE, CellState
from mapvote.core.voting import VOTE_UNIT, cast, decide_cells, one_hot, plurality, to_wire, vote_weight, weight_table

UO, UE, CO, CE, UN = CellState
states_grids = arrays(np.uint8, (4, 5), elements=st.sampled_from([*range(N_STATES), NO_VOTE]))
tallies = arrays(np.int32, (3, 4, N_STATES), elements=st.integers(0, 10_000))

TABLE_I = np.array([[0, 0, 25, 0, 20], [0, 0, 25, 0, 20], [5, 0, 18, 0, 22]])
"""Scans per class of the three vehicles (paper Table I), in the order of CellState."""


@pytest.mark.parametrize(("n", "exact"), [(5, 2.0), (6, 3 - math.exp(-0.5)), (10, 3 - math.exp(-2.5)), (50, 3.0)])
def test_equation_1(n: int, exact: float) -> None:
    assert float(vote_weight(n)) == pytest.approx(exact, abs=1e-9)
    assert weight_table(True, 2.0, 3.0, 0.5, 5)[n] == pytest.approx(exact * VOTE_UNIT, abs=0.5)


def test_below_n_min_a_cell_is_not_occupied() -> None:
    assert (vote_weight(np.arange(5)) == 0).all()
    assert weight_table(False, 2.0, 3.0, 0.5, 5).tolist()[3:7] == [0, 0, VOTE_UNIT, VOTE_UNIT]


def test_table_i_vehicles_as_printed_by_plain_plurality_of_scans() -> None:
    assert plurality(TABLE_I.astype(np.int32)).tolist() == [CO, CO, UN]


def test_table_i_server_row() -> None:
    decided = np.array([CO, CO, UN], dtype=np.uint8)
    assert int(plurality(one_hot(decided).sum(axis=0))) == CO


def test_table_i_contradicts_equation_1() -> None:
    """By Eq. (1) 25 changed-occupied scans are worth at least 50 votes, not the 33 that the text says, and
    vehicle 3's 18 are worth at least 36, which beats its 22 undetermined ones. We keep Eq. (1)."""
    assert 25 * float(vote_weight(5)) >= 50 > 33
    least = TABLE_I * np.array([2, 1, 2, 1, 1])
    assert plurality(least.astype(np.int32)).tolist() == [CO, CO, CO]


def test_ten_scans_of_the_paper() -> None:
    """III-B: four against six is decided, five against five is undetermined."""
    for empty, changed, expected in ((4, 6, CE), (5, 5, UN)):
        tally = np.zeros((1, 1, N_STATES), np.int32)
        for state, scans in ((UE, empty), (CE, changed)):
            for _ in range(scans):
                cast(tally, np.array([[state]], np.uint8), np.array([[VOTE_UNIT]], np.int32))
        assert plurality(tally)[0, 0] == expected


def test_no_vote_adds_nothing_and_no_votes_decide_nothing() -> None:
    tally = np.zeros((1, 1, N_STATES), np.int32)
    cast(tally, np.array([[NO_VOTE]], np.uint8), np.array([[48]], np.int32))
    assert not tally.any()
    assert plurality(tally)[0, 0] == NO_VOTE


@given(states_grids)
def test_a_decided_ballot_is_a_one_hot_tally(states: np.ndarray) -> None:
    np.testing.assert_array_equal(plurality(one_hot(states)), states)


@given(st.lists(tallies, min_size=1, max_size=5), st.randoms())
def test_the_order_of_ballots_never_matters(ballots: list[np.ndarray], random: object) -> None:
    shuffled = list(ballots)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(plurality(np.sum(ballots, axis=0)), plurality(np.sum(shuffled, axis=0)))


@given(st.lists(states_grids, min_size=1, max_size=7), st.integers(1, 4))
def test_a_change_needs_enough_votes_and_a_majority_of_those_who_determined(
    ballots: list[np.ndarray], min_votes: int
) -> None:
    tally = np.moveaxis(np.sum([one_hot(b) for b in ballots], axis=0), -1, 0).reshape(len(CellState), -1)
    decided = decide_cells(tally, tally, True, min_votes * VOTE_UNIT).reshape(ballots[0].shape)
    votes = np.array(ballots)
    for change in (CO, CE):
        support = (votes == change).sum(axis=0)
        determined = ((votes != UN) & (votes != NO_VOTE)).sum(axis=0)
        assert ((decided != change) | ((support >= min_votes) & (2 * support > determined))).all()


@given(tallies)
def test_the_wire_keeps_small_tallies_exact_and_large_ones_in_proportion(tally: np.ndarray) -> None:
    np.testing.assert_array_equal(to_wire(tally), tally)
    big = tally * 100
    wire = to_wire(big).astype(np.float64)
    peak = big.max(axis=-1, keepdims=True)
    scale = np.where(peak > 0, wire.max(axis=-1, keepdims=True) / np.maximum(peak, 1), 0)
    assert np.abs(wire - big * scale).max() <= 1.0
