"""Which ballots of a tile do not count: outliers and copies (docs/decisions/voting.md).

Outliers. A vehicle does not count if it contradicts, nearly everywhere, what k + 1 others agree on, or nearly every
change that k + 1 vehicles back there (it replays the old street, or saw it last). Of k + 1 vehicles at least one is
honest, so k liars cannot exclude an honest vehicle. An honest vehicle differs from another in some per cent of the
cells; a demolished block is some per cent of a tile. An excluded vehicle was one of the k, so k falls by one.

Copies. Drives of two vehicles whose masks agree more than independent drives can count as one. The cells that a drive
determines end where its rays thin out, where traffic stood in the way, where it turned off: two drives down one lane
have different borders. So two masks *differ* in the cells that one determined and the other did not determine within
one cell, or the other way round. The measure is the share of the cells by which the smaller mask would differ from
itself if it were shifted by three cells (.9 m) north or east. A copy differs in no cell, nor does a copy of which every
cell was moved by one. Honest vehicles stay well above the bound (docs/measurements/votes.md).

Of several copies the one counts that agrees best with all others: moved or added cells agree less. At most one of their
vehicles is honest. So all but one of those that do not count are liars for sure, and the quorum falls by as many.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.config import FuseSettings
from mapvote.core.grid import TILE_CELLS
from mapvote.core.kernel import inlined, kernel
from mapvote.core.tile import Tile
from mapvote.core.types import I64, N_STATES, NO_VOTE, U8, U64, Bool, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.fusion.tile_vote import TileVote

_ASKED_CELLS = slice(None, None, 13)
"""The flat cells compared, enough for a share; the stride divides no tile's side, so that no column is left out."""
_MIN_ASKED = 64
"""With fewer cells no vehicle is judged: 75 m2 that the others agree on, or 6 m2 of changes."""
_CO, _CE, _UN = (int(CellState[name]) for name in ("CHANGED_OCCUPIED", "CHANGED_EMPTY", "UNDETERMINED"))
_ASKED, _AGREED, _OPPOSED = 0b1, 0b10, 0b100


def contradictors(
    votes: Sequence[TileVote], states: U8, tally: NDArray[Any], quorum: int, settings: FuseSettings
) -> Bool:
    """(n,) which of the votes :func:`contradicts` names, by all that they say; ``tally`` (256, 256, 5)
    in VOTE_UNITs of all of them, a vote each."""
    if settings.max_contradiction >= 1.0:
        return np.zeros(len(votes), dtype=np.bool_)
    planes = np.moveaxis(tally, -1, 0).reshape(N_STATES, -1)
    others, most = others_say(planes[:, _ASKED_CELLS], quorum), settings.max_contradiction
    own = (vote.states.reshape(-1)[_ASKED_CELLS] for vote in votes if vote.states is not None)
    return np.array([contradicts(one, others, most) for one in own], dtype=np.bool_)


def deniers(
    votes: Sequence[TileVote],
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


def borne_out(votes: Sequence[TileVote], tile: Tile) -> I64:
    """(n,) in how many cells each vote no longer counts because the map is now as voted: built on, or empty."""
    found, holds = np.zeros(len(votes), dtype=np.int64), tile.obstacle_words.reshape(-1)
    for i, vote in enumerate(votes):
        if vote.unrestricted is not None and vote.states is not None:
            sent = vote.unrestricted.reshape(-1)
            spent = np.flatnonzero((vote.states.reshape(-1) == NO_VOTE) & ((sent == _CO) | (sent == _CE)))
            found[i] = np.count_nonzero((sent[spent] == _CO) == (holds[spent] != 0))
    return found


@kernel
def contradicts(own: U8, others: U8, most: float) -> bool:
    """Whether a vehicle's ``own`` states (asked,) oppose the ``others`` (asked, 8), see :func:`others_say`, in more
    than ``most`` of the cells they agree on.

    It is judged only if a majority of the others, and at least the quorum, agree on most cells that so many of them
    determined.
    """
    asked, agreed, opposed = 0, 0, 0
    for i in range(len(others)):
        said = others[i, own[i] & 7]
        asked += said & 1
        agreed += (said >> 1) & 1
        opposed += said >> 2
    return bool(agreed >= _MIN_ASKED and 2 * agreed > asked and opposed > most * agreed)


def denying(states: U8, decided: U8, most: float, came_true: I64) -> Bool:
    """(n,) which vehicles' ``states`` (n, cells) deny more than ``most`` of the changes that were ``decided`` (cells,).

    The cells ``came_true`` (n,), which the map has since changed as voted, count as not denied. Without them a vehicle
    that backed all that was published would be judged by the few remaining changes, those that wait for it. A vehicle
    that determined fewer than 64 of these cells is not judged.
    """
    determined = states < _UN
    denied = (determined & (states != decided)).sum(axis=1)
    asked = determined.sum(axis=1) + came_true
    return np.asarray((asked >= _MIN_ASKED) & (denied > most * asked))


def others_say(tally: NDArray[Any], quorum: int) -> U8:
    """(asked, 8) what the others vote on a cell, by the last three bits of a vehicle's own vote there.

    _ASKED if ``quorum`` of them determined it, _AGREED if more than half of those, and as many, agree, _OPPOSED if they
    disagree with the vehicle. None for a vehicle that left the cell undetermined (4) or has no vote there (7).
    """
    said = np.zeros((tally.shape[1], 8), dtype=np.uint8)
    least = quorum * VOTE_UNIT
    total = tally[:_UN].sum(axis=0, dtype=np.int32) - VOTE_UNIT  # whatever the vehicle's own vote is
    asked = np.flatnonzero(total >= least)
    total = total[asked]
    votes = tally[:_UN].take(asked, axis=1).astype(np.int32)  # class by class in memory, as indexing would not leave it
    for own in range(_UN):
        votes[own] -= VOTE_UNIT
        best = votes.max(axis=0)
        agreed = (2 * best > total) & (best >= max(least, 1))
        said[asked, own] = _ASKED | _AGREED * agreed | _OPPOSED * (agreed & (votes[own] != best))
        votes[own] += VOTE_UNIT
    return said


LEAST_MOVED = 200
"""Cells, in the rows compared. Masks that a shift of three cells changes less are not judged: small masks, and masks
with more holes than ground, are alike by chance."""
_LAST = TILE_CELLS - 1
_APART = 3
"""Cells; and one of so many rows is compared, which is enough for a share."""
_RIM = 1
"""Columns on either side that are not compared."""
_COMPARED_CELLS = slice(None, None, 7)


@dataclass(frozen=True, slots=True)
class Copy:
    """A drive that does not count on a tile, because another one that is alike does."""

    vehicle: str
    digest: str
    """Of its ballot."""
    heard_vehicle: str
    heard_digest: str

    def __str__(self) -> str:
        return (
            f"{self.vehicle}'s ballot {self.digest[:12]} is a copy of {self.heard_vehicle}'s {self.heard_digest[:12]}"
        )


def originals(drives: Sequence[TileVote], settings: FuseSettings) -> tuple[Sequence[TileVote], list[Copy]]:
    """(the ``drives`` of a tile without copies, the copies); their order never matters.

    Drives of two vehicles that differ by less than ``min_difference`` are copies. Nothing is judged where
    one vehicle may change the map, nor drives that send tallies.
    """
    judged = [drive for drive in drives if drive.sent is not None]
    if settings.min_votes < 2 or settings.min_difference <= 0.0 or len({drive.vehicle for drive in judged}) < 2:
        return drives, []
    judged.sort(key=lambda drive: (drive.end_ns, drive.digest))
    number = {name: i for i, name in enumerate(sorted({drive.vehicle for drive in judged}))}
    whose = np.array([number[drive.vehicle] for drive in judged])
    masks = masks_of([drive.sent for drive in judged if drive.sent is not None])
    group = np.arange(len(masks))
    find_alike(*_look(masks), whose, settings.min_difference, group)
    copies = []
    for first in np.flatnonzero(np.bincount(group) > 1):
        alike = [drive for drive, own in zip(judged, group, strict=True) if own == first]
        others = [drive for drive, own in zip(judged, group, strict=True) if own != first]
        heard = max(alike, key=lambda drive: _agreement(drive, others))
        copies += [Copy(d.vehicle, d.digest, heard.vehicle, heard.digest) for d in alike if d is not heard]
    return without(copies, drives), copies


def without(copies: Sequence[Copy], drives: Sequence[TileVote]) -> Sequence[TileVote]:
    """The ``drives`` that are none of these copies."""
    silent = {(copy.vehicle, copy.digest) for copy in copies}
    return [drive for drive in drives if (drive.vehicle, drive.digest) not in silent]


def liars_among(copies: Sequence[Copy], heard: Sequence[TileVote]) -> int:
    """How many vehicles excluded by ``copies`` on a tile lie for sure: all but one of those that are alike. ``heard``:
    the remaining drives."""
    silent = {copy.vehicle for copy in copies} - {drive.vehicle for drive in heard}
    groups = {copy.heard_digest for copy in copies if copy.vehicle in silent}
    return max(0, len(silent) - len(groups))


def masks_of(planes: Iterable[U8]) -> U64:
    """(n, 256, 4) words of what n planes of states determined, the first column in the lowest bit."""
    # Of all states only 4 (undetermined) and 255 (no vote) have the third bit set.
    bits = [np.packbits((plane & np.uint8(4)) == 0, bitorder="little") for plane in planes]
    return np.concatenate(bits).view(np.uint64).reshape(len(bits), TILE_CELLS, TILE_CELLS // 64)


def _agreement(drive: TileVote, others: Sequence[TileVote]) -> int:
    """How many more of the others' votes a drive agrees with than it opposes."""
    assert drive.sent is not None
    own, total = drive.sent.reshape(-1)[_COMPARED_CELLS], 0
    for other in others:
        assert other.sent is not None
        said = other.sent.reshape(-1)[_COMPARED_CELLS]
        both = (own < _UN) & (said < _UN)
        total += 2 * int((both & (own == said)).sum()) - int(both.sum())
    return total


@kernel
def find_alike(moved: I64, looked: U64, whose: I64, least: float, group: I64) -> None:
    """Into ``group`` (n,), which holds 0 to n - 1, the first of all drives that are alike to a drive, or to one that is
    alike to it, and so on. ``moved``, ``looked``: see :func:`_look`; ``whose`` (n,): the vehicles."""
    for i in range(len(moved)):
        for k in range(i):
            whole = min(moved[i], moved[k])
            if whose[i] == whose[k] or group[i] == group[k] or whole < LEAST_MOVED:
                continue
            most = int(np.ceil(least * whole)) - 1
            if _differing(looked[i], looked[k], np.int64(_RIM), most) <= most:
                older, newer = min(group[i], group[k]), max(group[i], group[k])
                for other in range(i + 1):
                    if group[other] == newer:
                        group[other] = older


def _look(masks: U64) -> tuple[I64, U64]:
    """Of masks (n, 256, 4), in the rows compared: by how many cells each would differ from itself if shifted (n,), and
    (n, 85, 3, 4) words: what is set, what is or has a neighbour that is, and what is and has none that is not."""
    looked = np.empty((len(masks), len(range(1, _LAST, _APART)), 3, 4), np.uint64)
    moved, east = np.empty(len(masks), np.int64), np.empty_like(looked[0])
    _look_at(masks, looked, moved, east)
    return moved, looked


@kernel
def _look_at(masks: U64, looked: U64, moved: I64, east: U64) -> None:
    """:func:`_look` into ``looked`` and ``moved``; ``east`` (85, 3, 4): scratch."""
    for i in range(len(masks)):
        for n in range(looked.shape[1]):
            row = 1 + _APART * n
            for w in range(4):
                some, every = np.uint64(0), ~np.uint64(0)
                for r in range(row - 1, row + 2):
                    here, west = masks[i, r, w], _moved_east(masks[i, r], w, 1)
                    right = (here >> np.uint64(1)) | (masks[i, r, w + 1] << np.uint64(63) if w < 3 else np.uint64(0))
                    some |= here | west | right
                    every &= here & west & right
                looked[i, n, 0, w], looked[i, n, 1, w], looked[i, n, 2, w] = masks[i, row, w], some, every
            for plane in range(3):
                for w in range(4):
                    east[n, plane, w] = _moved_east(looked[i, n, plane], w, _APART)
        north = _differing(looked[i, 1:], looked[i, :-1], np.int64(_RIM), TILE_CELLS**2)
        moved[i] = (north + _differing(looked[i], east, _RIM + _APART, TILE_CELLS**2)) // 2


@inlined
def _moved_east(row: U64, w: int, by: int) -> np.uint64:
    """Word ``w`` of a row of words (4,) that is moved by so many columns to the east."""
    carried = row[w - 1] >> np.uint64(64 - by) if w else np.uint64(0)
    return (row[w] << np.uint64(by)) | carried


@kernel
def _differing(a: U64, b: U64, rim: int, most: int) -> np.int64:
    """In how many cells two masks (rows, 3, 4) differ, but for ``rim`` columns on either side; once they are more than
    ``most``, some number above that."""
    count = np.int64(0)
    for n in range(len(a)):
        for w in range(4):
            word = (a[n, 0, w] & ~b[n, 1, w]) | (~a[n, 0, w] & b[n, 2, w])
            word |= (b[n, 0, w] & ~a[n, 1, w]) | (~b[n, 0, w] & a[n, 2, w])
            if w == 0:
                word &= ~np.uint64(0) << np.uint64(rim)
            if w == 3:
                word &= ~np.uint64(0) >> np.uint64(rim)
            # How many bits are set (Warren, Hacker's Delight, 5-1).
            word -= (word >> np.uint64(1)) & np.uint64(0x5555555555555555)
            twos = np.uint64(0x3333333333333333)
            word = (word & twos) + ((word >> np.uint64(2)) & twos)
            word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
            count += np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))
        if count > most:
            break
    return count
