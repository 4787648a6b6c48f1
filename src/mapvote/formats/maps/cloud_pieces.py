"""A cloud larger than memory on its way into a file: piece by piece, and what a header must say before the points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mapvote.core.types import F64
from mapvote.formats.geo.frame import MapFrame
from mapvote.formats.maps.cloud import SCALED, Cloud, full_scale


@dataclass(frozen=True, slots=True)
class CloudPieces:
    """The pieces of one cloud, in one frame; asked again they come again."""

    pieces: Callable[[], Iterator[Cloud]]
    frame: MapFrame
    n: int
    """Points of all pieces together."""
    low: F64
    """(3,) the lowest coordinates; 0 where there are no points."""
    high: F64
    """(3,) the highest."""
    kinds: Mapping[str, np.dtype[Any]]
    """Fields of any piece; where one lacks it its points have 0."""
    full: Mapping[str, float]
    """The value that means 1.0, of those that count up to a full scale."""

    @classmethod
    def of(cls, cloud: Cloud | CloudPieces) -> CloudPieces:
        """What is in memory already, as one piece."""
        return cloud if isinstance(cloud, CloudPieces) else cls.gathered(lambda: iter([cloud]), cloud.frame)

    @classmethod
    def gathered(cls, pieces: Callable[[], Iterator[Cloud]], frame: MapFrame) -> CloudPieces:
        """Goes through all pieces once."""
        n, low, high = 0, np.full(3, np.inf), np.full(3, -np.inf)
        kinds: dict[str, np.dtype[Any]] = {}
        full: dict[str, float] = {}
        for piece in pieces():
            n += len(piece.points)
            low = np.minimum(low, piece.points.min(axis=0, initial=np.inf))
            high = np.maximum(high, piece.points.max(axis=0, initial=-np.inf))
            kinds |= {name: column.dtype for name, column in piece.fields.items()}
            for name in SCALED:
                if name in piece.fields:
                    full[name] = max(full.get(name, 0.0), full_scale(piece.fields[name]))
        if not n:
            low, high = np.zeros(3), np.zeros(3)
        return cls(pieces, frame, n, low, high, kinds, full)

    @property
    def corners(self) -> F64:
        """(2, 3) lowest and highest coordinates."""
        return np.array([self.low, self.high])

    def __iter__(self) -> Iterator[Cloud]:
        """The pieces, each with all fields."""
        for piece in self.pieces():
            fields = {
                name: piece.fields.get(name, np.zeros(len(piece.points), kind)).astype(kind, copy=False)
                for name, kind in self.kinds.items()
            }
            yield replace(piece, fields=fields)
