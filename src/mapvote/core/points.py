"""The table of attributes of points. An attribute is a row: how it goes from a scan through a ballot into the map.

Readers of scans, new points, ballots, fusion and tiles read this table. Another distribution adds a row by an entry
point of the group ``mapvote.fields``, whose name is the attribute's name and which loads a :class:`Field`
(docs/extending.md). A vehicle sends an attribute if its map has a column of that name.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mapvote.core.brightness import from_counts, unit_intensity
from mapvote.core.types import I64, U64, MapvoteError

Values = NDArray[Any]
"""(n,) of one attribute."""
Fields = Mapping[str, Values]
"""Attributes of the same points, by name."""


@dataclass(frozen=True, slots=True)
class Field:
    """One attribute of points."""

    dtype: str
    """Type of its values in ballots, little-endian: ``|u1``, ``<u2``, ``<f4``."""
    scaled: bool = False
    """Its values count up to a full scale that every file chooses for itself (core/brightness.py): 0 to 1 in scans, 0
    to the largest number of ``dtype`` in ballots, the column's own scale in the map. False: the values stay as they
    are."""
    spellings: tuple[str, ...] = ()
    """Other names of its column in scans: lower case, without underscores and blanks."""
    unmeasured: float = 0
    """Value for points of which it was not measured."""
    merged: Literal["nearest", "plurality"] = "nearest"
    """Fusion: of all points that vehicles offer for a voxel the map takes the one nearest to their mean, with its own
    value (nearest), or with the value that most of them measured, of several the smallest (plurality)."""

    @property
    def full(self) -> float:
        """The value in ballots that means 1.0, of a ``scaled`` attribute."""
        kind = np.dtype(self.dtype)
        return 1.0 if kind.kind == "f" else float(np.iinfo(kind).max)

    def unknown(self, n: int) -> Values:
        """(n,) of points of which it was not measured, as in ballots."""
        return np.full(n, self.unmeasured, dtype=self.dtype)

    def in_scan(self, column: Values) -> Values:
        """A column (n,) of a file or message as a scan has it; MapvoteError if ``dtype`` does not hold a value."""
        return unit_intensity(column) if self.scaled else self._exactly(column)

    def in_ballot(self, values: Values) -> Values:
        """The values (n,) of a scan as a ballot has them; MapvoteError if they are none of a scan's."""
        if not self.scaled:
            return self._exactly(values)
        if values.dtype.kind != "f" or not ((values >= 0.0) & (values <= 1.0)).all():
            raise MapvoteError("a scan holds shares of the full scale, reals from 0 to 1: divide by the largest value")
        shares = values.astype(np.float64) * self.full
        return (shares if self.dtype.endswith(("f4", "f8")) else np.rint(shares)).astype(self.dtype)

    def in_map(self, sent: Values, column: Values) -> Values:
        """The values (m,) of a ballot as they follow the map's ``column`` (n,)."""
        return from_counts(sent, self.full, column) if self.scaled else sent

    def _exactly(self, column: Values) -> Values:
        """(n,) as ``dtype``; values that are not finite count as not measured."""
        kind = np.dtype(self.dtype)
        if np.can_cast(column.dtype, kind):
            return column.astype(kind, copy=False)
        wanted = np.where(np.isfinite(column), column, self.unmeasured)
        with np.errstate(invalid="ignore", over="ignore"):
            held = wanted.astype(kind)
        bad = wanted[held != wanted] if kind.kind != "f" else wanted[~np.isfinite(held)]
        if len(bad):
            raise MapvoteError(f"{bad[0]:g} is no number of type {kind.name}, which the attribute has in ballots")
        return held


FIELDS: dict[str, Field] = {"intensity": Field("|u1", scaled=True, spellings=("i",))}
"""The attributes of this package. :func:`point_fields` knows those of other distributions too."""


@cache
def point_fields() -> Mapping[str, Field]:
    """All attributes by name, those of this package first. MapvoteError if one of another distribution is none."""
    every = dict(FIELDS)
    for entry in sorted(entry_points(group="mapvote.fields"), key=lambda entry: entry.name):
        try:
            row = entry.load()
        except Exception as error:  # another distribution's module: anything can be wrong with it
            raise MapvoteError(f"point attribute {entry.name!r}: its entry point cannot be loaded ({error})") from error
        if not isinstance(row, Field):
            raise MapvoteError(f"point attribute {entry.name!r}: its entry point loads no mapvote.core.points.Field")
        every.setdefault(entry.name, row)
    return every


def point_field(name: str) -> Field:
    """The attribute of a ballot's or a scan's field. MapvoteError if no installed distribution has it."""
    row = point_fields().get(name)
    if row is None:
        mend = "install the distribution that brings it"
        raise MapvoteError(
            f"point attribute {name[:64]!r} is unknown; known are {', '.join(point_fields())}; or {mend}"
        )
    return row


def attributes_among(names: Collection[str]) -> list[str]:
    """Those of the attributes whose names are given, in the order of the table."""
    return [name for name in point_fields() if name in names]


def merged_values(name: str, values: Values, voxels: I64, chosen: I64) -> Values:
    """The values (k,) of the attribute ``name`` for the points ``chosen`` (k,), by what all points (n,) offer for their
    ``voxels`` (n,). The order of the points makes no difference."""
    row = point_field(name)
    if row.merged == "nearest":
        return values[chosen]
    # Every pair of a voxel and a value that was measured there, and how many points have it.
    measured = np.flatnonzero(values != row.unmeasured)
    kinds, kind = np.unique(values[measured], return_inverse=True)
    pairs, counts = np.unique(np.column_stack([voxels[measured], kind]), axis=0, return_counts=True)
    # The most frequent one of each voxel, of several the smallest.
    best = np.lexsort((pairs[:, 1], -counts, pairs[:, 0]))
    of_voxel, first = np.unique(pairs[best, 0], return_index=True)
    merged = row.unknown(len(chosen))
    present = np.isin(voxels[chosen], of_voxel)
    place = np.searchsorted(of_voxel, voxels[chosen][present])
    merged[present] = kinds[pairs[best[first[place]], 1]]
    return merged


def as_numbers(fields: Fields, n: int) -> U64:
    """(n, k) the k attributes of n points, bit for bit: an order for points that nothing else tells apart."""
    numbers = np.empty((n, len(fields)), dtype=np.uint64)
    for k, column in enumerate(fields.values()):
        numbers[:, k] = column.view(f"u{column.dtype.itemsize}")
    return numbers


def joined_fields(parts: Sequence[tuple[int, Fields]]) -> dict[str, Values]:
    """The attributes of several clouds as one: of each how many points it has, and its attributes. Points of a cloud
    without an attribute that another has get its ``unmeasured`` value."""
    names = attributes_among({name for _, fields in parts for name in fields})
    return {
        name: np.concatenate([fields[name] if name in fields else point_field(name).unknown(n) for n, fields in parts])
        for name in names
    }
