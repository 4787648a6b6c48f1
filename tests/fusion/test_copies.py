"""Copies of one recorded drive are one vehicle: the rule in plain words, and what a copier may do to hide it."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from hand_made import SHAPE
from mapvote.codec.planes import Words
from mapvote.config import FuseSettings
from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.core.rule import SURFACES
from mapvote.core.tile import Tile
from mapvote.core.types import F32, NO_VOTE, U8, CellState
from mapvote.fusion import copies
from mapvote.fusion.copies import (
    RULE,
    Copy,
    free_marks,
    liars_among,
    masks_of,
    originals,
    point_marks,
    smoothed,
)
from mapvote.fusion.fuse import decide_tile
from mapvote.fusion.tile_vote import Vote, silenced

UO, UE, CO, CE, UN = CellState
SQUARE = np.ones((3, 3), dtype=np.bool_)


def by_name(planes: dict[str, U8]) -> list[Vote]:
    return [Vote(name, i, f"ballot of {name}", states=plane) for i, (name, plane) in enumerate(planes.items())]


def named(planes: list[U8]) -> list[Vote]:
    return by_name({f"v{i}": plane for i, plane in enumerate(planes)})


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


def copied(votes: list[Vote], policy: FuseSettings = POLICY) -> dict[str, str]:
    """Who is not heard because of whom."""
    return {copy.vehicle: copy.heard_vehicle for copy in originals(votes, policy)[1]}


def difference(a: U8, b: U8) -> tuple[int, int]:
    """(cells in which two masks differ, in how many the lesser would differ from itself if shifted)."""
    moved, looked = copies._look(smoothed(masks_of([a, b])))
    return int(copies._differing(looked[0], looked[1], copies._RIM, 256**2)), int(moved.min())


def smooth_set(states: U8) -> U8:
    """The cells determined, closed and opened; beyond the tile the mask goes on as it ends."""
    closed = ndimage.binary_erosion(ndimage.binary_dilation(states < UN, SQUARE), SQUARE, border_value=1)
    opened = ndimage.binary_dilation(ndimage.binary_erosion(closed, SQUARE, border_value=1), SQUARE)
    return np.where(opened, np.uint8(UE), np.uint8(NO_VOTE))


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
    a, b = smooth_set(a), smooth_set(b)
    by_three_cells = [
        (differs(one, moved(one, 3, 0), first=4) + differs(one, moved(one, 0, 3), rim=4)) // 2 for one in (a, b)
    ]
    assert difference(a, b) == (differs(a, b), min(by_three_cells))


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.02, 0.3, 0.7, 0.98]))
@settings(max_examples=20, deadline=None)
def test_masks_are_closed_and_opened_as_scipy_does(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    states = np.where(rng.random(SHAPE) < share, np.uint8(UE), np.uint8(UN))
    found = smoothed(masks_of([states]))[0]
    bits = np.unpackbits(found.view(np.uint8), axis=1, bitorder="little").astype(np.bool_)
    assert np.array_equal(bits, smooth_set(states) == UE)


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
    votes = [Vote("v", i, f"{i}", states=drive_along(1)) for i in range(2)]
    assert copied([*votes, *by_name({"w": drive_along(2)})]) == {}
    speckled = [np.where(np.random.default_rng(i).random(SHAPE) < 0.5, UE, UN).astype(np.uint8) for i in range(3)]
    assert copied(named(speckled)) == {}


def test_a_vehicle_that_copies_one_drive_is_heard_by_its_other() -> None:
    votes = by_name({"honest": drive_along(1), "w": drive_along(2)})
    mixed = [Vote("liar", 7, "copied", states=drive_along(1)), Vote("liar", 8, "own", states=drive_along(5))]
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
    tallies = [Vote(name, 0, name, tally=np.zeros((*SHAPE, 5), dtype=np.uint16)) for name in "ab"]
    assert copied(tallies) == {}


def test_a_vote_that_is_spent_in_part_is_still_the_same_ballot() -> None:
    spent = np.zeros(SHAPE, dtype=np.bool_)
    spent[100:150, 50:200] = True
    honest, other, copy = by_name({"honest": drive_along(1), "other": drive_along(2), "copy": drive_along(1)})
    assert copied([silenced(honest, np.flatnonzero(spent)), other, copy]) == {"copy": "honest"}


def salted(states: U8, holes: float, islands: float, seed: int = 1) -> U8:
    """Cells at random: undetermined where the drive determined them, and determined where it did not."""
    rng = np.random.default_rng(seed)
    out = np.where((states < UN) & (rng.random(SHAPE) < holes), np.uint8(UN), states)
    return np.where((states >= UN) & (rng.random(SHAPE) < islands), np.uint8(UE), out)


@pytest.mark.parametrize(("holes", "islands"), [(0.005, 0.0), (0.005, 0.005), (0.02, 0.02), (0.1, 0.0)])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_salt_hides_no_copy_and_makes_none_of_honest_drives(holes: float, islands: float, seed: int) -> None:
    votes = named([salted(drive_along(i), holes, islands, seed + i) for i in range(4)])
    copy = Vote("copy", 9, "copy", states=salted(drive_along(0), holes, islands, seed + 9))
    assert copied(votes) == {}
    assert set(copied([*votes, copy]).items()) & {("copy", "v0"), ("v0", "copy")}


def surfaces(seed: int, columns: int = 60) -> F32:
    """Points of a wall, five above each other, as one drive measures them."""
    rng = np.random.default_rng(seed)
    x, z = (part.reshape(-1) for part in np.meshgrid(np.arange(columns) * 0.3 + 10.15, np.arange(5) * 0.3 + 0.65))
    return (np.column_stack([x, np.full(len(x), 30.15), z]) + rng.normal(0.0, 0.02, (len(x), 3))).astype(np.float32)


def rays(seed: int) -> Words:
    """Free words above a strip of road, as one drive passes them."""
    rng = np.random.default_rng(seed)
    cells = (np.arange(100, 120)[:, None] * 256 + np.arange(40, 80)).reshape(-1)
    return Words(cells, rng.integers(1, 2**20, len(cells)).astype(np.uint64))


@pytest.mark.parametrize("cells_moved", [0, 1, 7])
def test_drives_that_share_points_are_one_wherever_they_lie_and_those_of_one_wall_are_two(cells_moved: int) -> None:
    """Their outlines differ: the copier thinned and cut the recording, or merged it with a drive of its own."""
    away = np.array([cells_moved * CELL_SIZE, -cells_moved * CELL_SIZE, 0.0])
    half = surfaces(1)[surfaces(1)[:, 0] < 19.0]
    own = surfaces(3)[surfaces(3)[:, 0] > 22.0]
    merged = np.concatenate([half + away, own]).astype(np.float32)
    one, other, copy = (
        Vote(name, i, name, states=drive_along(i), new_points=points)
        for i, (name, points) in enumerate((("one", surfaces(1)), ("other", surfaces(2)), ("copy", merged)))
    )
    assert originals([one, other], POLICY)[1] == []
    assert len(originals([one, other, copy], POLICY)[1]) == 1
    assert len(point_marks(one, RULE.least_shared)) >= RULE.least_shared


def test_drives_that_share_free_space_are_one_and_those_over_one_road_are_two() -> None:
    thinned = Words(rays(1).cells[200:], rays(1).words[200:])
    one, other, copy = (
        Vote(name, i, name, states=drive_along(i), free=free)
        for i, (name, free) in enumerate((("one", rays(1)), ("other", rays(2)), ("copy", thinned)))
    )
    assert originals([one, other], POLICY)[1] == []
    assert len(originals([one, other, copy], POLICY)[1]) == 1


def test_free_space_that_is_the_same_everywhere_marks_no_drive() -> None:
    even = Words(rays(1).cells, np.full(len(rays(1).cells), 0b1111, dtype=np.uint64))
    assert len(free_marks(Vote("v", 0, "d", free=even), 2)) == 0
    stripes = Words(even.cells, np.where(even.cells % 2, np.uint64(3), np.uint64(5)))
    assert len(free_marks(Vote("v", 0, "d", free=stripes), 2)) == 0, "each pattern occurs often"


@settings(max_examples=10, deadline=None)
@given(st.permutations(range(6)), st.integers(0, 2))
def test_the_order_of_ballots_does_not_decide_which_of_copies_is_heard(order: list[int], by: int) -> None:
    votes = by_name({f"v{i}": drive_along(i) for i in range(4)} | {"x": moved(drive_along(0), by // 2, by % 2)})
    votes.append(Vote("y", 9, "ballot of y", states=drive_along(3)))
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


def test_of_two_that_are_alike_nobody_lies_for_sure_but_of_three_one_does() -> None:
    copies = [Copy("a", "1", "x", "10"), Copy("b", "2", "y", "20"), Copy("c", "3", "y", "20")]
    assert liars_among(copies, by_name({"x": drive_along(0), "y": drive_along(1)})) == 1
    assert liars_among(copies, by_name({"c": drive_along(0)})) == 0, "who is heard by another drive is not silenced"
