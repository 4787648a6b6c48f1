"""How sure vehicles are of changed cells, and of how many the word can be taken.

Votes decide; how sure those are who gave them refines the probability of what was decided. One of them may lie, so what
is taken is what the quorum says at least: of those who voted for a change the median, the lower one of two, and never
more than so many say as the quorum has. As one of the quorum is honest, nobody talks a probability up beyond what an
honest vehicle said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mapvote.codec.arrays import unpack_plane
from mapvote.codec.odds import UNSAID, changed_cells_of, pack_odds
from mapvote.core.grid import CELLS
from mapvote.core.types import I8, I64, U8, Bool


@dataclass(frozen=True, slots=True)
class Odds:
    """Of some cells of a tile how sure one is of them; of all others nothing is said."""

    cells: I64
    """(n,) flat cells of the tile, ascending."""
    steps: I8
    """(n,) log-odds, see codec/odds.py."""

    @classmethod
    def none(cls) -> Odds:
        """Nothing is said."""
        return cls(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int8))

    @classmethod
    def of(cls, states: U8, steps: I8 | None) -> Odds | None:
        """Of the cells that ``states`` (256, 256) call changed, in their order; None where ``steps`` is."""
        return None if steps is None else cls(changed_cells_of(states), steps)

    def at(self, cells: I64) -> I8:
        """(m,) what is said of flat ``cells`` (m,); UNSAID where nothing is."""
        plane = np.full(CELLS, UNSAID, dtype=np.int8)
        plane[self.cells] = self.steps
        return plane[cells]

    def within(self, mine: Bool) -> Odds:
        """Only those of the flat cells given (65536,)."""
        keep = mine[self.cells]
        return Odds(self.cells[keep], self.steps[keep])


class Sure(Protocol):
    """A vote that may say how sure its vehicle is."""

    @property
    def states(self) -> U8 | None: ...
    @property
    def odds(self) -> Odds | None: ...


def folded(drives: Sequence[Sure], last: Sequence[Bool]) -> Odds | None:
    """What a vehicle's ``drives`` say, each in the flat cells (65536,) in which it has the ``last`` word; None if none
    of them says anything."""
    parts = [drive.odds.within(mine) for drive, mine in zip(drives, last, strict=True) if drive.odds is not None]
    if not parts:
        return None
    cells = np.concatenate([part.cells for part in parts])
    order = np.argsort(cells)
    return Odds(cells[order], np.concatenate([part.steps for part in parts])[order])


def agreed_odds(votes: Sequence[Sure], states: U8, quorum: int) -> Odds:
    """Of the cells decided as changed, ``states`` (256, 256): what can be taken of what those say who voted for it, one
    of ``votes`` a vehicle. Of a cell of which fewer than ``quorum`` say how sure they are nothing is said."""
    cells = changed_cells_of(states)
    saying = [vote for vote in votes if vote.odds is not None and vote.states is not None]
    if len(saying) < max(quorum, 1) or not len(cells):
        return Odds.none()
    decided = states.reshape(-1)[cells]
    said = np.full((len(saying), len(cells)), UNSAID, dtype=np.int8)
    for row, vote in zip(said, saying, strict=True):
        assert vote.odds is not None
        assert vote.states is not None
        row[:] = np.where(vote.states.reshape(-1)[cells] == decided, vote.odds.at(cells), UNSAID)
    said.sort(axis=0)
    tellers = (said != UNSAID).sum(axis=0)
    rank = np.maximum(tellers // 2 + 1, max(quorum, 1))
    enough = np.flatnonzero(tellers >= rank)
    return Odds(cells[enough], said[len(saying) - rank[enough], enough])


def pack_agreed(odds: Odds, states: U8) -> bytes | None:
    """What is taken of the cells that ``states`` (256, 256) call changed, a byte each in their order, UNSAID among
    them; None where nothing is said of any."""
    steps = odds.at(changed_cells_of(states))
    return pack_odds(steps) if (steps != UNSAID).any() else None


def unpack_agreed(data: bytes | None, states: U8) -> Odds:
    """The inverse of :func:`pack_agreed`; MapvoteError if damaged."""
    cells = changed_cells_of(states)
    return Odds.none() if data is None else Odds(cells, unpack_plane(data, "<i1", (len(cells),), "decision: odds"))
