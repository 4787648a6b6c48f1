"""The one voting rule, shared by vehicle and server (paper III-B, IV).

A tally is (..., 5) int32: votes per :class:`CellState`, in units of 1 / VOTE_UNIT vote, so that sums do
not depend on their order. A decided ballot is a one-hot tally; the server always decides the sum of tallies.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapvote.core.types import I32, N_STATES, NO_VOTE, U8, U16, CellState

VOTE_UNIT = 16
"""One vote in the units of a tally: Eq. (1) is rounded to sixteenths."""


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


@numba.njit(cache=True, nogil=True)
def cast(tally: I32, states: U8, weights: I32) -> None:
    """Add one scan: ``weights[r, c]`` VOTE_UNITs to class ``states[r, c]`` of ``tally[r, c]``; NO_VOTE adds nothing.

    Shapes (rows, cols, 5), (rows, cols), (rows, cols); ``tally`` is changed in place.
    """
    for r in range(states.shape[0]):
        for c in range(states.shape[1]):
            if states[r, c] != NO_VOTE:
                tally[r, c, states[r, c]] += weights[r, c]


def decide(tally: I32) -> U8:
    """The class with most votes; ties are UNDETERMINED, no votes at all NO_VOTE (paper III-B, IV).

    ``tally`` (..., 5) -> states (...) uint8.
    """
    best = tally.max(axis=-1)
    winners = (tally == best[..., None]).sum(axis=-1)
    states = np.asarray(tally.argmax(axis=-1), dtype=np.uint8)
    states[winners > 1] = CellState.UNDETERMINED
    states[best <= 0] = NO_VOTE
    return states


def decide_change(tally: I32, min_votes: int = 1) -> U8:
    """As :func:`decide`, but UNDETERMINED abstains, and a change also needs a majority of the vehicles that
    determined the cell and ``min_votes`` of them (DESIGN 4, "enough votes"). For one-hot tallies.

    A cell for which only UNDETERMINED was voted is UNDETERMINED; a change short of votes is UNDETERMINED.
    """
    determined = tally.copy()
    determined[..., CellState.UNDETERMINED] = 0
    states = decide(determined)
    states[(states == NO_VOTE) & (tally[..., CellState.UNDETERMINED] > 0)] = CellState.UNDETERMINED
    total = determined.sum(axis=-1)
    for change in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        votes = tally[..., change]
        short = (votes < min_votes * VOTE_UNIT) | (2 * votes <= total)
        states[(states == change) & short] = CellState.UNDETERMINED
    return states


def one_hot(states: U8) -> I32:
    """One vote for each cell's state: (...) uint8 -> (..., 5) int32; NO_VOTE gives none."""
    tally = np.zeros((*states.shape, N_STATES), dtype=np.int32)
    for state in CellState:
        tally[..., state] = (states == state) * VOTE_UNIT
    return tally


@numba.njit(cache=True, nogil=True)
def count_votes(states: U8) -> I32:
    """The sum of ``one_hot(states[v])`` over voters v without building any of them: the server's hot loop.

    ``states`` (voters, cells) uint8, C-contiguous -> (cells, 5) int32. Blocks of cells stay in the first cache.
    """
    voters, cells = states.shape
    tally = np.empty((cells, N_STATES), dtype=np.int32)
    block = 2048
    counts = np.empty((N_STATES, block), dtype=np.uint16)
    for start in range(0, cells, block):
        width = min(block, cells - start)
        counts[:, :] = 0
        for v in range(voters):
            row = states[v, start : start + width]
            for state in range(N_STATES):
                plane = counts[state]
                for c in range(width):
                    plane[c] += np.uint16(row[c] == state)
        for c in range(width):
            for state in range(N_STATES):
                tally[start + c, state] = np.int32(counts[state, c]) * VOTE_UNIT
    return tally


def to_wire(tally: I32) -> U16:
    """A tally as uint16 for a one-stage ballot; a cell that would overflow is scaled down as a whole."""
    peak = np.maximum(tally.max(axis=-1), 1)
    shift = np.maximum(0, np.ceil(np.log2(peak / 65535.0))).astype(np.int32)
    return (tally >> shift[..., None]).astype(np.uint16)
