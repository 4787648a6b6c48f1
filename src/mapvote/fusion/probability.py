"""How likely it is that a cell decided as changed did change: calibrated on simulated streets, whose truth is known.

A logistic curve over what a server knows of any change: how many vehicles say so, how many say otherwise, and how many
of the eight cells around changed likewise. It was fitted to the decisions of three vehicles on a corner (seeds 1 and 2)
and a street (seed 2), each scene weighed alike, and checked on others: docs/measurements/probability.md. It judges
cells: at the rim of a thing that did change, centimetres decide which of two cells holds its surface.
"""

from __future__ import annotations

import numpy as np

from mapvote.core.types import F64, I32, I64, U8, CellState

_BUILT = np.array([-0.78, 1.13, -0.01, 2.96])
_DEMOLISHED = np.array([-1.37, 1.15, -0.57, 3.18])
"""Log-odds of a lone cell with two votes for it and none against; what a third adds, one against, eight such cells."""
_MOST_VOTES = 3
"""It was fitted to three vehicles: what more of them say is told as if three did."""


def change_probability(states: U8, votes: I32 | I64, against: I32 | I64, beside: I32 | I64) -> F64:
    """(n,) probability that cells decided as ``states``, CHANGED_OCCUPIED or CHANGED_EMPTY, did change: vehicles that
    say so, vehicles that say otherwise (not: undetermined), and how many of the eight cells around changed likewise;
    (n,) each."""
    curve = np.where((states == CellState.CHANGED_OCCUPIED)[:, None], _BUILT, _DEMOLISHED)
    told = [
        np.ones(len(states)),
        np.minimum(votes, _MOST_VOTES) - 2.0,
        against,
        np.asarray(beside, dtype=np.float64) / 8.0,
    ]
    return np.asarray(1.0 / (1.0 + np.exp(-(curve * np.column_stack(told)).sum(axis=1))))


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
