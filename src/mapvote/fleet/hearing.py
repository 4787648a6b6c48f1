"""Who is not heard on a tile: a vehicle that says the opposite of the others nearly everywhere (DESIGN 4, liars).

A majority of 2k + 1 vehicles outvotes k that lie, but a change also needs only k + 1 to back it, and the k who lie lend
their votes to whatever error a single honest vehicle makes. Where the others agree among themselves over most of a
tile and one of them contradicts it over most of that, its votes say nothing of the world. An honest vehicle differs
in some per cent of the cells; a demolished block is some per cent of a tile.
"""

from __future__ import annotations

from typing import Any

import numba
from numpy.typing import NDArray

from mapvote.core.types import U8, CellState
from mapvote.core.voting import VOTE_UNIT

_STRIDE = 13
"""Every so many cells are asked, enough for a share; it divides no tile's side, so that no column is left out."""
_MIN_ASKED = 64
"""With fewer cells that the others agree on, nobody is judged: 75 m2."""
_UN = int(CellState.UNDETERMINED)


@numba.njit(cache=True, nogil=True)
def contradicts(states: U8, tally: NDArray[Any], most: float) -> bool:
    """Whether one vehicle's ``states`` (cells,) oppose the others in more than ``most`` of the cells they agree on.

    ``tally`` (5, cells) in VOTE_UNITs of all vehicles, this one included, a vote each. The others agree on a cell if at
    least two of them determined it, more than half of those alike; nothing is said of a vehicle unless they agree on
    most cells that two of them determined, so that k liars cannot make an honest vehicle look like one.
    """
    asked, agreed, opposed = 0, 0, 0
    for c in range(0, len(states), _STRIDE):
        own = states[c]
        if own >= _UN:  # undetermined, or no vote
            continue
        total, best, best_state = 0, 0, 0
        for state in range(_UN):
            votes = int(tally[state, c]) - (VOTE_UNIT if state == own else 0)
            total += votes
            if votes > best:
                best, best_state = votes, state
        if total < 2 * VOTE_UNIT:
            continue
        asked += 1
        if 2 * best > total:
            agreed += 1
            opposed += int(best_state != own)
    return agreed >= _MIN_ASKED and 2 * agreed > asked and opposed > most * agreed
