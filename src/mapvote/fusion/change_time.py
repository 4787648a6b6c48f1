"""When the world changed: all earlier vehicles vote "unchanged", all later ones vote the same change.

With a majority of the latest vehicles alone, a house that stood for years would stand for as many passes again. But if
the votes on a cell, in the order in which the vehicles passed, are "unchanged" and then, without exception, the same
change, the change happened in between: the earlier vehicles saw another world and do not count. One more than the
quorum must have seen it, so that neither k liars nor k liars and an honest vehicle that errs make such a turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.grid import CELLS
from mapvote.core.kernel import kernel
from mapvote.core.types import I64, N_STATES, NO_VOTE, U8, Bool, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.fusion.tile_vote import TileVote

_UN = int(CellState.UNDETERMINED)
_TURNS = (
    (CellState.UNCHANGED_OCCUPIED, CellState.CHANGED_EMPTY),
    (CellState.UNCHANGED_EMPTY, CellState.CHANGED_OCCUPIED),
)


def lately_changed(states: U8, drives: Sequence[TileVote], tally: NDArray[Any], quorum: int) -> U8:
    """``states`` (256, 256) with the change in cells decided unchanged, or undecided, where more than ``quorum``
    vehicles, the last ones, vote for it, and all before them for no change.

    ``drives``: those that count, two-stage, each by itself; ``tally`` (256, 256, 5) of them, in VOTE_UNITs.
    """

    planes = np.moveaxis(tally, -1, 0).reshape(N_STATES, CELLS)
    flat, out = states.reshape(-1), states
    for before, after in _TURNS:
        cells = _may_turn(flat, planes[int(after)], int(before), quorum * VOTE_UNIT)
        if len(cells):
            said, ends_ns, whose = said_in_order(drives, cells)
            found = cells[_turn(said, ends_ns, whose, int(before), int(after))]
            out = out.copy() if out is states and len(found) else out
            out.reshape(-1)[found] = int(after)
    return out


def said_in_order(drives: Sequence[TileVote], cells: I64) -> tuple[U8, I64, I64]:
    """What drives say of flat ``cells`` (n,), in the order in which they ended: (states (m, n), ends (m,) ns, vehicles
    (m,) as numbers)."""
    ordered = sorted(drives, key=lambda drive: (drive.end_ns, drive.digest))
    names = {name: i for i, name in enumerate(sorted({drive.vehicle for drive in ordered}))}
    said = np.full((len(ordered), len(cells)), NO_VOTE, dtype=np.uint8)
    for i, drive in enumerate(ordered):
        assert drive.states is not None
        said[i] = drive.states.reshape(-1)[cells]
    ends_ns = np.array([drive.end_ns for drive in ordered], dtype=np.int64)
    return said, ends_ns, np.array([names[drive.vehicle] for drive in ordered], dtype=np.int64)


def _turn(said: U8, ends_ns: I64, whose: I64, before: int, after: int) -> Bool:
    """(n,) in which cells every vehicle's last word is ``before`` until some moment and ``after`` since."""
    found = np.zeros(said.shape[1], dtype=np.bool_)
    _find_turns(said, ends_ns, whose, before, after, np.empty(len(whose), dtype=np.int64), found)
    return found


@kernel
def _find_turns(said: U8, ends_ns: I64, whose: I64, before: int, after: int, last: I64, found: Bool) -> None:
    """:func:`_turn` into ``found`` (n,). ``last`` (m,): memory for the last word of each vehicle."""
    for cell in range(said.shape[1]):
        for i in range(len(last)):
            last[i] = -1
        for i in range(len(whose)):
            if said[i, cell] != NO_VOTE:
                last[whose[i]] = i
        oldest_after, newest_before, other = np.iinfo(np.int64).max, np.iinfo(np.int64).min, False
        for i in range(len(last)):
            word = last[i]
            if word >= 0 and said[word, cell] == after:
                oldest_after = min(oldest_after, ends_ns[word])
            elif word >= 0 and said[word, cell] == before:
                newest_before = max(newest_before, ends_ns[word])
            elif word >= 0 and said[word, cell] < _UN:
                other = True
        found[cell] = not other and newest_before < oldest_after


def _may_turn(states: U8, votes: NDArray[Any], before: int, most: int) -> I64:
    """Flat cells that are ``before`` or undetermined though more than ``most`` VOTE_UNITs say otherwise; (65536,)
    each."""
    found = np.flatnonzero(votes > most)
    return found[(states[found] == before) | (states[found] == _UN)]
