"""How likely it is that a cell decided as changed did change, and that emptying it takes something that stands.

Both are logistic curves, calibrated on simulated streets, whose truth is known. The first is over how sure those are
who say so (fusion/odds.py) or, where they do not say, over how many vehicles say so, how many say otherwise, and how
many of the eight cells around changed likewise. It judges cells: at the rim of a thing that did change, centimetres
decide which of two cells holds its surface, and that does no harm to the map. The second asks for harm: whether a point
is deleted that lies on a surface that still stands. Such cells are few, so it has few parameters; nearly all lie before
a wall that stands, where range noise put some of its points and rays pass now.

docs/measurements/probability.md has what was fitted, on what, and how it does elsewhere.
"""

from __future__ import annotations

import numpy as np

from mapvote.codec.odds import UNSAID, in_nats
from mapvote.core.types import F64, I8, I32, I64, U8, CellState

_MOST_VOTES = 3
"""It was fitted to three vehicles: what more of them say is told as if three did."""

# By votes alone, of ballots that do not say how sure their vehicle is: of columns, and of older formats.
_BUILT = np.array([-0.78, 1.13, -0.01, 2.96])
_DEMOLISHED = np.array([-1.37, 1.15, -0.57, 3.18])
"""Log-odds of a lone cell with two votes for it and none against; what a third adds, one against, eight such cells."""
# By benchmarks/probability.py, as are those below.
_BUILT_SAID = np.array([0.752, 1.166])
_DEMOLISHED_SAID = np.array([0.31, 1.012])
"""Log-odds of a cell of which they say that it is as likely as not; of each nat that they say."""
_FALSE_DELETION = np.array([-9.03, 5.668])
"""Log-odds that something that stands goes with a cell beside which nothing stands; what a row of STANDING adds."""
_FALSE_DELETION_SAID = np.array([-8.481, 5.043, -0.294])
"""The same, and of a nat that they say."""
STANDING = 3
"""Cells that stand beside one: so many are a row of a wall, before which noise put points; more add nothing."""


def change_probability(
    states: U8, votes: I32 | I64, against: I32 | I64, beside: I32 | I64, odds: I8 | None = None
) -> F64:
    """(n,) probability that cells decided as ``states``, CHANGED_OCCUPIED or CHANGED_EMPTY, did change: vehicles that
    say so, vehicles that say otherwise (not: undetermined), how many of the eight cells around changed likewise, and
    how sure they are, UNSAID where nobody says; (n,) each."""
    built = (states == CellState.CHANGED_OCCUPIED)[:, None]
    more = np.minimum(votes, _MOST_VOTES) - 2.0
    told = np.column_stack([np.ones(len(states)), more, against, np.asarray(beside, dtype=np.float64) / 8.0])
    alone = (np.where(built, _BUILT, _DEMOLISHED) * told).sum(axis=1)
    if odds is None:
        return _logistic(alone)
    curve = np.where(built, _BUILT_SAID, _DEMOLISHED_SAID)
    return _logistic(np.where(odds == UNSAID, alone, curve[:, 0] + curve[:, 1] * in_nats(odds)))


def false_deletion_probability(standing: I32 | I64, odds: I8) -> F64:
    """(n,) probability that of what goes with cells decided changed-empty something still stands: by how many of the
    eight cells around are decided to stand, and how sure the vehicles are, UNSAID where nobody says; (n,) each."""
    row = np.minimum(standing, STANDING) / STANDING
    alone = _FALSE_DELETION[0] + _FALSE_DELETION[1] * row
    curve = _FALSE_DELETION_SAID
    return _logistic(np.where(odds == UNSAID, alone, curve[0] + curve[1] * row + curve[2] * in_nats(odds)))


def _logistic(log_odds: F64) -> F64:
    return np.asarray(1.0 / (1.0 + np.exp(-log_odds)))


def alike_beside(rows: I64, cols: I64, kinds: I64) -> I32:
    """(n,) how many of the eight cells around each of n different cells are among them and of the same kind."""
    if not len(rows):
        return np.zeros(0, dtype=np.int32)
    high, wide = int(rows.min()), int(cols.min())
    width = int(cols.max()) - wide + 3
    step = int(kinds.max()) + 1
    keys = ((rows - high + 1) * width + cols - wide + 1) * step + kinds
    around = [(i * width + j) * step for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    return np.sum([np.isin(keys + offset, keys) for offset in around], axis=0, dtype=np.int32)
