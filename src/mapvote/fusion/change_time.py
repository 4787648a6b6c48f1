"""Votes in the order of time: when the world changed, and whether a new object is there to stay.

A change in between. With a majority of the latest vehicles alone, a house that stood for years would stand for as many
passes again. But if the votes on a cell, in the order in which the vehicles passed, are "unchanged" and then, without
exception, the same change, the change happened in between: the earlier vehicles saw another world and do not count. One
more than the quorum must have seen it, so that neither k liars nor k liars and an honest vehicle that errs make such a
turn.

Temporary objects. A new object enters the map once it is expected to stay. Every cell remembers how many objects
vehicles saw appear and disappear there, and how long these stayed. An object whose stay is exponentially distributed
(as in Rosen, Mason and Leonard, "Towards lifelong feature-based mapping in semi-static environments", 2016), with
``prior_stay_days`` expected beforehand, is expected to stay (prior + all past stays + its own age) / (1 + number of
past stays). Below ``stay_days`` it is *temporary* and stays out of the map. Points of the map are deleted by their own
rule: a stay of a year does not outweigh a quorum that sees through them.

Where objects appear and disappear, the last observation decides: if two vehicles saw a car that had left before the
third passed, it waits for the fourth. This holds for new objects and for what vehicles added; what was surveyed is
deleted by a quorum alone, so that no vehicle can delay it by denying it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.config import FuseSettings
from mapvote.core.grid import CELLS
from mapvote.core.kernel import kernel
from mapvote.core.tile import Memory, Tile
from mapvote.core.types import F64, I64, N_STATES, NO_VOTE, U8, U64, Bool, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.fusion.tile_vote import Vote

DAY_S = 86_400
_UO, _UE, _CO, _CE, _UN = map(int, CellState)


def lately_changed(states: U8, drives: Sequence[Vote], tally: NDArray[Any], quorum: int) -> U8:
    """``states`` (256, 256) with the change in cells decided unchanged, or undecided, where more than ``quorum``
    vehicles, the last ones, vote for it, and all before them for no change.

    ``drives``: those that count, two-stage, each by itself; ``tally`` (256, 256, 5) of them, in VOTE_UNITs.
    """
    planes = np.moveaxis(tally, -1, 0).reshape(N_STATES, CELLS)
    flat = states.reshape(-1)
    out = states.copy()
    for before, after in ((_UO, _CE), (_UE, _CO)):
        cells = np.flatnonzero(planes[after] > quorum * VOTE_UNIT)
        cells = cells[(flat[cells] == before) | (flat[cells] == _UN)]
        if len(cells):
            said, ends_ns, whose = said_in_order(drives, cells)
            turned = np.zeros(len(cells), dtype=np.bool_)
            _find_turns(said, ends_ns, whose, before, after, np.empty(len(whose), dtype=np.int64), turned)
            out.reshape(-1)[cells[turned]] = after
    return out


def said_in_order(drives: Sequence[Vote], cells: I64) -> tuple[U8, I64, I64]:
    """The votes of drives on flat ``cells`` (n,), in the order of their ends: (states (m, n), ends (m,) ns, vehicles
    (m,) as numbers)."""
    ordered = sorted(drives, key=lambda drive: (drive.end_ns, drive.digest))
    names = {name: i for i, name in enumerate(sorted({drive.vehicle for drive in ordered}))}
    said = np.full((len(ordered), len(cells)), NO_VOTE, dtype=np.uint8)
    for i, drive in enumerate(ordered):
        assert drive.states is not None
        said[i] = drive.states.reshape(-1)[cells]
    ends_ns = np.array([drive.end_ns for drive in ordered], dtype=np.int64)
    return said, ends_ns, np.array([names[drive.vehicle] for drive in ordered], dtype=np.int64)


@kernel
def _find_turns(said: U8, ends_ns: I64, whose: I64, before: int, after: int, last: I64, turned: Bool) -> None:
    """Into ``turned`` (n,) in which cells every vehicle's last word is ``before`` until a moment and ``after`` since.
    ``last`` (m,): memory for the last word of each vehicle."""
    for cell in range(said.shape[1]):
        for i in range(len(last)):
            last[i] = -1
        for i in range(len(whose)):
            if said[i, cell] != NO_VOTE:
                last[whose[i]] = i
        oldest_after = np.iinfo(np.int64).max
        newest_before = np.iinfo(np.int64).min
        other = False
        for i in range(len(last)):
            word = last[i]
            if word >= 0 and said[word, cell] == after:
                oldest_after = min(oldest_after, ends_ns[word])
            elif word >= 0 and said[word, cell] == before:
                newest_before = max(newest_before, ends_ns[word])
            elif word >= 0 and said[word, cell] < _UN:
                other = True
        turned[cell] = not other and newest_before < oldest_after


def expected_days(memory: Memory | None, cells: Bool, age_days: F64 | float, settings: FuseSettings) -> F64:
    """(n,) how long what stands in ``cells`` (256, 256) since ``age_days`` (n,) can be expected to stay."""
    past = (memory or Memory.none()).at(np.flatnonzero(cells))[2:].astype(float)
    return np.asarray((settings.prior_stay_days + past[1] / DAY_S + age_days) / (1.0 + past[0]))


def doubtful(states: U8, memory: Memory | None, settings: FuseSettings) -> Bool:
    """(256, 256) cells decided changed-occupied in which the object may be temporary."""
    out = np.asarray(states == _CO)  # compared with a CellState numpy would make 64-bit numbers of all of them
    out[out] = expected_days(memory, out, 0.0, settings) < settings.stay_days
    return np.asarray(out)


def history_days(settings: FuseSettings) -> float:
    """How far back votes are read for the first sighting of an object, days.

    Twice ``stay_days``: vehicles pass at any minute, so a window of just ``stay_days`` never holds a first sighting
    that is ``stay_days`` older than the last one.
    """
    return max(2.0 * settings.stay_days, settings.max_age_days)


def seen_since(drives: Sequence[Vote], cells: I64, breaks: int) -> tuple[I64, I64]:
    """(n,) the first and (n,) the last sighting, seconds, of the object seen in flat ``cells`` (n,) without a break; -1
    where there is none.

    All ``drives`` that count there are considered, each by itself. An object ends with ``breaks`` drives in a row that
    see nothing.
    """
    since, last, absent = (np.full(len(cells), value, np.int64) for value in (-1, -1, 0))
    said, ends_ns, _ = said_in_order([drive for drive in drives if drive.states is not None], cells)
    for seen, end_s in zip(said, np.maximum(ends_ns // 10**9, 0).tolist(), strict=True):
        there = seen == _CO
        absent[there] = 0
        absent[seen == _UE] += 1
        since[absent >= breaks] = -1
        since[there & (since < 0)] = end_s
        last[there] = end_s
    return since, last


def temporary(states: U8, tile: Tile, drives: Sequence[Vote], settings: FuseSettings) -> Bool:
    """(256, 256) cells decided changed-occupied by temporary objects.

    ``drives``: every vote that counts on the tile and is no more than :func:`history_days` older than the newest. An
    object that is seen for ``stay_days`` without a break enters the map, whatever the history of the cell.
    """
    cells = doubtful(states, tile.memory, settings)
    if cells.any():
        since, last = seen_since(drives, np.flatnonzero(cells), settings.min_votes)
        age = np.where(since < 0, 0.0, (last - since) / DAY_S)
        stays = (age >= settings.stay_days) | (expected_days(tile.memory, cells, age, settings) >= settings.stay_days)
        cells[cells] = ~stays
    return cells


def denied_last(states: U8, memory: Memory | None, drives: Sequence[Vote]) -> Bool:
    """(256, 256) cells with a decided new object, or the decided end of what vehicles added, with which the last of
    ``drives`` that determined them disagrees."""
    out = np.asarray(states == _CO)
    if memory is not None:
        brought = memory.brought
        out.reshape(-1)[brought[states.reshape(-1)[brought] == _CE]] = True
    cells = np.flatnonzero(out)
    if len(cells):
        said = said_in_order(drives, cells)[0]
        determined = said < _UN
        newest = len(said) - 1 - np.argmax(determined[::-1], axis=0)
        last = said[newest, np.arange(len(cells))]
        out.reshape(-1)[cells] = determined.any(axis=0) & (last != states.reshape(-1)[cells])
    return out


def remembered(
    memory: Memory,
    before: Tile,
    after: Tile,
    votes: Sequence[Vote],
    states: U8,
    past: tuple[Callable[[], Sequence[Vote]], int] | None = None,
) -> Memory:
    """``memory`` with the objects that appeared and disappeared between two versions of a tile, by the votes that
    decided.

    ``past``: (all votes of the last :func:`history_days`, called only if something appeared; how many drives in a row
    that see nothing end an object). An object appeared when it was first seen without a break, which may be long before
    the votes that decided.
    """
    went, came = emptied_and_filled(before.obstacle_words.reshape(-1), after.obstacle_words.reshape(-1))
    went = went[memory.at(went)[1] > 0]
    if not len(came) and not len(went):
        return memory
    of_new = memory.at(came)
    of_gone = memory.at(went)
    risen = states.reshape(-1)[came] == _CO
    first_s = _first_s(votes, came, _CO)
    if past is not None and risen.any():
        since = seen_since(past[0](), came, past[1])[0]
        first_s = np.where(since > 0, np.minimum(since, first_s), first_s).astype(np.uint32)
    of_new[1] = np.where(risen, first_s, np.uint32(0))
    came_s, stays, stayed_s = of_gone[1:]
    stays += 1
    stayed_s += np.maximum(_first_s(votes, went, _CE), came_s) - came_s
    came_s[:] = 0
    cells = np.concatenate([came, went])
    values = np.concatenate([of_new, of_gone], axis=1)
    order = np.argsort(cells)
    return memory.but(cells[order], values[:, order])


def emptied_and_filled(before: U64, after: U64) -> tuple[I64, I64]:
    """Indices of the words (n,) that are zero only after, and only before."""
    changed = np.flatnonzero(before != after)
    emptied = after[changed] == 0
    filled = before[changed] == 0
    return changed[emptied], changed[filled]


def _first_s(votes: Sequence[Vote], cells: I64, state: int) -> NDArray[np.uint32]:
    """(n,) time of the first of ``votes`` for ``state`` on flat ``cells`` (n,), seconds; 0 without one."""
    first = np.full(len(cells), np.iinfo(np.uint32).max, dtype=np.uint32)
    for vote in votes:
        if vote.states is not None:
            end_s = np.uint32(min(max(vote.end_ns // 10**9, 1), 2**32 - 2))
            said = vote.states.reshape(-1)[cells] == state
            first[said] = np.minimum(first[said], end_s)
    return np.where(first == np.iinfo(np.uint32).max, np.uint32(0), first)
