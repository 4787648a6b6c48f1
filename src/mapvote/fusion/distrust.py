"""Which vehicles do not count on a tile because they oppose the others (docs/decisions/voting.md).

A vehicle does not count if it contradicts, nearly everywhere, what k + 1 others agree on, or nearly every change that k
+ 1 vehicles back there (it replays the old street, or saw it last). At least one of k + 1 vehicles is honest, so k
liars cannot exclude an honest vehicle. An honest vehicle differs from another in some per cent of the cells; a
demolished block is some per cent of a tile. An excluded vehicle was one of the k, so k falls by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.config import FuseSettings
from mapvote.core.kernel import kernel
from mapvote.core.tile import Tile
from mapvote.core.types import I64, N_STATES, NO_VOTE, U8, Bool, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.fusion.tile_vote import Vote

_ASKED_CELLS = slice(None, None, 13)
"""The flat cells compared, enough for a share; the stride divides no tile's side, so that no column is left out."""
_MIN_ASKED = 64
"""With fewer cells no vehicle is judged: 75 m2 that the others agree on, or 6 m2 of changes."""
_CO, _CE, _UN = (int(CellState[name]) for name in ("CHANGED_OCCUPIED", "CHANGED_EMPTY", "UNDETERMINED"))
_ASKED, _AGREED, _OPPOSED = 0b1, 0b10, 0b100


def contradictors(votes: Sequence[Vote], states: U8, tally: NDArray[Any], quorum: int, settings: FuseSettings) -> Bool:
    """(n,) which of the votes :func:`contradicts` names, by all that they say; ``tally`` (256, 256, 5)
    in VOTE_UNITs of all of them, a vote each."""
    if settings.max_contradiction >= 1.0:
        return np.zeros(len(votes), dtype=np.bool_)
    planes = np.moveaxis(tally, -1, 0).reshape(N_STATES, -1)
    others = others_say(planes[:, _ASKED_CELLS], quorum)
    most = settings.max_contradiction
    own = (vote.states.reshape(-1)[_ASKED_CELLS] for vote in votes if vote.states is not None)
    return np.array([contradicts(one, others, most) for one in own], dtype=np.bool_)


def deniers(
    votes: Sequence[Vote],
    states: U8,
    tally: NDArray[Any],
    quorum: int,
    settings: FuseSettings,
    tile: Tile | None,
) -> Bool:
    """(n,) which of the votes :func:`denying` names, of the changes among the decided ``states`` (256, 256); ``tile``:
    as it is now, None if no vote on it is spent."""
    changed = np.flatnonzero((states == _CO) | (states == _CE))
    if settings.max_denial >= 1.0 or not len(changed):
        return np.zeros(len(votes), dtype=np.bool_)
    came_true = np.zeros(len(votes), dtype=np.int64) if tile is None else borne_out(votes, tile)
    said = np.stack([vote.states.reshape(-1)[changed] for vote in votes if vote.states is not None])
    return denying(said, states.reshape(-1)[changed], settings.max_denial, came_true)


def borne_out(votes: Sequence[Vote], tile: Tile) -> I64:
    """(n,) in how many cells each vote no longer counts because the map is now as voted: built on, or empty."""
    counts = np.zeros(len(votes), dtype=np.int64)
    holds = tile.obstacle_words.reshape(-1)
    for i, vote in enumerate(votes):
        if vote.unrestricted is not None and vote.states is not None:
            sent = vote.unrestricted.reshape(-1)
            spent = np.flatnonzero((vote.states.reshape(-1) == NO_VOTE) & ((sent == _CO) | (sent == _CE)))
            counts[i] = np.count_nonzero((sent[spent] == _CO) == (holds[spent] != 0))
    return counts


@kernel
def contradicts(own: U8, others: U8, most: float) -> bool:
    """Whether a vehicle's ``own`` states (asked,) oppose the ``others`` (asked, 8), see :func:`others_say`, in more
    than ``most`` of the cells they agree on.

    It is judged only if a majority of the others, and at least the quorum, agree on most cells that so many of them
    determined.
    """
    compared = 0
    agreed = 0
    opposed = 0
    for i in range(len(others)):
        said = others[i, own[i] & 7]
        compared += said & 1
        agreed += (said >> 1) & 1
        opposed += said >> 2
    return bool(agreed >= _MIN_ASKED and 2 * agreed > compared and opposed > most * agreed)


def denying(states: U8, decided: U8, most: float, came_true: I64) -> Bool:
    """(n,) which vehicles' ``states`` (n, cells) deny more than ``most`` of the changes that were ``decided`` (cells,).

    The cells ``came_true`` (n,), which the map has since changed as voted, count as not denied. Without them a vehicle
    that backed all that was published would be judged by the few remaining changes, those that wait for it. A vehicle
    that determined fewer than 64 of these cells is not judged.
    """
    determined = states < _UN
    denied = (determined & (states != decided)).sum(axis=1)
    changes = determined.sum(axis=1) + came_true
    return np.asarray((changes >= _MIN_ASKED) & (denied > most * changes))


def others_say(tally: NDArray[Any], quorum: int) -> U8:
    """(asked, 8) what the others vote on a cell, by the last three bits of a vehicle's own vote there.

    _ASKED if ``quorum`` of them determined it, _AGREED if more than half of those, and as many, agree, _OPPOSED if they
    disagree with the vehicle. None for a vehicle that left the cell undetermined (4) or has no vote there (7).
    """
    said = np.zeros((tally.shape[1], 8), dtype=np.uint8)
    least = quorum * VOTE_UNIT
    total = tally[:_UN].sum(axis=0, dtype=np.int32) - VOTE_UNIT  # whatever the vehicle's own vote is
    cells = np.flatnonzero(total >= least)
    total = total[cells]
    votes = tally[:_UN].take(cells, axis=1).astype(np.int32)  # class by class in memory, as indexing would not leave it
    for own in range(_UN):
        votes[own] -= VOTE_UNIT
        best = votes.max(axis=0)
        agreed = (2 * best > total) & (best >= max(least, 1))
        said[cells, own] = _ASKED | _AGREED * agreed | _OPPOSED * (agreed & (votes[own] != best))
        votes[own] += VOTE_UNIT
    return said
