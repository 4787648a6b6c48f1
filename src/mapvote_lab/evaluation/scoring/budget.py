"""Where the cells of a case went: each true changed cell found or lost, each false one made, and by what.

The first cause that holds is the one that counts, so that every cell has exactly one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from mapvote.core.types import F64, I32, I64, U8, U16, Bool, CellState
from mapvote_lab.evaluation.scoring.cells import CLASSES, UNSCORED, classes_of

OCCUPIED, EMPTY = CLASSES.index("changed_occupied"), CLASSES.index("changed_empty")
N_KINDS = 8
STANDS, FREE, NEW, GONE, FEW, HIDDEN, TALL_HIT, TALL = range(N_KINDS)
"""What a scan's vote was: one of the four states; undetermined by few points, or hidden; invalid in case 5 though it
had n_min points, or without them."""
FOUND = "found"
LOST_BUILT = (
    FOUND, "the map holds a point there", "window: points only from beyond the local grid",
    "moving-object filter took the points", "never hit", "never n_min points in a scan", "server outvotes",
    "invalid: the map is too tall", "scans with few points outvote", "occluded scans outvote", "empty scans outvote",
)  # fmt: skip
LOST_DEMOLISHED = (
    FOUND, "the map holds no point there", "server outvotes", "invalid: the map is too tall",
    "occluded in every scan", "scans with n_min points outvote", "scans with few points outvote",
    "occluded scans outvote", "no scan votes: hidden from all that abstain, or never in view",
)  # fmt: skip
FALSE_BUILT = (
    "it is changed-empty", "within a cell of a true one", "moving-object filter left a mover", "a car of one pass",
    "within a cell of what the map holds", "old surface, new to the map", "no surface there",
)  # fmt: skip
FALSE_DEMOLISHED = (
    "it is changed-occupied", "within a cell of a true one", "a tree's crown, seen below",
    "tall structure: the map begins above 1.5 m", "a car that stays", "no surface there: a trail or noise in the map",
    "what stands was seldom hit",
)  # fmt: skip
_TALL_M = 1.5


@dataclass(frozen=True, slots=True)
class Witness:
    """What is known of each cell of the truth's window; planes (rows, cols)."""

    votes: I32
    """(vehicles, rows, cols, 8) votes by kind."""
    own: Sequence[U8]
    """What each vehicle decided."""
    mapped: Bool
    begins_m: F64
    """Height of the map's lowest obstacle point above the ground; inf where there is none."""
    taken: U16
    passed_off: U16
    beyond: U16
    """Scans, see :class:`mapvote_lab.evaluation.experiments.kept.KeptDrive`, of all vehicles."""
    stands: Bool
    """A body that was there before and after has surface in the cell."""
    passing: Bool
    """A body of some passes only has."""
    crown: Bool
    parked: Bool
    """A tree, a car that stays has."""


class Share(msgspec.Struct, frozen=True):
    """A line of a budget."""

    cells: int
    percent: float
    """In tenths; those of a budget add up to 100.0."""


class Budget(msgspec.Struct, frozen=True):
    """Of one case against one truth; each a cause and its share, in the order in which they are asked."""

    true_changed_occupied: dict[str, Share]
    true_changed_empty: dict[str, Share]
    false_changed_occupied: dict[str, Share]
    false_changed_empty: dict[str, Share]


Causes = Mapping[str, tuple[Bool, U8, Sequence[str]]]
"""As :func:`causes` gives them."""


def causes(states: U8, truth: U8, seen: Witness) -> Causes:
    """By field of :class:`Budget`: (its cells (rows, cols), the number of each one's cause (cells,), the causes)."""
    decided = classes_of(states)
    scored = truth != UNSCORED
    asked = {
        "true_changed_occupied": (truth == OCCUPIED, _lost_built, LOST_BUILT),
        "true_changed_empty": (truth == EMPTY, _lost_demolished, LOST_DEMOLISHED),
        "false_changed_occupied": (scored & (decided == OCCUPIED) & (truth != OCCUPIED), _false_built, FALSE_BUILT),
        "false_changed_empty": (scored & (decided == EMPTY) & (truth != EMPTY), _false_demolished, FALSE_DEMOLISHED),
    }
    out: dict[str, tuple[Bool, U8, Sequence[str]]] = {}
    for name, (cells, why, named) in asked.items():
        conditions = why(cells, states, truth, seen)
        out[name] = cells, np.select(conditions, range(len(conditions)), len(conditions)).astype(np.uint8), named
    return out


def budget(states: U8, truth: U8, seen: Witness) -> Budget:
    """``states`` as decided against ``truth``, both (rows, cols) over its window."""
    shares: dict[str, Mapping[str, Share]] = {}
    for name, (_, cause, named) in causes(states, truth, seen).items():
        cells = np.bincount(cause, minlength=len(named))
        shares[name] = {
            what: Share(int(n), tenths / 10) for what, n, tenths in zip(named, cells, in_tenths(cells), strict=True)
        }
    return msgspec.convert(shares, Budget)


def in_tenths(counts: I64) -> list[int]:
    """Tenths of a percent of each count, by largest remainders: they add up to 1000 unless nothing is counted."""
    total = int(counts.sum())
    if total == 0:
        return [0] * len(counts)
    whole, rest = np.divmod(counts.astype(np.int64) * 1000, total)
    largest = np.lexsort((np.arange(len(rest)), -rest))[: 1000 - int(whole.sum())]
    whole[largest] += 1
    return [int(tenths) for tenths in whole]


def _near(cells: Bool) -> Bool:
    """Cells that are, or lie next to, one of ``cells``: of the eight around."""
    wide = np.pad(cells, 1)
    rows, cols = cells.shape
    return np.any([wide[i : i + rows, j : j + cols] for i in range(3) for j in range(3)], axis=0)


def _outvoted(at: Bool, seen: Witness, *kinds: int) -> list[Bool]:
    """Which of ``kinds`` has most votes of all vehicles, for each; the first of equals."""
    pooled = seen.votes.sum(axis=0)[at][:, list(kinds)]
    return [pooled.argmax(axis=1) == k for k in range(len(kinds))]


def _lost_built(at: Bool, states: U8, truth: U8, seen: Witness) -> list[Bool]:
    votes = seen.votes.sum(axis=0)[at]
    reached = votes[:, NEW] > 0
    hit = reached | (votes[:, FEW] > 0) | (votes[:, TALL_HIT] > 0)
    invalid = (votes[:, TALL_HIT] > 0) & ~reached
    said = np.any([own[at] == CellState.CHANGED_OCCUPIED for own in seen.own], axis=0)
    beyond, taken = seen.beyond[at] > 0, seen.taken[at] > 0
    few, hidden, _ = _outvoted(at, seen, FEW, HIDDEN, FREE)
    return [
        states[at] == CellState.CHANGED_OCCUPIED, seen.mapped[at], ~reached & ~invalid & beyond,
        ~reached & ~invalid & taken, ~hit, ~reached & ~invalid, said, invalid, few, hidden,
    ]  # fmt: skip


def _lost_demolished(at: Bool, states: U8, truth: U8, seen: Witness) -> list[Bool]:
    votes = seen.votes.sum(axis=0)[at]
    said = np.any([own[at] == CellState.CHANGED_EMPTY for own in seen.own], axis=0)
    invalid = (votes[:, TALL_HIT] + votes[:, TALL] > 0) & (votes[:, GONE] == 0)
    only_hidden = (votes[:, HIDDEN] > 0) & (votes[:, [STANDS, GONE, FEW]].sum(axis=1) == 0)
    in_view = votes.sum(axis=1) > 0
    stands, few, hidden = _outvoted(at, seen, STANDS, FEW, HIDDEN)
    return [
        states[at] == CellState.CHANGED_EMPTY, ~seen.mapped[at], said, invalid, only_hidden,
        in_view & stands, in_view & few, in_view & hidden,
    ]  # fmt: skip


def _false_built(at: Bool, states: U8, truth: U8, seen: Witness) -> list[Bool]:
    return [
        truth[at] == EMPTY, _near(truth == OCCUPIED)[at], seen.passed_off[at] > 0, seen.passing[at],
        _near(seen.mapped)[at], seen.stands[at],
    ]  # fmt: skip


def _false_demolished(at: Bool, states: U8, truth: U8, seen: Witness) -> list[Bool]:
    tall = seen.begins_m[at] > _TALL_M
    return [
        truth[at] == OCCUPIED, _near(truth == EMPTY)[at], tall & seen.crown[at], tall, seen.parked[at],
        ~_near(seen.stands)[at],
    ]  # fmt: skip
