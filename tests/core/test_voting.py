"""The voting rule: paper III-B and IV, Equation (1), Table I; the kernels against the rule in plain words."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapvote.core.types import N_STATES, NO_VOTE, CellState
from mapvote.core.voting import (
    VOTE_UNIT,
    add_tally,
    cast,
    decide_cells,
    one_hot,
    plurality,
    tally_of,
    to_wire,
    vote_weight,
    weight_table,
)

UO, UE, CO, CE, UN = (int(state) for state in CellState)
states_grids = arrays(np.uint8, (4, 5), elements=st.sampled_from([*range(N_STATES), NO_VOTE]))
tallies = arrays(np.int32, (3, 4, N_STATES), elements=st.integers(0, 10_000))

TABLE_I = np.array([[0, 0, 25, 0, 20], [0, 0, 25, 0, 20], [5, 0, 18, 0, 22]])
"""Scans per class of the three vehicles (paper Table I), in the order of CellState."""


@pytest.mark.parametrize(("n", "exact"), [(5, 2.0), (6, 3 - math.exp(-0.5)), (10, 3 - math.exp(-2.5)), (50, 3.0)])
def test_equation_1(n: int, exact: float) -> None:
    assert float(vote_weight(n)) == pytest.approx(exact, abs=1e-9)
    assert weight_table(True, 2.0, 3.0, 0.5, 5)[n] == pytest.approx(exact * VOTE_UNIT, abs=0.5)


def test_table_i_vehicles_as_printed_by_plain_plurality_of_scans() -> None:
    assert plurality(TABLE_I.astype(np.int32)).tolist() == [CO, CO, UN]


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


few_votes = st.lists(st.integers(0, 3), min_size=N_STATES, max_size=N_STATES)


def winner(votes: list[int], abstain: bool) -> int:
    """Most votes win, two firsts are undetermined, no votes are no vote; who abstains does not compete."""
    standing = {state: n for state, n in enumerate(votes) if n and not (abstain and state == UN)}
    if not standing:
        return UN if votes[UN] else NO_VOTE
    most = max(standing.values())
    first = [state for state, n in standing.items() if n == most]
    if len(first) > 1:
        return UN
    if abstain and first[0] in (CO, CE) and 2 * most <= sum(votes[:UN]):
        return UN
    return first[0]


@given(few_votes)
def test_a_plain_majority_decides_if_undetermined_competes(votes: list[int]) -> None:
    assert int(plurality(np.array(votes, dtype=np.int32))) == winner(votes, abstain=False)


@given(few_votes, st.integers(1, 4))
def test_a_change_needs_more_than_half_of_the_others_and_a_quorum_if_undetermined_abstains(
    votes: list[int], quorum: int
) -> None:
    expected = winner(votes, abstain=True)
    if expected in (CO, CE) and votes[expected] < quorum:
        expected = UN
    tally = np.array(votes, dtype=np.int32)[:, None] * VOTE_UNIT
    assert decide_cells(tally, tally, True, quorum * VOTE_UNIT).tolist() == [expected]


@pytest.mark.parametrize("voters", [0, 1, 15, 16, 255, 256, 600])
def test_votes_counted_in_bytes_are_the_votes_counted_one_by_one(voters: int) -> None:
    """More voters than a byte counts, and more cells than are counted at once."""
    rng = np.random.default_rng(voters)
    states = rng.choice([UO, UE, CO, CE, UN, NO_VOTE], (voters, 5000)).astype(np.uint8)
    tally = tally_of(list(states), 5000)
    expected = VOTE_UNIT * np.stack([(states == state).sum(axis=0) for state in range(N_STATES)])
    np.testing.assert_array_equal(tally, expected)


@given(st.lists(few_votes, min_size=1, max_size=5))
def test_in_one_stage_the_sums_decide_and_a_vehicle_backs_what_it_alone_would_decide(
    says: list[list[int]],
) -> None:
    tally, backers = np.zeros((N_STATES, 1), dtype=np.int32), np.zeros((N_STATES, 1), dtype=np.int32)
    for votes in says:
        add_tally(np.array(votes, dtype=np.uint16).reshape(N_STATES, 1), True, tally, backers)
    heard = [votes for votes in says if any(votes)]
    assert tally.ravel().tolist() == np.sum([[0] * N_STATES, *heard], axis=0).tolist()
    alone = Counter(winner(votes, abstain=True) for votes in heard)
    assert backers.ravel().tolist() == [alone[state] for state in range(N_STATES)]


@given(st.sampled_from([UO, UE, CO, CE, UN, NO_VOTE]))
def test_a_vote_is_one_unit_of_its_class_and_silence_none(state: int) -> None:
    tally = one_hot(np.array([state], dtype=np.uint8))[0]
    assert tally.tolist() == [VOTE_UNIT if state == own else 0 for own in range(N_STATES)]


def test_the_table_of_weights_goes_up_to_its_last_entry_and_without_weights_a_scan_is_one_vote() -> None:
    table = weight_table(True, 2.0, 3.0, 0.5, 5)
    assert (table.shape, weight_table(True, 2.0, 3.0, 0.5, 5, 7).shape) == ((257,), (8,))
    assert table[256] == 3 * VOTE_UNIT
    assert table.tolist() == sorted(table.tolist())
    assert weight_table(False, 2.0, 3.0, 0.5, 5).tolist()[3:7] == [0, 0, VOTE_UNIT, VOTE_UNIT]


@settings(max_examples=40)
@given(st.integers(0, 60), st.floats(0.5, 3.0), st.floats(0.1, 2.0), st.floats(0.1, 1.0), st.integers(1, 9))
def test_the_weight_begins_at_a_and_never_reaches_b(n: int, a: float, more: float, k: float, n_min: int) -> None:
    weight = float(vote_weight(n, a, a + more, k, n_min))
    if n < n_min:
        assert weight == 0.0
    else:
        assert a - 1e-12 <= weight <= a + more
        assert n > n_min or weight == pytest.approx(a)


@given(tallies)
def test_on_the_wire_what_fits_16_bits_is_exact_and_what_does_not_keeps_its_proportions(tally: np.ndarray) -> None:
    np.testing.assert_array_equal(to_wire(tally), tally)
    big = tally * 100
    wire = to_wire(big).astype(np.float64)
    peak = big.max(axis=-1, keepdims=True)
    scale = np.where(peak > 0, wire.max(axis=-1, keepdims=True) / np.maximum(peak, 1), 0)
    assert np.abs(wire - big * scale).max() <= 1.0
    edge = np.array([[65535, 3, 0, 0, 1], [65536, 4, 0, 0, 1], [131070, 4, 0, 0, 2], [131072, 8, 0, 0, 3]], np.int32)
    halves = [[65535, 3, 0, 0, 1], [32768, 2, 0, 0, 0], [65535, 2, 0, 0, 1], [32768, 2, 0, 0, 0]]
    assert to_wire(edge).tolist() == halves
