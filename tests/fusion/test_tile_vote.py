"""One vehicle's statement on a tile: which drives speak, what they back, and how they become one vote."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hand_made import Say, at_least, make_ballot, states_plane, two_walls, unpack_all, wall, words_plane
from mapvote.codec.planes import Words, nothing_reached
from mapvote.config import FuseSettings
from mapvote.core.grid import TILE_CELLS, Lattice
from mapvote.core.types import N_STATES, NO_VOTE, CellState
from mapvote.fusion.tile_vote import DAY_NS, Vote, fold, newest_votes, offered, silenced

UO, UE, CO, CE, UN = CellState
WINDOW = Lattice().tile((0, 0))
HERE, THERE = (3, 4), (200, 17)
FLAT = np.array([3 * TILE_CELLS + 4, 200 * TILE_CELLS + 17])


def drive(vehicle: str, end_ns: int, cells: dict[tuple[int, int], int], **more: object) -> Vote:
    return Vote(vehicle, end_ns, f"{vehicle}{end_ns}", states=states_plane(cells), **more)  # type: ignore[arg-type]


def counted(cells: dict[tuple[int, int], list[int]]) -> Vote:
    tally = np.zeros((TILE_CELLS, TILE_CELLS, N_STATES), dtype=np.uint16)
    for cell, votes in cells.items():
        tally[cell] = votes
    return Vote("v", 0, "d", tally=tally)


def test_a_drive_as_old_as_the_window_still_speaks_and_one_a_moment_older_does_not() -> None:
    policy = FuseSettings(max_age_days=2)
    votes = [drive("new", 3 * DAY_NS, {}), drive("edge", DAY_NS, {}), drive("old", DAY_NS - 1, {})]
    assert [v.vehicle for v in newest_votes(votes, policy)] == ["new", "edge"]
    assert newest_votes([], policy) == []


def test_of_too_many_vehicles_those_that_passed_last_speak_with_all_their_drives() -> None:
    policy = FuseSettings(latest_vehicles=2)
    votes = [drive("a", 1, {}), drive("b", 2, {}), drive("c", 3, {}), drive("a", 4, {})]
    assert sorted((v.vehicle, v.end_ns) for v in newest_votes(votes, policy)) == [("a", 1), ("a", 4), ("c", 3)]
    tied = newest_votes([drive(name, 5, {}) for name in "bac"], policy)
    assert sorted(v.vehicle for v in tied) == ["b", "c"], "at the same moment the later name goes first"


@pytest.mark.parametrize(
    "vote", [counted({HERE: [0, 0, 3, 1, 0], THERE: [0, 0, 2, 5, 0]}), drive("v", 0, {HERE: CO, THERE: CO})]
)
def test_a_vote_agrees_where_it_backs_what_was_decided_and_not_where_something_else_was(vote: Vote) -> None:
    decided = states_plane({HERE: CO, THERE: CE})
    assert vote.agreed(FLAT, decided, CO).tolist() == [0]
    assert vote.agreed(FLAT[::-1].copy(), decided, CO).tolist() == [1]
    assert vote.agreed(FLAT, decided, UO).tolist() == []


def test_the_vote_of_a_ballot_has_the_planes_that_were_sent_and_no_others() -> None:
    states = states_plane({HERE: CE, THERE: UO})
    say = Say(states, gone=words_plane({HERE: 5}), free=words_plane({THERE: 6}), odds=np.array([7], np.int8))
    full, bare = (unpack_all(make_ballot(two_walls(), {(0, 0): sent}))[0] for sent in (say, Say(states)))
    assert full.gone is not None
    assert full.free is not None
    assert full.odds is not None
    words = full.gone.words.tolist(), full.free.words.tolist()
    assert (*words, full.odds.at(FLAT[:1]).tolist()) == ([5], [6], [7])
    assert (bare.gone, bare.free, bare.odds, bare.new_points) == (None, None, None, None)


def test_a_silenced_cell_says_nothing_and_the_others_all_they_said() -> None:
    vote = drive("v", 1, {HERE: CE, THERE: CO}, free=Words.of(words_plane({HERE: 5, THERE: 6})))
    assert silenced(vote, FLAT[:0]) is vote
    left = silenced(vote, FLAT[:1])
    assert left.states is not None
    assert (left.states[HERE], left.states[THERE]) == (NO_VOTE, CO)
    assert left.free is not None
    assert left.free.words.tolist() == [6]
    tally = silenced(counted({HERE: [0, 0, 3, 0, 0], THERE: [0, 0, 2, 0, 0]}), FLAT[:1]).tally
    assert tally is not None
    assert (tally[HERE].sum(), tally[THERE].tolist()) == (0, [0, 0, 2, 0, 0])


def test_what_a_vote_backs_by_its_states_and_by_its_tally() -> None:
    decided = drive("v", 1, {HERE: CE})
    assert decided.supports(CE, FLAT).tolist() == [True, False]
    assert decided.determined(FLAT).tolist() == [True, False]
    assert drive("v", 1, {HERE: UN}).determined(FLAT).tolist() == [False, False]
    assert drive("v", 1, {HERE: UN}).spoken().sum() == 1
    one_stage = counted({HERE: [0, 0, 1, 4, 0], THERE: [0, 0, 0, 0, 2]})
    assert one_stage.supports(CO, FLAT).tolist() == [True, False]
    assert one_stage.determined(FLAT).tolist() == [True, False]
    assert one_stage.spoken().sum() == 2


def test_what_is_marked_voter_by_voter_is_what_each_deletes_and_passed() -> None:
    rng = np.random.default_rng(1)
    shape = (TILE_CELLS, TILE_CELLS)
    decided = rng.choice([UO, CE], shape).astype(np.uint8)
    states = rng.choice([UO, CE, UN, NO_VOTE], shape).astype(np.uint8)
    words = Words.of(np.where(rng.random(shape) < 0.1, rng.integers(1, 2**63, shape), 0).astype(np.uint64))
    two_stage = Vote("v", 1, "v", states=states, gone=words, free=words)
    tally = np.zeros((*shape, 5), dtype=np.uint16)
    tally[states < UN, states[states < UN]] = 3
    for vote in (two_stage, replace(two_stage, gone=None), Vote("v", 1, "v", tally=tally, gone=words, free=words)):
        among = Words.whole(decided == CE)
        marked, passed = nothing_reached(1, len(among.cells)), nothing_reached(1)
        vote.mark_deleted(among, marked)
        vote.mark_passed(passed)
        deleted = vote.deletes(among)
        assert np.array_equal(marked[0], at_least([deleted], 1).reshape(-1)[among.cells])
        assert np.array_equal(passed[0].reshape(shape), at_least([words.within(vote.spoken())], 1))
        assert len(deleted.cells)


@pytest.mark.parametrize("seed", range(3))
def test_folded_drives_say_cell_by_cell_what_the_last_that_spoke_there_says(seed: int) -> None:
    rng, shape, cells = np.random.default_rng(seed), (TILE_CELLS, TILE_CELLS), range(0, TILE_CELLS**2, 331)
    drives = []
    for i in range(3):
        states = rng.choice([UO, UE, CE, UN, NO_VOTE], shape).astype(np.uint8)
        gone, free = (np.where(rng.random(shape) < 0.5, rng.integers(1, 2**63, shape), 0) for _ in range(2))
        words = None if i == seed else Words.of(gone.astype(np.uint64))
        vote = Vote("v", i, str(i), states=states, gone=words, free=Words.of(free.astype(np.uint64)))
        drives.append(silenced(vote, np.flatnonzero(rng.random(shape) > 0.7)) if i != 1 else vote)
    folded = fold([drives[i] for i in rng.permutation(3)], Lattice().tile((0, 0)))
    planes = [at_least([Words.none() if w is None else w], 1) for d in (*drives, folded) for w in (d.gone, d.free)]
    gone, free = (np.stack(some).reshape(4, -1) for some in (planes[::2], planes[1::2]))
    said, sent = (np.stack([d.states, d.sent]).reshape(2, -1) for d in drives), folded.sent  # type: ignore[list-item]
    by_drive = np.stack(list(said))
    assert folded.states is not None
    assert sent is not None
    for c in cells:
        spoke = [i for i in range(3) if by_drive[i, 0, c] != NO_VOTE]
        last = by_drive[spoke[-1], 0, c] if spoke else NO_VOTE
        assert folded.states.reshape(-1)[c] == last
        assert sent.reshape(-1)[c] == next((v for v in by_drive[::-1, 1, c] if v != NO_VOTE), NO_VOTE)
        whole = 2**64 - 1 if last == CE else 0
        marked = 0 if not spoke or last not in (CE, UO) else whole if spoke[-1] == seed else int(gone[spoke[-1], c])
        assert int(gone[3, c]) == marked
        assert free[3, c] == np.bitwise_or.reduce(free[spoke, c], initial=np.uint64(0))


def test_of_two_drives_that_sent_tallies_the_later_one_speaks_where_it_counted_anything() -> None:
    early, late = counted({HERE: [0, 0, 9, 0, 0], THERE: [7, 0, 0, 0, 0]}), counted({HERE: [0, 0, 0, 5, 0]})
    one = fold([replace(late, end_ns=2, digest="late"), replace(early, end_ns=1, digest="early")], WINDOW)
    assert one.tally is not None
    assert one.tally[HERE].tolist() == [0, 0, 0, 5, 0]
    assert one.tally[THERE].tolist() == [7, 0, 0, 0, 0]
    assert one.tally.sum() == 12


def test_points_of_a_cell_come_from_the_last_drive_that_speaks_there_and_of_no_other_cell() -> None:
    silent = [(50, 50)]
    early = drive("v", 1, {HERE: CO, THERE: CO}, new_points=wall([HERE, THERE, *silent], [0.45]))
    late = drive("v", 2, {HERE: CO}, new_points=wall([HERE, *silent], [1.05]))
    points = fold([early, late], WINDOW).new_points
    assert points is not None
    assert sorted(points[:, 2].tolist()) == pytest.approx([0.45, 1.05])


def test_points_whose_intensity_one_drive_did_not_measure_have_none_and_the_others_keep_theirs() -> None:
    first, second = np.array([[1.0, 1.0, 0.5]], np.float32), np.array([[5.0, 5.0, 0.5]], np.float32)
    bare = drive("v", 1, {(3, 3): CO}, new_points=first)
    full = drive("v", 2, {(16, 16): CO}, new_points=second, fields={"intensity": np.array([77], np.uint8)})
    one = fold([bare, full], WINDOW)
    assert one.new_points is not None
    intensity = one.fields["intensity"]
    assert sorted(zip(one.new_points[:, 0].tolist(), intensity.tolist(), strict=True)) == [(1.0, 0), (5.0, 77)]
    assert fold([bare, drive("v", 3, {})], WINDOW).fields == {}
    points, fields, _, voters = offered([one], states_plane({(3, 3): CO, (16, 16): CO}), WINDOW)
    assert points[:, 0].tolist() == [1, 5]
    assert fields["intensity"].tolist() == [0, 77]
    assert voters.tolist() == [0, 0]
