"""Who is not heard: a vehicle that says the opposite of the others nearly everywhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import SHAPE, make_tile, states_plane, wall
from mapvote.config import FuseSettings
from mapvote.core.grid import Lattice
from mapvote.core.tile import Tile
from mapvote.core.types import NO_VOTE, U8, CellState
from mapvote.fusion.fuse import count, fuse_tile, hear
from mapvote.fusion.outliers import borne_out, denying
from mapvote.fusion.spent import unspent
from mapvote.fusion.tile_vote import TileVote

UO, UE, CO, CE, UN = CellState
OPPOSITE = np.array([CE, CO, UE, UO, UN], dtype=np.uint8)


def honest(seed: int, errors: float = 0.03) -> U8:
    """A street of walls and road as one vehicle sees it: a tenth not determined, some per cent wrong."""
    street = np.where(np.arange(SHAPE[1]) % 16 == 0, UO, UE).astype(np.uint8)
    states = np.broadcast_to(street, SHAPE).copy()
    chance = np.random.default_rng(seed).uniform(size=SHAPE)
    states[chance < 0.1] = UN
    wrong = chance > 1.0 - errors
    states[wrong] = OPPOSITE[states[wrong]]
    return states


def named(planes: list[U8]) -> list[TileVote]:
    return [TileVote(f"v{i}", 0, f"v{i}", states=states) for i, states in enumerate(planes)]


def silenced(votes: list[TileVote], **policy: float) -> set[str]:
    heard = hear(votes, "columns", FuseSettings(**policy))[0]  # type: ignore[arg-type]
    return {vote.vehicle for vote in votes} - {vote.vehicle for vote in heard}


@pytest.mark.parametrize("k", [1, 2, 3])
def test_k_that_invert_everything_are_not_heard_among_k_plus_1_that_do_not(k: int) -> None:
    planes = [honest(i) for i in range(k + 1)] + [OPPOSITE[honest(99)]] * k
    assert silenced(named(planes)) == {f"v{i}" for i in range(k + 1, 2 * k + 1)}
    assert silenced(named(planes), max_contradiction=1.0) == set()


def test_a_liar_cannot_second_the_error_of_one_honest_vehicle() -> None:
    planes = [honest(i) for i in range(2)] + [OPPOSITE[honest(2)]]
    tile, policy = Tile.empty(Lattice().tile((0, 0))), FuseSettings(min_votes=2)
    decided = fuse_tile(tile, named(planes), "columns", policy)[0].states
    without = fuse_tile(tile, named(planes[:2]), "columns", policy)[0].states
    assert np.array_equal(decided, without)


def test_a_vehicle_that_saw_a_block_come_down_is_heard() -> None:
    news = honest(3)
    news[:80, ::16] = CE  # a third of all walls are gone
    assert silenced(named([honest(1), honest(2), news])) == set()


def test_vehicles_that_disagree_with_each_other_silence_nobody() -> None:
    rng = np.random.default_rng(5)
    assert silenced(named([rng.integers(0, 5, SHAPE, dtype=np.uint8) for _ in range(5)])) == set()


def test_two_vehicles_alone_are_both_heard() -> None:
    assert silenced(named([honest(1), OPPOSITE[honest(2)]])) == set()


def test_a_few_cells_say_nothing_about_a_vehicle() -> None:
    def only(states: U8) -> U8:
        few = np.full(SHAPE, NO_VOTE, dtype=np.uint8)
        few[:20, :20] = states[:20, :20]
        return few

    planes = [honest(1), honest(2), only(OPPOSITE[honest(3)])]
    assert silenced(named(planes)) == set()


@settings(max_examples=10, deadline=None)
@given(st.permutations(range(5)))
def test_the_order_of_ballots_does_not_decide_who_is_heard(order: list[int]) -> None:
    votes = named([honest(1), honest(2), OPPOSITE[honest(3)], honest(4, errors=0.3), OPPOSITE[honest(5)]])
    assert silenced([votes[i] for i in order]) == silenced(votes)


def news_of(states: U8) -> U8:
    """The same street after a block of walls came down."""
    states = states.copy()
    walls = states[:80, ::16]
    walls[walls == UO] = CE
    return states


@pytest.mark.parametrize("k", [1, 2, 3])
def test_who_denies_every_change_is_not_heard_and_the_quorum_is_what_it_would_be_without(k: int) -> None:
    planes = [news_of(honest(i, 0.01)) for i in range(k + 1)] + [honest(50 + i, 0.01) for i in range(k)]
    votes, policy = named(planes), FuseSettings(min_votes=k + 1)
    heard, states, _, quorum = hear(votes, "columns", policy)
    assert [vote.vehicle for vote in heard] == [f"v{i}" for i in range(k + 1)]
    assert quorum == 2, "one less for each, but nobody is believed alone"
    assert np.array_equal(states, count(votes[: k + 1], "columns", 2)[0])
    assert len(hear(votes, "columns", policy.model_copy(update={"max_denial": 1.0}))[0]) == 2 * k + 1


def test_who_missed_half_of_the_changes_is_heard() -> None:
    half = honest(3)
    half[:40] = news_of(half)[:40]
    votes = named([news_of(honest(1)), news_of(honest(2)), half])
    assert len(hear(votes, "columns", FuseSettings(min_votes=2))[0]) == 3


def test_three_liars_silence_no_honest_vehicle_where_few_others_look() -> None:
    """In half of the tile three who lie are the majority of those who determined anything."""
    planes = [honest(i) for i in range(4)]
    for plane in planes[1:]:
        plane[:, 64:] = NO_VOTE
    lies = [np.where(honest(9) == UO, CE, CO).astype(np.uint8)] * 3
    heard, _, _, quorum = hear(named([*planes, *lies]), "columns", FuseSettings(min_votes=4))
    assert {f"v{i}" for i in range(4)} <= {vote.vehicle for vote in heard}
    assert quorum == max(2, 4 - (7 - len(heard)))


def test_what_waits_for_the_last_who_looked_still_waits_when_all_else_is_published() -> None:
    """A house fell, a car came, and left before the third passed. Once the house is gone from the map, the car is all
    that is left to deny: that makes no denier of the third."""
    house, car = [(r, 40) for r in range(100, 200)], [(r, c) for r in range(50, 60) for c in range(60, 68)]
    before = make_tile(wall(house, [0.45, 0.75, 1.05]))
    passed = states_plane(dict.fromkeys(house, CE) | dict.fromkeys(car, UE))
    saw_it = states_plane(dict.fromkeys(house, CE) | dict.fromkeys(car, CO))
    offered = wall(car, [0.45, 0.75])
    votes = [TileVote(f"v{i}", i * 10**9, f"v{i}", states=saw_it, new_points=offered, version=1) for i in (1, 2)]
    votes.append(TileVote("v3", 3 * 10**9, "v3", states=passed, version=1))
    policy = FuseSettings(min_votes=2, min_difference=0.0)
    decision, published = fuse_tile(before, votes, "columns", policy, 2, lambda: votes)
    assert (decision.deleted, decision.added) == (300, 0)
    left = [unspent(vote, published) for vote in votes]
    assert fuse_tile(published, left, "columns", policy, 3, lambda: left)[1] is published
    again = [*votes, TileVote("v3", 4 * 10**9, "v3b", states=passed, version=1)]
    left = [unspent(vote, published) for vote in again]
    assert fuse_tile(published, left, "columns", policy, 3, lambda: left)[1] is published, "drives are folded"


def test_who_left_cells_undetermined_denied_nothing_there_and_was_not_asked() -> None:
    decided = np.full(1000, CO, dtype=np.uint8)
    unsure, contrary = np.full(1000, UN, dtype=np.uint8), np.full(1000, UE, dtype=np.uint8)
    few = unsure.copy()
    few[:64] = UE
    found = denying(np.stack([unsure, contrary, few, decided]), decided, 0.9, np.zeros(4, dtype=np.int64))
    assert found.tolist() == [False, True, True, False]


def test_only_changes_that_count_no_more_can_have_come_true() -> None:
    tile = make_tile(wall([(10, 10)], [0.5, 1.5]))
    stands = (10, 10)
    silent = states_plane({})
    for sent, expected in ((CO, 1), (CE, 0), (UO, 0), (UE, 0)):
        spent = TileVote("v", 0, "d", states=silent, unrestricted=states_plane({stands: sent}))
        assert borne_out([spent], tile).tolist() == [expected]
    for sent, expected in ((CO, 0), (CE, 1), (UO, 0), (UE, 0)):
        spent = TileVote("v", 0, "d", states=silent, unrestricted=states_plane({(99, 99): sent}))
        assert borne_out([spent], tile).tolist() == [expected]
    counts = TileVote("v", 0, "d", states=states_plane({stands: CO}), unrestricted=states_plane({stands: CO}))
    assert borne_out([counts], tile).tolist() == [0]
