"""Points that a file marks as none of the surface: withheld, noise, and others that a user may want to leave out.

LAS: "withheld" means that a point must not be processed. Synthetic points were made up, overlap points lie twice, key
points are a thinned model; these three are measured surfaces or stand for one, and become map unless asked otherwise.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field

import numpy as np

from mapvote.core.types import Bool, MapvoteError
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.laz_subprocess import FLAGS, LasClass

log = logging.getLogger("mapvote.formats")

MARKS = {
    "withheld": "withheld",
    "noise": "noise (classes 7 and 18)",
    "synthetic": "synthetic",
    "key_point": "key points",
    "overlap": "overlap",
}
DROPPED = frozenset({"withheld", "noise"})
"""Marks whose points are left out by default."""


def marks_in(text: str) -> frozenset[str]:
    """The marks of a comma-separated list, or of "none"; MapvoteError for another word."""
    words = frozenset(word.strip() for word in text.split(",")) - {"none", ""}
    unknown = sorted(words - MARKS.keys())
    if unknown:
        raise MapvoteError(f"--drop {text}: {unknown[0]!r} is no mark of points; use {', '.join(MARKS)}, or none")
    return words


def marked(cloud: Cloud, mark: str) -> Bool:
    """Which points (n,) of a cloud bear a mark."""
    if mark == "noise":
        classes = cloud.fields.get("classification")
        return (
            np.zeros(len(cloud.points), np.bool_)
            if classes is None
            else np.isin(classes, (LasClass.LOW_NOISE, LasClass.HIGH_NOISE))
        )
    flags = cloud.fields.get("las_flags")
    if flags is None:
        return np.zeros(len(cloud.points), np.bool_)
    return np.asarray(flags.astype(np.uint8) & FLAGS[mark] > 0)


@dataclass(slots=True)
class MarkedPoints:
    """Leaves out points with some marks, and counts those with each."""

    drop: Collection[str] = DROPPED
    counts: Counter[str] = field(default_factory=Counter)

    def without(self, pieces: Iterator[Cloud]) -> Iterator[Cloud]:
        """The pieces of a file without the dropped points."""
        for piece in pieces:
            bad = np.zeros(len(piece.points), np.bool_)
            for mark in MARKS:
                bears = marked(piece, mark)
                self.counts[mark] += int(bears.sum())
                if mark in self.drop:
                    bad |= bears
            yield piece.where(~bad) if bad.any() else piece

    def told(self) -> list[str]:
        """Lines on the points that were left out and kept."""
        lines = []
        for mark, n in self.counts.items():
            done = "dropped" if mark in self.drop else "kept"
            if n:
                lines.append(f"{done}: {n} points that the file marks as {MARKS[mark]}")
        return lines


def without_marked(path: object, pieces: Iterator[Cloud]) -> Iterator[Cloud]:
    """The pieces of a file at ``path`` without withheld points and noise; a warning says how many there were."""
    sieve = MarkedPoints()
    yield from sieve.without(pieces)
    for line in sieve.told():
        if line.startswith("dropped"):
            log.warning("%s: %s", path, line)
