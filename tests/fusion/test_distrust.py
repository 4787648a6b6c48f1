"""Which ballots are not heard: outliers, and copies against the rule in plain words."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import SHAPE, make_tile, states_plane, wall
from mapvote.config import FuseSettings
from mapvote.core.grid import Lattice
from mapvote.core.rule import SURFACES
from mapvote.core.tile import Tile
from mapvote.core.types import NO_VOTE, U8, CellState
from mapvote.fusion import distrust
from mapvote.fusion.distrust import Copy, borne_out, contradicts, denying, liars_among, masks_of, originals
from mapvote.fusion.fuse import count, decide_tile, fuse_tile, hear, unspent
from mapvote.fusion.tile_vote import TileVote, silenced

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


def by_name(planes: dict[str, U8]) -> list[TileVote]:
    return [TileVote(name, i, f"ballot of {name}", states=states) for i, (name, states) in enumerate(planes.items())]


def named(planes: list[U8]) -> list[TileVote]:
    return by_name({f"v{i}": states for i, states in enumerate(planes)})


def not_heard(votes: list[TileVote], **policy: float) -> set[str]:
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
    votes = [TileVote(f"v{i}", i * 10**9, f"v{i}", states=saw_it, new_points=offered, version=1) for i in (1, 2)]
    votes.append(TileVote("v3", 3 * 10**9, "v3", states=passed, version=1))
    policy = FuseSettings(min_votes=2, min_difference=0.0)
    decision, published = fuse_tile(before, votes, SURFACES, policy, 2, lambda: votes)
    assert (decision.deleted, decision.added) == (300, 0)
    left = [unspent(vote, published) for vote in votes]
    assert fuse_tile(published, left, SURFACES, policy, 3, lambda: left)[1] is published
    again = [*votes, TileVote("v3", 4 * 10**9, "v3b", states=passed, version=1)]
    left = [unspent(vote, published) for vote in again]
    assert fuse_tile(published, left, SURFACES, policy, 3, lambda: left)[1] is published, "drives are folded"


def test_who_left_cells_undetermined_denied_nothing_there_and_was_not_asked() -> None:
    decided = np.full(1000, CO, dtype=np.uint8)
    unsure, contrary = np.full(1000, UN, dtype=np.uint8), np.full(1000, UE, dtype=np.uint8)
    few = unsure.copy()
    few[:64] = UE
    found = denying(np.stack([unsure, contrary, few, decided]), decided, 0.9, np.zeros(4, dtype=np.int64))
    assert found.tolist() == [False, True, True, False]


POLICY = FuseSettings(min_votes=2)


def drive_along(seed: int) -> U8:
    """A corridor whose borders wander as they will, a wall in it, and holes where something stood in the way."""
    rng = np.random.default_rng(seed)
    reach = rng.integers(-5, 6, (2, SHAPE[1])).cumsum(axis=1).clip(-14, 14)
    rows = np.arange(SHAPE[0])[:, None]
    seen = (rows >= 80 + reach[0]) & (rows <= 180 + reach[1])
    states = np.where(seen, UE, NO_VOTE).astype(np.uint8)
    states[90:92][seen[90:92]] = UO
    for row, col in rng.integers(80, 170, (6, 2)):
        states[row : row + 6, col : col + 9] = UN
    return states


def moved(states: U8, rows: int, cols: int) -> U8:
    out = np.full_like(states, NO_VOTE)
    to = tuple(slice(max(by, 0), size + min(by, 0)) for by, size in zip((rows, cols), SHAPE, strict=True))
    of = tuple(slice(max(-by, 0), size + min(-by, 0)) for by, size in zip((rows, cols), SHAPE, strict=True))
    out[to] = states[of]
    return out


def copied(votes: list[TileVote], policy: FuseSettings = POLICY) -> dict[str, str]:
    """Who is not heard because of whom."""
    return {copy.vehicle: copy.heard_vehicle for copy in originals(votes, policy)[1]}


def difference(a: U8, b: U8) -> tuple[int, int]:
    """(cells in which two masks differ, in how many the lesser would differ from itself if shifted)."""
    moved, looked = distrust._look(masks_of([a, b]))
    return int(distrust._differing(looked[0], looked[1], distrust._RIM, 256**2)), int(moved.min())


def differs(a: U8, b: U8, first: int = 1, rim: int = 1) -> int:
    """The rule, cell by cell, in every third row."""
    set_a, set_b, count = a < UN, b < UN, 0
    for r in range(first, 255, 3):
        for c in range(rim, 256 - rim):
            near = slice(r - 1, r + 2), slice(c - 1, c + 2)
            count += bool((set_b[near] != set_a[r, c]).all() or (set_a[near] != set_b[r, c]).all())
    return count


def test_the_difference_of_two_masks_is_that_of_the_rule_in_plain_words() -> None:
    a, b = drive_along(1), drive_along(2)
    b[np.random.default_rng(3).random(SHAPE) < 0.01] = UN
    by_three_cells = [
        (differs(one, moved(one, 3, 0), first=4) + differs(one, moved(one, 0, 3), rim=4)) // 2 for one in (a, b)
    ]
    assert difference(a, b) == (differs(a, b), min(by_three_cells))


def scattered(states: U8) -> U8:
    """Every cell of it moved by one, at will."""
    rng, at = np.random.default_rng(9), np.indices(SHAPE)
    return np.asarray(states[tuple((at + rng.integers(-1, 2, (2, *SHAPE))).clip(0, 255))])


def without_a_hole(states: U8, row: int, state: int) -> U8:
    """A hole that is a row wider is too little for the masks to differ."""
    states = states.copy()
    states[99:101, 60:200], states[row, 60:200] = UN, state
    return states


def with_a_lie(states: U8) -> U8:
    return np.where((np.indices(SHAPE)[0] // 10 == 12) & (np.indices(SHAPE)[1] // 20 == 5), CO, states).astype(np.uint8)


@pytest.mark.parametrize(
    ("copy", "original"),
    [
        *((moved(drive_along(1), r, c), drive_along(1)) for r in (-1, 0, 1) for c in (-1, 0, 1) if r or c),
        (scattered(drive_along(1)), drive_along(1)),
        (with_a_lie(drive_along(1)), drive_along(1)),
        (without_a_hole(drive_along(1), 100, CO), without_a_hole(drive_along(1), 100, UN)),
    ],
)
def test_of_a_copy_however_moved_or_added_to_and_its_original_the_original_is_heard(copy: U8, original: U8) -> None:
    """It opposes others least: who says most is not heard for that."""
    votes = by_name({"copy": copy, "honest": original, "other": drive_along(2), "third": drive_along(3)})
    assert copied(votes) == {"copy": "honest"}


def test_several_drives_down_one_street_of_one_vehicle_or_with_more_holes_than_ground_are_no_copies() -> None:
    """Within a cell of every cell of such masks there is a hole and none: any two are alike."""
    assert copied(named([drive_along(i) for i in range(6)])) == {}
    votes = [TileVote("v", i, f"{i}", states=drive_along(1)) for i in range(2)]
    assert copied([*votes, *by_name({"w": drive_along(2)})]) == {}
    speckled = [np.where(np.random.default_rng(i).random(SHAPE) < 0.5, UE, UN).astype(np.uint8) for i in range(3)]
    assert copied(named(speckled)) == {}


def test_a_vehicle_that_copies_one_drive_is_heard_by_its_other() -> None:
    votes = by_name({"honest": drive_along(1), "w": drive_along(2)})
    mixed = [TileVote("liar", 7, "copied", states=drive_along(1)), TileVote("liar", 8, "own", states=drive_along(5))]
    kept, copies = originals([*votes, *mixed], POLICY)
    assert [copy.digest for copy in copies] == ["copied"]
    assert {drive.digest for drive in kept} == {"ballot of honest", "ballot of w", "own"}


@pytest.mark.parametrize(("rows", "cols", "changed", "judged"), [(103, 97, 200, True), (106, 93, 199, False)])
def test_masks_are_judged_from_200_cells_on_that_three_cells_change(
    rows: int, cols: int, changed: int, judged: bool
) -> None:
    square = np.full(SHAPE, NO_VOTE, dtype=np.uint8)
    square[100 : 100 + rows, 100 : 100 + cols] = UE
    assert difference(square, square) == (0, changed)
    assert copied(by_name({"a": square, "b": square})) == ({"b": "a"} if judged else {})


def test_where_one_vehicle_may_change_the_map_and_where_it_is_not_asked_nobody_is_judged() -> None:
    votes = by_name({"a": drive_along(1), "b": drive_along(1)})
    assert copied(votes) == {"b": "a"}
    assert copied(votes, FuseSettings(min_votes=1)) == {}
    assert copied(votes, FuseSettings(min_difference=0.0)) == {}
    tallies = [TileVote(name, 0, name, tally=np.zeros((*SHAPE, 5), dtype=np.uint16)) for name in "ab"]
    assert copied(tallies) == {}


def test_a_vote_that_is_spent_in_part_is_still_the_same_ballot() -> None:
    spent = np.zeros(SHAPE, dtype=np.bool_)
    spent[100:150, 50:200] = True
    honest, other, copy = by_name({"honest": drive_along(1), "other": drive_along(2), "copy": drive_along(1)})
    assert copied([silenced(honest, np.flatnonzero(spent)), other, copy]) == {"copy": "honest"}


@settings(max_examples=10, deadline=None)
@given(st.permutations(range(6)), st.integers(0, 2))
def test_the_order_of_ballots_does_not_decide_which_of_copies_is_heard(order: list[int], by: int) -> None:
    votes = by_name({f"v{i}": drive_along(i) for i in range(4)} | {"x": moved(drive_along(0), by // 2, by % 2)})
    votes.append(TileVote("y", 9, "ballot of y", states=drive_along(3)))
    tile = Tile.empty(Lattice().tile((0, 0)))
    one, other = (decide_tile(tile, given, SURFACES, POLICY) for given in (votes, [votes[i] for i in order]))
    assert one.copies == other.copies
    assert {copy.vehicle for copy in one.copies} == {"x", "y"}
    assert np.array_equal(one.states, other.states)


def test_the_history_is_without_copies_whether_it_holds_the_same_drives_or_more() -> None:
    votes = by_name({f"v{i}": drive_along(i) for i in range(3)} | {"copy": drive_along(0)})
    tile = Tile.empty(Lattice().tile((0, 0)))
    for history in (votes, [*votes, *by_name({"w": drive_along(4), "x": drive_along(4)})]):
        heard = decide_tile(tile, votes, SURFACES, POLICY, partial(list, history))
        assert heard.past is not None
        assert [v.digest for v in heard.past()] == [v.digest for v in originals(history, POLICY)[0]]


@pytest.mark.parametrize("k", [1, 2, 3])
def test_the_quorum_falls_by_those_who_lie_for_sure(k: int) -> None:
    """k send the first vehicle's ballot: of the k + 1 that are alike one is honest, and may be one not heard."""
    votes = by_name({f"v{i}": drive_along(i) for i in range(k + 1)} | {f"x{i}": drive_along(0) for i in range(k)})
    heard = decide_tile(Tile.empty(Lattice().tile((0, 0))), votes, SURFACES, FuseSettings(min_votes=k + 1))
    assert (len(heard.votes), heard.quorum) == (k + 1, 2)


def test_only_changes_that_count_no_more_can_have_come_true() -> None:
    tile = make_tile(wall([(10, 10)], [0.5, 1.5]))
    for at, came_true in (((10, 10), CO), ((99, 99), CE)):
        for sent in (UO, UE, CO, CE):
            spent = TileVote("v", 0, "d", states=states_plane({}), unrestricted=states_plane({at: sent}))
            counts = replace(spent, states=states_plane({at: sent}))
            assert borne_out([spent, counts], tile).tolist() == [sent == came_true, 0]


def test_of_two_that_are_alike_nobody_lies_for_sure_but_of_three_one_does() -> None:
    copies = [Copy("a", "1", "x", "10"), Copy("b", "2", "y", "20"), Copy("c", "3", "y", "20")]
    assert liars_among(copies, by_name({"x": drive_along(0), "y": drive_along(1)})) == 1
    assert liars_among(copies, by_name({"c": drive_along(0)})) == 0, "who is heard by another drive is not silenced"
