"""Scores against the truth: cells (paper V, Tables II-IV), points of the map, objects.

Every ratio is 0.0 where nothing is counted (0/0 = 0), so that no score is ever NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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


@dataclass(frozen=True, slots=True)
class Scores:
    """Precision and recall of the three classes, in the order of :data:`CLASSES`."""

    precision: tuple[float, float, float]
    recall: tuple[float, float, float]

    @property
    def f1(self) -> tuple[float, float, float]:
        p, r = self.precision, self.recall
        return harmonic_mean(p[0], r[0]), harmonic_mean(p[1], r[1]), harmonic_mean(p[2], r[2])

    @property
    def macro_f1(self) -> float:
        """Unweighted mean of the three F1: what Table IV holds (docs/decisions/paper.md)."""
        return sum(self.f1) / 3.0

    @property
    def kim_f1(self) -> float:
        """Harmonic mean of mean precision and mean recall, as Kim et al. [15] report it."""
        return harmonic_mean(sum(self.precision) / 3.0, sum(self.recall) / 3.0)

    def to_dict(self) -> dict[str, object]:
        """R of ``evaluate --json``."""
        return {
            "precision": dict(zip(CLASSES, self.precision, strict=True)),
            "recall": dict(zip(CLASSES, self.recall, strict=True)),
            "f1": dict(zip(CLASSES, self.f1, strict=True)),
            "macro_f1": self.macro_f1,
            "kim_f1": self.kim_f1,
        }


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
    p = [ratio(right[k], decided[k]) for k in range(3)]
    r = [ratio(right[k], true[k]) for k in range(3)]
    return Scores((p[0], p[1], p[2]), (r[0], r[1], r[2]))


def determined(states: U8) -> Bool:
    """Cells with one of the four states that say something: neither undetermined nor never seen."""
    return (states != CellState.UNDETERMINED) & (states != NO_VOTE)


def coverage(vehicle_states: Sequence[U8], truth: U8) -> float:
    """Share of the scored truth cells that at least one vehicle determined."""
    seen = np.zeros(truth.shape, dtype=np.bool_)
    for states in vehicle_states:
        seen |= determined(states)
    scored = truth != UNSCORED
    return ratio(np.count_nonzero(seen & scored), np.count_nonzero(scored))
