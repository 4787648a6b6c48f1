"""The one voting rule, shared by vehicle and server (paper III-B, IV).

A tally is (..., 5) int32: votes per :class:`CellState`, in units of 1 / VOTE_UNIT vote, so that sums do
not depend on their order. A decided ballot is a one-hot tally; the server always decides the sum of tallies.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mapvote.core.kernel import inlined, kernel
from mapvote.core.types import I32, N_STATES, NO_VOTE, U8, U16, CellState, read_only

VOTE_UNIT = 16
"""One vote in the units of a tally: Eq. (1) is rounded to sixteenths."""
_CACHED_CELLS = 2048
_BYTE_MAX, _VOTERS_AT_ONCE = 255, 4
"""Voters whose votes a byte can count; that are counted in one pass."""
_TALLIES: dict[Any, DTypeLike] = {np.dtype(np.uint8): np.uint8, np.dtype(np.uint16): np.uint16}
_UO, _UE, _CO, _CE, _UN = (int(state) for state in CellState)
_UNDECIDED_YET = 254
"""A cell that is not decided yet: no state, and not NO_VOTE."""


def vote_weight(n: ArrayLike, a: float = 2.0, b: float = 3.0, k: float = 0.5, n_min: int = 5) -> NDArray[np.float64]:
    """w(n) = a + (b - a)(1 - exp(-k (n - n_min))), paper Eq. (1): votes of an occupied cell with n points.

    Defined for n >= n_min; below it a cell is not occupied and the weight is 0.
    """
    n = np.asarray(n, dtype=np.float64)
    return np.where(n >= n_min, a + (b - a) * (1.0 - np.exp(-k * (np.maximum(n, n_min) - n_min))), 0.0)


def weight_table(weighted: bool, a: float, b: float, k: float, n_min: int, n_max: int = 256) -> I32:
    """(n_max + 1,) int32 votes in VOTE_UNITs by number of points; one vote each if not ``weighted``."""
    n = np.arange(n_max + 1)
    votes = vote_weight(n, a, b, k, n_min) if weighted else (n >= n_min).astype(np.float64)
    return np.round(votes * VOTE_UNIT).astype(np.int32)


@kernel
def cast(tally: I32, states: U8, weights: I32) -> None:
    """Add one scan: ``weights[r, c]`` VOTE_UNITs to class ``states[r, c]`` of ``tally[r, c]``; NO_VOTE adds nothing.

    Shapes (rows, cols, 5), (rows, cols), (rows, cols); ``tally`` is changed in place.
    """
    for r in range(states.shape[0]):
        for c in range(states.shape[1]):
            if states[r, c] != NO_VOTE:
                tally[r, c, states[r, c]] += weights[r, c]


@inlined
def verdict(uo: int, ue: int, co: int, ce: int, un: int, abstain: bool) -> int:
    """The rule: the class with most votes wins, a tie is UNDETERMINED, no votes are NO_VOTE (paper III-B, IV).

    Votes by :class:`CellState`. With ``abstain``, UNDETERMINED does not compete, and a change also needs more than
    half of all other votes (docs/decisions/voting.md).
    """
    best = max(max(uo, ue), max(co, ce))
    if not abstain:
        best = max(best, un)
    if best <= 0:
        return _UN if un > 0 else NO_VOTE
    ties = (uo == best) + (ue == best) + (co == best) + (ce == best) + (un == best and not abstain)
    if ties > 1:
        return _UN
    short = abstain and 2 * best <= uo + ue + co + ce
    if co == best:
        return _UN if short else _CO
    if ce == best:
        return _UN if short else _CE
    return _UO if uo == best else _UE if ue == best else _UN


@kernel
def _decide_cells(tally: I32, backers: I32, abstain: bool, min_votes: int, states: U8) -> None:
    uos = tally[0]
    ues = tally[1]
    cos = tally[2]
    ces = tally[3]
    uns = tally[4]
    for c in range(len(states)):  # most cells have no vote, or only votes for empty: tested in vectors
        empty = ues[c]
        more = uos[c] | cos[c] | ces[c] | uns[c]
        s = _UE if empty != 0 else NO_VOTE
        states[c] = _UNDECIDED_YET if more != 0 else s
    for c in range(len(states)):
        if states[c] == _UNDECIDED_YET:
            uo = np.int64(uos[c])
            ue = np.int64(ues[c])
            co = np.int64(cos[c])
            s = verdict(uo, ue, co, np.int64(ces[c]), np.int64(uns[c]), abstain)
            states[c] = _UN if s in (_CO, _CE) and backers[s, c] < min_votes else s


def decide_cells(tally: NDArray[Any], backers: NDArray[Any], abstain: bool, min_votes: int) -> U8:
    """:func:`verdict` of every cell; a change that fewer than ``min_votes`` back is UNDETERMINED.

    ``tally`` (5, cells), integers of any type; ``backers`` (5, cells) in the same units as ``min_votes`` -> (cells,)
    uint8.
    """
    states = np.empty(tally.shape[1], dtype=np.uint8)
    planes = np.ascontiguousarray(tally, dtype=np.int32)  # one type: each other would be compiled for itself
    own = planes if backers is tally else np.ascontiguousarray(backers, dtype=np.int32)
    _decide_cells(planes, own, abstain, min_votes, states)
    return states


def plurality(tally: I32) -> U8:
    """:func:`verdict` where UNDETERMINED competes: ``tally`` (..., 5) -> states (...) uint8."""
    planes = tally.reshape(-1, N_STATES).T
    return decide_cells(planes, planes, False, 0).reshape(tally.shape[:-1])


def one_hot(states: U8) -> I32:
    """One vote for each cell's state: (...) uint8 -> (..., 5) int32; NO_VOTE gives none."""
    tally = np.zeros((*states.shape, N_STATES), dtype=np.int32)
    for state in CellState:
        tally[..., state] = (states == int(state)) * VOTE_UNIT
    return tally


def tally_of(voters: Sequence[U8], cells: int) -> NDArray[Any]:
    """(5, cells) the tally of what each of some voters decided, ``states`` (cells,), a vote each: the sum of their
    ``one_hot``, class by class, as uint8 or uint16 where no sum can exceed that.

    Votes are counted in bytes first, as many voters as a byte can count; of few that is the tally.
    """
    shape = (N_STATES, cells)
    silent = read_only(np.full(cells, NO_VOTE, dtype=np.uint8))
    tally = np.zeros(shape, dtype=_TALLIES.get(np.min_scalar_type(VOTE_UNIT * len(voters)), np.int32))
    for start in range(0, len(voters), _BYTE_MAX):
        counts = tally if tally.dtype == np.uint8 else np.zeros(shape, dtype=np.uint8)
        batch = voters[start : start + _BYTE_MAX]
        for first in range(0, len(batch), _VOTERS_AT_ONCE):
            some = batch[first : first + _VOTERS_AT_ONCE]
            count_states(*some, *[silent] * (_VOTERS_AT_ONCE - len(some)), counts)
        if counts is tally:
            tally *= np.uint8(VOTE_UNIT)
        else:
            tally += np.multiply(counts, VOTE_UNIT, dtype=tally.dtype)
    return tally


@kernel
def count_states(one: U8, two: U8, three: U8, four: U8, counts: U8) -> None:
    """Four more voters in ``counts`` (5, cells): the server's hot loop, of which the compiler makes vectors. One voter
    at a time would wait for the counts."""
    for start in range(0, len(one), _CACHED_CELLS):
        here = slice(start, start + _CACHED_CELLS)
        a = one[here]
        b = two[here]
        c = three[here]
        d = four[here]
        for state in range(N_STATES):
            own = np.uint8(state)
            count = counts[state, here]
            for i in range(len(count)):
                n = count[i]
                n += a[i] == own
                n += b[i] == own
                n += c[i] == own
                n += d[i] == own
                count[i] = n


@kernel
def add_tally(votes: U16, abstain: bool, tally: I32, backers: I32) -> None:
    """Add one voter's tally ``votes`` (5, cells) to ``tally`` (5, cells), and one to ``backers`` (5, cells) for the
    class that its own votes decide: who counted a class now and then does not stand behind it."""
    for c in range(votes.shape[1]):
        uo = votes[0, c]
        ue = votes[1, c]
        co = votes[2, c]
        ce = votes[3, c]
        un = votes[4, c]
        state = verdict(np.int64(uo), np.int64(ue), np.int64(co), np.int64(ce), np.int64(un), abstain)
        if state != NO_VOTE:
            backers[state, c] += 1
            for k in range(N_STATES):
                tally[k, c] += votes[k, c]


def to_wire(tally: I32) -> U16:
    """A tally as uint16 for a one-stage ballot; a cell that would overflow is scaled down as a whole."""
    peak = np.maximum(tally.max(axis=-1), 1)
    shift = np.maximum(0, np.ceil(np.log2(peak / 65535.0))).astype(np.int32)
    return (tally >> shift[..., None]).astype(np.uint16)
