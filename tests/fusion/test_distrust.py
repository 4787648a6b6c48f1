"""Which ballots are not heard: outliers, and copies against the rule in plain words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hand_made import SHAPE, make_tile, states_plane, wall
from mapvote.config import FuseSettings
from mapvote.core.grid import Lattice
from mapvote.core.rule import SURFACES
from mapvote.core.tile import Tile
from mapvote.core.types import NO_VOTE, U8, CellState
from mapvote.fusion.distrust import borne_out, contradicts, denying
from mapvote.fusion.fuse import count, fuse_tile, hear, unspent
from mapvote.fusion.tile_vote import Vote

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


def news_of(states: U8) -> U8:
    """The same street after a block of walls came down."""
    states = states.copy()
    walls = states[:80, ::16]
    walls[walls == UO] = CE
    return states


def by_name(planes: dict[str, U8]) -> list[Vote]:
    return [Vote(name, i, f"ballot of {name}", states=states) for i, (name, states) in enumerate(planes.items())]


def named(planes: list[U8]) -> list[Vote]:
    return by_name({f"v{i}": states for i, states in enumerate(planes)})


def not_heard(votes: list[Vote], **policy: float) -> set[str]:
    heard = hear(votes, SURFACES, FuseSettings(**policy))[0]  # type: ignore[arg-type]
    return {vote.vehicle for vote in votes} - {vote.vehicle for vote in heard}


@pytest.mark.parametrize("k", [1, 2, 3])
def test_k_that_invert_everything_are_not_heard_among_k_plus_1_that_do_not(k: int) -> None:
    planes = [honest(i) for i in range(k + 1)] + [OPPOSITE[honest(99)]] * k
    assert not_heard(named(planes)) == {f"v{i}" for i in range(k + 1, 2 * k + 1)}
    assert not_heard(named(planes), max_contradiction=1.0) == set()


def test_a_liar_cannot_second_the_error_of_one_honest_vehicle() -> None:
    planes = [honest(i) for i in range(2)] + [OPPOSITE[honest(2)]]
    tile, policy = Tile.empty(Lattice().tile((0, 0))), FuseSettings(min_votes=2)
    decided, without = (fuse_tile(tile, named(some), SURFACES, policy)[0].states for some in (planes, planes[:2]))
    assert np.array_equal(decided, without)


def after_a_block_came_down(rows: int = 80) -> U8:
    states = honest(3)
    states[:rows] = news_of(states)[:rows]
    return states


@pytest.mark.parametrize(
    ("why", "planes"),
    [
        ("one saw a third of all walls come down", [honest(1), honest(2), after_a_block_came_down()]),
        ("one missed half of the changes", [news_of(honest(1)), news_of(honest(2)), after_a_block_came_down(40)]),
        ("all disagree", list(np.random.default_rng(5).integers(0, 5, (5, *SHAPE), dtype=np.uint8))),
    ],
)
def test_who_tells_news_misses_some_or_disagrees_as_all_do_is_heard(why: str, planes: list[U8]) -> None:
    assert not_heard(named(planes), min_votes=2) == set(), why


@pytest.mark.parametrize(
    ("asked", "agreed", "opposed", "named_so"),
    [
        (200, 101, 101, True),
        (200, 100, 100, False),  # half is no majority
        (64, 64, 33, True),
        (64, 64, 32, False),  # no more than half of what they agree on
        (64, 63, 63, False),  # too few
    ],
)
def test_who_opposes_most_of_what_a_majority_agrees_on_contradicts(
    asked: int, agreed: int, opposed: int, named_so: bool
) -> None:
    """By the bits of others_say: asked 1, agreed 2, opposed 4."""
    said = np.zeros((asked, 8), dtype=np.uint8)
    said[:, UO] = 1
    said[:agreed, UO] = 3
    said[:opposed, UO] = 7
    assert contradicts(np.full(asked, UO, dtype=np.uint8), said, 0.5) == named_so


@pytest.mark.parametrize("k", [1, 2, 3])
def test_who_denies_every_change_is_not_heard_and_the_quorum_is_what_it_would_be_without(k: int) -> None:
    planes = [news_of(honest(i, 0.01)) for i in range(k + 1)] + [honest(50 + i, 0.01) for i in range(k)]
    votes, policy = named(planes), FuseSettings(min_votes=k + 1)
    heard, states, _, quorum = hear(votes, SURFACES, policy)
    assert [vote.vehicle for vote in heard] == [f"v{i}" for i in range(k + 1)]
    assert quorum == 2, "one less for each, but nobody is believed alone"
    assert np.array_equal(states, count(votes[: k + 1], SURFACES, 2)[0])
    assert len(hear(votes, SURFACES, policy.model_copy(update={"max_denial": 1.0}))[0]) == 2 * k + 1


def test_three_liars_silence_no_honest_vehicle_where_few_others_look() -> None:
    """In half of the tile three who lie are the majority of those who determined anything."""
    planes = [honest(i) for i in range(4)]
    for plane in planes[1:]:
        plane[:, 64:] = NO_VOTE
    lies = [np.where(honest(9) == UO, CE, CO).astype(np.uint8)] * 3
    heard, _, _, quorum = hear(named([*planes, *lies]), SURFACES, FuseSettings(min_votes=4))
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
    votes = [Vote(f"v{i}", i * 10**9, f"v{i}", states=saw_it, new_points=offered, version=1) for i in (1, 2)]
    votes.append(Vote("v3", 3 * 10**9, "v3", states=passed, version=1))
    policy = FuseSettings(min_votes=2, min_difference=0.0)
    decision, published = fuse_tile(before, votes, SURFACES, policy, 2, lambda: votes)
    assert (decision.deleted, decision.added) == (300, 0)
    left = [unspent(vote, published) for vote in votes]
    assert fuse_tile(published, left, SURFACES, policy, 3, lambda: left)[1] is published
    again = [*votes, Vote("v3", 4 * 10**9, "v3b", states=passed, version=1)]
    left = [unspent(vote, published) for vote in again]
    assert fuse_tile(published, left, SURFACES, policy, 3, lambda: left)[1] is published, "drives are folded"


def test_who_left_cells_undetermined_denied_nothing_there_and_was_not_asked() -> None:
    decided = np.full(1000, CO, dtype=np.uint8)
    unsure, contrary = np.full(1000, UN, dtype=np.uint8), np.full(1000, UE, dtype=np.uint8)
    few = unsure.copy()
    few[:64] = UE
    found = denying(np.stack([unsure, contrary, few, decided]), decided, 0.9, np.zeros(4, dtype=np.int64))
    assert found.tolist() == [False, True, True, False]


def test_only_changes_that_count_no_more_can_have_come_true() -> None:
    tile = make_tile(wall([(10, 10)], [0.5, 1.5]))
    for at, came_true in (((10, 10), CO), ((99, 99), CE)):
        for sent in (UO, UE, CO, CE):
            spent = Vote("v", 0, "d", states=states_plane({}), unrestricted=states_plane({at: sent}))
            counts = replace(spent, states=states_plane({at: sent}))
            assert borne_out([spent, counts], tile).tolist() == [sent == came_true, 0]
