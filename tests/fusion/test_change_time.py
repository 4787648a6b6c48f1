"""The order of time: when the world changed, whether what is new stays, and what a cell remembers of the past."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from hand_made import make_tile, states_plane, two_walls, wall
from mapvote.config import FuseSettings
from mapvote.core.rule import PAPER, SURFACES, Rule
from mapvote.core.tile import Memory, Tile
from mapvote.core.types import CellState
from mapvote.fusion.change_time import DAY_S, history_days, remembered, temporary
from mapvote.fusion.fuse import fuse_tile, unspent
from mapvote.fusion.tile_vote import DAY_NS, Vote, newest_votes

UO, UE, CO, CE, UN = (int(state) for state in CellState)
CELL, LAWN = (10, 10), (20, 20)
SIX, TWICE = [UO] * 6, ["a", "b", "c", "d", "e", "f", "a", "b"]


def decided(
    said: Sequence[int], min_votes: int = 2, ends_s: list[int] | None = None, whose: list[str] | None = None,
    rule: Rule = SURFACES, cell: tuple[int, int] = CELL, live: bool = False,
) -> int:  # fmt: skip
    """The decision on a cell if vehicles pass one after the other with these votes; ``live``: as a server does."""
    votes = [
        Vote(
            vehicle=f"v{i}" if whose is None else whose[i],
            end_ns=(i if ends_s is None else ends_s[i]) * 10**9,
            digest=f"{i:02}",
            states=states_plane({cell: state}),
        )
        for i, state in enumerate(said)
    ]
    shuffled = [votes[i] for i in np.random.default_rng(len(said)).permutation(len(votes))]
    settings, history = FuseSettings(min_votes=min_votes, latest_vehicles=99), (lambda: votes) if live else None
    return int(fuse_tile(two_walls().tiles[0, 0], shuffled, rule, settings, 2, history)[0].states[cell])


@pytest.mark.parametrize(
    ("why", "said", "how", "state"),
    [
        ("a quorum alone does not outvote six", [*SIX, CE, CE], {}, UO),
        ("three in turn say that the house is gone", [*SIX, CE, CE, CE], {}, CE),
        ("however many saw it stand", [*[UO] * 50, CE, CE, CE], {}, CE),
        ("likewise of what is new", [*[UE] * 6, CO, CO, CO], {}, CO),
        ("one more than the quorum must say so", [*SIX, CE, CE, CE], {"min_votes": 3}, UO),
        ("one more than the quorum says so", [*SIX, CE, CE, CE, CE], {"min_votes": 3}, CE),
        ("by the paper's rule the majority decides, whoever came last", [*SIX, CE, CE, CE], {"rule": PAPER}, UO),
        ("who is not sure breaks nothing", [*SIX, CE, UN, CE, UN, CE], {}, CE),
        ("at the same moment there is no before", [*[UO] * 4, CE, CE, CE], {"ends_s": [1, 1, 1, 5, 5, 5, 5]}, UO),
        ("two vehicles, three drives", [*SIX, CE, CE, CE], {"whose": [*TWICE, "b"]}, UO),
        ("of a vehicle the last word counts", [*SIX, CE, CE, CE], {"whose": [*TWICE, "c"]}, CE),
        ("one contradicts before", [UO, UO, CE, UO, UO, UO, CE, CE, CE], {}, UO),
        ("one contradicts between", [*SIX, CE, UO, CE, CE], {}, UO),
        ("the last contradicts", [*SIX, CE, CE, CE, UO], {}, UO),
        ("one saw something else", [*SIX, CO, CE, CE, CE], {}, UO),
    ],
)
def test_a_change_is_decided_once_more_than_a_quorum_say_so_one_after_the_other_and_nobody_contradicts(
    why: str, said: list[int], how: dict[str, int], state: int
) -> None:
    assert decided(said, **how) == state, why  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("why", "cell", "said", "state"),
    [
        ("two saw a car", LAWN, [CO, CO], CO),
        ("it had left before the third passed", LAWN, [CO, CO, UE], UN),
        ("the fourth saw it again", LAWN, [CO, CO, UE, CO], CO),
        ("who is not sure says nothing", LAWN, [CO, CO, UN], CO),
        ("what was surveyed falls by a quorum: no one vehicle can hold it up", CELL, [CE, CE, UO], CE),
    ],
)
def test_what_vehicles_saw_come_waits_for_the_last_who_looked(
    why: str, cell: tuple[int, int], said: list[int], state: int
) -> None:
    assert decided(said, cell=cell, live=True) == state, why
    assert decided(said, cell=cell) == (CO if cell == LAWN else CE), "one round on files is of one moment"


SETTINGS = FuseSettings(stay_days=30.0, prior_stay_days=30.0, min_votes=2)
START_S = 1_700_000_000


def memory(stays: int = 0, stayed_days: float = 0.0, came_s: int = 0, cell: tuple[int, int] = CELL) -> Memory:
    planes = Memory.none().planes.copy()
    planes[1][cell], planes[2][cell], planes[3][cell] = came_s, stays, stayed_days * DAY_S
    return Memory.of(planes)


def drive(day: float, states: dict[tuple[int, int], int], vehicle: str = "v") -> Vote:
    end_ns = (START_S + round(day * DAY_S)) * 10**9
    return Vote(vehicle, end_ns, f"{vehicle}{day}", states=states_plane(states))


NEW = states_plane({CELL: CO})


@pytest.mark.parametrize(
    ("stays", "stayed_days", "seen_days", "stays_out"),
    [
        (0, 0.0, 0.0, False),  # nothing ever went here
        (1, 0.0, 0.0, True),  # 30 / 2
        (1, 0.0, 29.0, True),  # (30 + 29) / 2
        (1, 0.0, 30.0, False),  # it has stood for as long as is asked
        (1, 20.0, 10.0, False),  # (30 + 20 + 10) / 2 is just enough
        (1, 20.0, 9.0, True),
        (9, 0.0, 30.0, False),  # whatever came and went: it has stood long enough
    ],
)
def test_what_is_new_where_things_come_and_go_stays_out_until_it_can_be_expected_to_stay(
    stays: int, stayed_days: float, seen_days: float, stays_out: bool
) -> None:
    tile = replace(make_tile(wall([], [])), memory=memory(stays, stayed_days))
    seen = [drive(day, {CELL: CO}) for day in (0.0, seen_days)]
    assert np.argwhere(temporary(NEW, tile, seen, SETTINGS)).tolist() == ([list(CELL)] if stays_out else [])


def test_a_clock_that_stood_before_1970_is_taken_for_1970() -> None:
    tile = replace(make_tile(wall([], [])), memory=memory(1, 0.0))
    seen = [replace(drive(0, {CELL: CO}), end_ns=day * DAY_NS) for day in (-5, 2)]
    assert temporary(NEW, tile, seen, FuseSettings(stay_days=3.0, prior_stay_days=0.0))[CELL], "two days, not seven"


STANDS, BARE = make_tile(wall([CELL], [0.75])), make_tile(wall([], []))


def test_a_thing_never_left_before_it_came() -> None:
    """Clocks differ between vehicles: what was seen gone before it was seen there stayed for no time at all."""
    after = remembered(memory(came_s=START_S), STANDS, BARE, [drive(-0.1, {CELL: CE})], states_plane({CELL: CE}))
    assert (after.stays[CELL], after.stayed_s[CELL]) == (1, 0)


@pytest.mark.parametrize(("end_ns", "came_s"), [(0, 1), (-(10**18), 1), (2**32 * 10**9, 2**32 - 2)])
def test_a_time_that_32_bits_cannot_hold_is_the_nearest_that_they_can(end_ns: int, came_s: int) -> None:
    """0 would say that nothing was ever put there."""
    vote = Vote("a", end_ns, "a", states=states_plane({CELL: CO}))
    assert remembered(Memory.none(), BARE, STANDS, [vote], NEW).came_s[CELL] == came_s
    assert remembered(Memory.none(), BARE, STANDS, [vote], NEW, (lambda: [vote], 2)).came_s[CELL] == came_s
    gone = drive(0, {CELL: CE})
    assert remembered(memory(came_s=came_s), STANDS, BARE, [gone], states_plane({CELL: CE})).stays[CELL] == 1


def test_a_new_object_is_dated_from_its_first_sighting_beside_cells_that_filled_otherwise() -> None:
    """A point beside the object falls into a cell that nobody calls changed: it has no date."""
    both = make_tile(wall([CELL, LAWN], [0.75]))
    early, late = (drive(day, {CELL: CO}) for day in (0.0, 5.0))
    after = remembered(Memory.none(), BARE, both, [late], states_plane({CELL: CO}), (lambda: [early, late], 2))
    assert after.came_s[CELL] == early.end_ns // 10**9
    assert after.came_s[LAWN] == 0


def fused(tile: Tile, day: float, state: int, version: int, history: list[Vote]) -> Tile:
    points = wall([CELL], [0.75]) if state == CO else None
    votes = [replace(drive(day, {CELL: state}, vehicle), new_points=points) for vehicle in "ab"]
    history += votes
    return fuse_tile(tile, votes, SURFACES, SETTINGS, version, lambda: history)[1]


def test_a_skip_that_comes_and_goes_enters_the_map_once_and_then_only_after_a_month() -> None:
    """The first time it comes it may stay for good; after it went, the next one has to show that it does."""
    history: list[Vote] = []
    tile = fused(make_tile(wall([], []), index=(0, 0)), 0, CO, 2, history)
    assert len(tile.points) == 1
    tile = fused(tile, 3, CE, 3, history)
    assert len(tile.points) == 0
    assert tile.memory is not None
    assert (tile.memory.stays[CELL], tile.memory.stayed_s[CELL]) == (1, 3 * DAY_S)
    assert tile.memory.changed[CELL] == 3
    history.clear()  # spent by the version that took it down
    for day in (10, 20, 36):
        assert len(fused(tile, day, CO, 4, history).points) == 0, "(30 + 3 + 26) / 2 days"
    assert len(fused(tile, 37, CO, 4, history).points) == 1, "(30 + 3 + 27) / 2 days"


def entered_after(
    histories: Mapping[tuple[int, int], Sequence[tuple[float, float]]], rng: np.random.Generator, settings: FuseSettings
) -> dict[tuple[int, int], int]:
    """By cell: the passes from the one that saw the last thing ``stay_days`` after its first sighting, that one among
    them, until it entered the map; 0 before.

    ``histories``: by cell, things that stand from one day to another; the last one stands for good. Three perfect
    vehicles pass every day, each at any minute, and the server publishes after each pass. Absent: a cell that the last
    thing never enters.
    """
    entered: dict[tuple[int, int], int] = {}
    waited, first = dict.fromkeys(histories, 0), dict[tuple[int, int], float]()
    tile, seen, version = BARE, list[Vote](), 1
    last = max(things[-1][0] for things in histories.values())
    for day in sorted(day + hour / 24 for day in range(int(last) + 45) for hour in rng.uniform(0, 24, 3)):
        says, new = {}, []
        for cell, things in histories.items():
            there, mapped = any(start <= day < end for start, end in things), bool(tile.obstacle_words[cell])
            says[cell] = {(True, True): UO, (True, False): CO, (False, True): CE, (False, False): UE}[there, mapped]
            new += [wall([cell], [0.75]).astype(np.float32)] if says[cell] == CO else []
            if day >= things[-1][0]:
                waited[cell] += cell not in entered and day >= first.setdefault(cell, day) + settings.stay_days
        points = np.concatenate(new) if new else None
        seen.append(replace(drive(day, says, f"v{len(seen) % 3}"), version=version, new_points=points))
        oldest = seen[-1].end_ns - history_days(settings) * DAY_NS
        seen = [vote for vote in seen if vote.end_ns >= oldest]
        votes, past = ([unspent(vote, tile) for vote in some] for some in (newest_votes(seen, settings), seen))
        after = fuse_tile(tile, votes, PAPER, settings, version + 1, partial(list, past))[1]
        if after is not tile:
            tile, version = after, version + 1
            arrived = [cell for cell, things in histories.items() if day >= things[-1][0] and tile.obstacle_words[cell]]
            entered |= {cell: waited[cell] for cell in arrived if cell not in entered}
    return entered


def random_history(rng: np.random.Generator) -> list[tuple[float, float]]:
    """One to three things that stay between .7 and 72 days with some days between them, then one for good."""
    day, things = 1.0, []
    for _ in range(rng.integers(1, 4)):
        stay = float(rng.choice([1, 2, 3, 5, 10, 20, 29, 35, 40, 60]) * rng.uniform(0.7, 1.2))
        things.append((day, day + stay))
        day += stay + rng.uniform(0.5, 8)
    return [*things, (day, 9999.0)]


@pytest.mark.parametrize(("seed", "n"), [pytest.param(2, 250, marks=pytest.mark.slow)])
def test_what_stands_for_good_enters_within_three_passes_whatever_stood_there_before(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    cells = [(8 + 15 * (i // 16), 8 + 15 * (i % 16)) for i in range(n)]
    histories = dict(zip(cells, (random_history(rng) for _ in cells), strict=True))
    histories[cells[0]] = [(1, 3), (5, 34), (36, 9999)]
    histories[cells[1]] = [(1, 4), (10, 50), (60, 9999)]
    entered = entered_after(histories, rng, SETTINGS)
    assert len(entered) == n
    assert max(entered.values()) <= 3


def test_without_a_prior_what_is_new_enters_after_the_days_that_it_must_stay() -> None:
    settings = SETTINGS.model_copy(update={"prior_stay_days": 0.0})
    assert entered_after({CELL: [(1, 9999)]}, np.random.default_rng(1), settings)[CELL] in (1, 2, 3)


WALL, LAWN = (10, 10), (20, 20)
