"""Copies of ballots: who counts as one vehicle, against the rule in plain words."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import SHAPE
from mapvote.config import FuseSettings
from mapvote.core.grid import Lattice
from mapvote.core.tile import Tile
from mapvote.core.types import NO_VOTE, U8, CellState
from mapvote.fusion.copies import Copy, difference, liars_among, masks_of, originals
from mapvote.fusion.fuse import decide_tile
from mapvote.fusion.tile_vote import TileVote, restrict

UO, UE, CO, CE, UN = CellState
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


def named(planes: dict[str, U8]) -> list[TileVote]:
    return [TileVote(name, i, f"ballot of {name}", states=states) for i, (name, states) in enumerate(planes.items())]


def copied(votes: list[TileVote], policy: FuseSettings = POLICY) -> dict[str, str]:
    """Who is not heard because of whom."""
    return {copy.vehicle: copy.heard_vehicle for copy in originals(votes, policy)[1]}


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


def test_two_drives_down_one_street_are_two() -> None:
    assert copied(named({f"v{i}": drive_along(i) for i in range(6)})) == {}


@pytest.mark.parametrize(("rows", "cols"), [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1)])
def test_a_copy_is_found_as_it_is_and_moved_by_a_cell_and_the_original_is_heard(rows: int, cols: int) -> None:
    planes = {"honest": drive_along(1), "other": drive_along(2), "third": drive_along(3)}
    votes = named(planes | {"copy": moved(drive_along(1), rows, cols)})
    assert copied(votes) == {"copy": "honest"}


def test_a_copy_in_which_every_cell_was_moved_at_will_is_found() -> None:
    rng, states = np.random.default_rng(9), drive_along(1)
    rows, cols = np.indices(SHAPE)
    jittered = states[
        (rows + rng.integers(-1, 2, SHAPE)).clip(0, 255), (cols + rng.integers(-1, 2, SHAPE)).clip(0, 255)
    ]
    votes = named({"copy": jittered, "honest": states, "other": drive_along(2), "third": drive_along(3)})
    assert copied(votes) == {"copy": "honest"}


def test_what_somebody_adds_to_a_copy_is_not_heard() -> None:
    lie = drive_along(1)
    lie[120:130, 100:120] = CO
    votes = named({"copy": lie, "honest": drive_along(1), "other": drive_along(2), "third": drive_along(3)})
    assert copied(votes) == {"copy": "honest"}


def test_all_copies_of_one_drive_count_as_one_vehicle() -> None:
    votes = named({f"copy{i}": drive_along(1) for i in range(3)} | {"other": drive_along(2)})
    kept, copies = originals(votes, POLICY)
    assert len(kept) == 2
    assert len({copy.heard_vehicle for copy in copies}) == 1


def test_a_vehicle_may_drive_the_same_way_twice() -> None:
    votes = [TileVote("v", i, f"{i}", states=drive_along(1)) for i in range(2)]
    assert originals([*votes, *named({"w": drive_along(2)})], POLICY)[1] == []


def test_a_vehicle_that_copies_one_drive_is_heard_by_its_other() -> None:
    votes = named({"honest": drive_along(1), "w": drive_along(2)})
    mixed = [TileVote("liar", 7, "copied", states=drive_along(1)), TileVote("liar", 8, "own", states=drive_along(5))]
    kept, copies = originals([*votes, *mixed], POLICY)
    assert [copy.digest for copy in copies] == ["copied"]
    assert {drive.digest for drive in kept} == {"ballot of honest", "ballot of w", "own"}


def test_little_says_nothing() -> None:
    few = np.full(SHAPE, NO_VOTE, dtype=np.uint8)
    few[100:110, 100:120] = UE
    assert copied(named({"a": few, "b": few, "c": few})) == {}


@pytest.mark.parametrize(("rows", "cols", "changed", "judged"), [(103, 97, 200, True), (106, 93, 199, False)])
def test_masks_are_judged_from_200_cells_on_that_three_cells_change(
    rows: int, cols: int, changed: int, judged: bool
) -> None:
    square = np.full(SHAPE, NO_VOTE, dtype=np.uint8)
    square[100 : 100 + rows, 100 : 100 + cols] = UE
    assert difference(square, square) == (0, changed)
    assert copied(named({"a": square, "b": square})) == ({"b": "a"} if judged else {})


def test_where_one_vehicle_may_change_the_map_and_where_it_is_not_asked_nobody_is_judged() -> None:
    votes = named({"a": drive_along(1), "b": drive_along(1)})
    assert copied(votes) == {"b": "a"}
    assert copied(votes, FuseSettings(min_votes=1)) == {}
    assert copied(votes, FuseSettings(min_difference=0.0)) == {}
    tallies = [TileVote(name, 0, name, tally=np.zeros((*SHAPE, 5), dtype=np.uint16)) for name in "ab"]
    assert copied(tallies) == {}


def test_a_vote_that_is_spent_in_part_is_still_the_same_ballot() -> None:
    counts = np.ones(SHAPE, dtype=np.bool_)
    counts[100:150, 50:200] = False
    honest, other, copy = named({"honest": drive_along(1), "other": drive_along(2), "copy": drive_along(1)})
    assert copied([restrict(honest, counts), other, copy]) == {"copy": "honest"}


@settings(max_examples=10, deadline=None)
@given(st.permutations(range(6)), st.integers(0, 2))
def test_the_order_of_ballots_does_not_decide_who_is_heard(order: list[int], by: int) -> None:
    votes = named({f"v{i}": drive_along(i) for i in range(4)} | {"x": moved(drive_along(0), by // 2, by % 2)})
    votes.append(TileVote("y", 9, "ballot of y", states=drive_along(3)))
    tile = Tile.empty(Lattice().tile((0, 0)))
    one, other = (decide_tile(tile, given, "columns", POLICY) for given in (votes, [votes[i] for i in order]))
    assert one.copies == other.copies
    assert {copy.vehicle for copy in one.copies} == {"x", "y"}
    assert np.array_equal(one.states, other.states)


def test_the_history_is_without_copies_whether_it_holds_the_same_drives_or_more() -> None:
    votes = named({f"v{i}": drive_along(i) for i in range(3)} | {"copy": drive_along(0)})
    tile = Tile.empty(Lattice().tile((0, 0)))
    for history in (votes, [*votes, *named({"w": drive_along(4), "x": drive_along(4)})]):
        heard = decide_tile(tile, votes, "columns", POLICY, partial(list, history))
        assert heard.past is not None
        assert [v.digest for v in heard.past()] == [v.digest for v in originals(history, POLICY)[0]]


@pytest.mark.parametrize(("k", "quorum"), [(1, 2), (2, 2), (3, 2)])
def test_the_quorum_falls_by_those_who_lie_for_sure(k: int, quorum: int) -> None:
    """k send the first vehicle's ballot: of the k + 1 that are alike one is honest, and may be one not heard."""
    votes = named({f"v{i}": drive_along(i) for i in range(k + 1)} | {f"x{i}": drive_along(0) for i in range(k)})
    heard = decide_tile(Tile.empty(Lattice().tile((0, 0))), votes, "columns", FuseSettings(min_votes=k + 1))
    assert (len(heard.votes), heard.quorum) == (k + 1, quorum)


def test_of_two_that_are_alike_nobody_lies_for_sure_but_of_three_one_does() -> None:
    copies = [Copy("a", "1", "x", "10"), Copy("b", "2", "y", "20"), Copy("c", "3", "y", "20")]
    assert liars_among(copies, named({"x": drive_along(0), "y": drive_along(1)})) == 1
    assert liars_among(copies, named({"c": drive_along(0)})) == 0, "who is heard by another drive is not silenced"


def test_masks_with_more_holes_than_ground_say_nothing() -> None:
    """Within a cell of every cell there is a hole and none: any two such masks are alike."""
    speckled = [np.where(np.random.default_rng(i).random(SHAPE) < 0.5, UE, UN).astype(np.uint8) for i in range(3)]
    assert copied(named({f"v{i}": states for i, states in enumerate(speckled)})) == {}


def test_a_mask_is_the_determined_cells_the_first_column_in_the_lowest_bit() -> None:
    rng = np.random.default_rng(1)
    planes = rng.choice([0, 1, 2, 3, 4, NO_VOTE], (3, *SHAPE)).astype(np.uint8)
    bits = np.packbits(planes < CellState.UNDETERMINED, axis=-1, bitorder="little")
    np.testing.assert_array_equal(masks_of(planes), bits.view("<u8"))
