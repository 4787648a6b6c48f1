"""Scores against the truth: cells (paper V, Tables II-IV), points of the map, objects.

Every ratio is 0.0 where nothing is counted (0/0 = 0), so that no score is ever NaN.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from mapvote.core.types import NO_VOTE, U8, Bool, CellState

CLASSES = ("unchanged", "changed_occupied", "changed_empty")
"""The paper's three scored classes; the position is the value in a truth grid."""
UNSCORED = 255
"""In a truth grid: this cell is not counted."""


def ratio(part: float | np.integer, whole: float | np.integer) -> float:
    """part / whole, 0.0 where whole is 0."""
    return float(part / whole) if whole else 0.0


def harmonic_mean(p: float, r: float) -> float:
    """2 p r / (p + r), the F1 score of one class; 0.0 if both are 0."""
    return ratio(2.0 * p * r, p + r)


class ByClass(msgspec.Struct, frozen=True):
    """A number for each of :data:`CLASSES`; iterates in their order."""

    unchanged: float
    changed_occupied: float
    changed_empty: float

    def __iter__(self) -> Iterator[float]:
        return iter((self.unchanged, self.changed_occupied, self.changed_empty))

    @property
    def mean(self) -> float:
        """Unweighted."""
        return sum(self) / 3.0


class Scores(msgspec.Struct, frozen=True):
    """Precision and recall of the three classes, and what follows from them; made by :meth:`of`."""

    precision: ByClass
    recall: ByClass
    f1: ByClass
    macro_f1: float
    """Unweighted mean of the three F1: what Table IV holds (docs/method.md)."""
    kim_f1: float
    """Harmonic mean of mean precision and mean recall, as Kim et al. [15] report it."""

    @classmethod
    def of(cls, precision: ByClass, recall: ByClass) -> Scores:
        """All scores from the two."""
        f1 = ByClass(*(harmonic_mean(p, r) for p, r in zip(precision, recall, strict=True)))
        return cls(precision, recall, f1, f1.mean, harmonic_mean(precision.mean, recall.mean))


def classes_of(states: U8) -> U8:
    """Five states to the three scored classes: undetermined and never seen count as unchanged."""
    out = np.zeros(states.shape, dtype=np.uint8)
    out[states == CellState.CHANGED_OCCUPIED] = 1
    out[states == CellState.CHANGED_EMPTY] = 2
    return out


def confusion(states: U8, truth: U8) -> NDArray[np.int64]:
    """(3, 3) cells by [truth class, decided class]; truth 255 is not counted. ValueError on different shapes."""
    if states.shape != truth.shape:
        raise ValueError(f"states {states.shape} and truth {truth.shape} are not the same window")
    scored = truth != UNSCORED
    pairs = truth[scored].astype(np.int64) * 3 + classes_of(states)[scored]
    return np.bincount(pairs, minlength=9).reshape(3, 3)


def score_cells(states: U8, truth: U8) -> Scores:
    """Precision and recall of decided ``states`` (CellState or NO_VOTE) against ``truth`` (0, 1, 2 or 255)."""
    table = confusion(states, truth)
    right, decided, true = np.diag(table), table.sum(axis=0), table.sum(axis=1)
    precision = ByClass(*(ratio(right[k], decided[k]) for k in range(3)))
    return Scores.of(precision, ByClass(*(ratio(right[k], true[k]) for k in range(3))))


def determined(states: U8) -> Bool:
    """Cells with one of the four states that say something: neither undetermined nor never seen."""
    return (states != CellState.UNDETERMINED) & (states != NO_VOTE)


def determined_share(vehicle_states: Sequence[U8], truth: U8) -> float:
    """Share of the scored truth cells that at least one vehicle determined."""
    seen = np.zeros(truth.shape, dtype=np.bool_)
    for states in vehicle_states:
        seen |= determined(states)
    scored = truth != UNSCORED
    return ratio(np.count_nonzero(seen & scored), np.count_nonzero(scored))
