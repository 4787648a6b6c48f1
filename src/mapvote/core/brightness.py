"""The scale of an intensity or a colour: which value means full brightness. One rule for files of every format, for
scans, for maps and for ballots.

Files hold 8, 12 or 16 bits, in whatever type, or reals from 0 to 1. Whole numbers are on the smallest of these scales
that holds them all. Reals are on the smallest that holds nearly all: rounding lifts a few above 1, and an outlier must
not darken the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.record import record
from mapvote.core.types import F32, F64, I64, U8


@record()
@dataclass(frozen=True, slots=True)
class BrightnessRule:
    """Numbers of the rule."""

    scales: tuple[float, ...] = (1.0, 255.0, 4095.0, 65535.0)
    """Values of full brightness in use: reals, and the largest number of 8, 12 and 16 bits."""
    rounding: float = 0.05
    """Share by which reals may exceed their scale."""
    outliers: float = 0.01
    """Share of the reals that may lie above the scale of the others."""
    darkest: float = 0.02
    """Reals whose bright end is below this share of a scale are on a scale of their own, which ends there."""
    bins_per_octave: int = 8
    """Resolution at which the bright end of reals is found over pieces."""

    @property
    def edges(self) -> F64:
        """(k,) ascending ends of the bins in which reals are counted: the scales themselves, and values between."""
        limits = np.array(self.scales) * (1.0 + self.rounding)
        between = limits[0] * 2.0 ** (np.arange(33 * self.bins_per_octave) / self.bins_per_octave)
        return np.unique(np.concatenate([limits, between]))


BRIGHTNESS_RULE = BrightnessRule()
_EDGES = BRIGHTNESS_RULE.edges


@dataclass(slots=True)
class Brightness:
    """Statistics of the values of one column, counted piece by piece."""

    n: int = 0
    """Finite values."""
    undefined: int = 0
    """Values that are not finite."""
    negative: int = 0
    highest: float = 0.0
    whole: bool = True
    """Whether all finite values are whole numbers."""
    real: bool = False
    """Whether the column has a type of reals."""
    _counts: I64 = field(default_factory=lambda: np.zeros(len(_EDGES) + 1, np.int64))
    """Finite reals by the bin of ``BRIGHTNESS_RULE.edges``."""

    @classmethod
    def of(cls, values: NDArray[Any]) -> Brightness:
        """Those of one column (n,)."""
        counted = cls()
        counted.add(values)
        return counted

    def add(self, values: NDArray[Any]) -> None:
        """Count a piece (n,)."""
        if values.dtype.kind != "f":
            self.n += len(values)
            self.negative += int((values < 0).sum()) if values.dtype.kind == "i" else 0
            self.highest = max(self.highest, float(values.max(initial=0)))
            return
        finite = self._note(values)
        beyond = finite[finite > _EDGES[0]]  # few or none of most columns
        self._counts[0] += len(finite) - len(beyond)
        self._counts += np.bincount(np.searchsorted(_EDGES, beyond), minlength=len(self._counts))

    def _note(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """Count a piece (n,) of reals, but for their bins; returns the finite ones."""
        self.real = True
        finite = values
        lowest, highest = float(values.min(initial=0.0)), float(values.max(initial=0.0))
        if not np.isfinite([lowest, highest]).all():
            finite = values[np.isfinite(values)]
            lowest, highest = float(finite.min(initial=0.0)), float(finite.max(initial=0.0))
        self.n += len(finite)
        self.undefined += len(values) - len(finite)
        self.negative += int(np.count_nonzero(finite < 0)) if lowest < 0.0 else 0
        self.highest = max(self.highest, highest)
        self.whole = self.whole and bool((finite == np.floor(finite)).all())
        return finite

    @property
    def is_count(self) -> bool:
        """Whether the values are whole numbers of 8 to 16 bits, and none stands for a share of 1."""
        return self.whole and self.highest <= BRIGHTNESS_RULE.scales[-1] and (not self.real or self.highest > 1.0)

    @property
    def above(self) -> int:
        """Reals beyond the value that means 1.0, by more than rounding."""
        return int(self._counts[np.searchsorted(_EDGES, self.full * (1.0 + BRIGHTNESS_RULE.rounding)) + 1 :].sum())

    @property
    def full(self) -> float:
        """The value that means 1.0."""
        return self._full(lambda most: int(np.searchsorted(np.cumsum(self._counts), most)))

    def _full(self, bin_of: Callable[[int], int]) -> float:
        """The value that means 1.0; ``bin_of`` gives the first bin up to whose end so many of the reals lie."""
        if self.whole and (not self.real or self.highest > 1.0):
            return next((scale for scale in BRIGHTNESS_RULE.scales[1:] if self.highest <= scale), self.highest)
        # The value that all but a few of the reals do not exceed, rounded up to the end of a bin.
        last = bin_of(self.n - int(BRIGHTNESS_RULE.outliers * self.n))
        bright = min(float(_EDGES[last]) if last < len(_EDGES) else self.highest, self.highest)
        scale = next((s for s in BRIGHTNESS_RULE.scales if bright <= s * (1.0 + BRIGHTNESS_RULE.rounding)), bright)
        return bright if scale > 1.0 and bright < BRIGHTNESS_RULE.darkest * scale else scale


def full_scale(values: NDArray[Any]) -> float:
    """The value of a column (n,) that means 1.0: that of :class:`Brightness`, without bins, which take longer."""
    if values.dtype.kind != "f":
        return Brightness.of(values).full
    # Reals up to 1, as most sensors give them, need no more than their largest.
    if values.max(initial=0.0) <= BRIGHTNESS_RULE.scales[0]:
        return BRIGHTNESS_RULE.scales[0]
    counted = Brightness()
    finite = counted._note(values)

    def bin_of(most: int) -> int:
        return int(np.searchsorted(_EDGES, np.partition(finite, most - 1)[most - 1])) if most else 0

    return counted._full(bin_of)


def shares(values: NDArray[Any], full: float | None = None) -> NDArray[np.floating]:
    """(n,) brightness from 0 to 1 of a column, as float32 if that is its type, else float64; what is not finite or
    negative is 0. ``full``: the value that means 1.0, where it is known."""
    scale = max(full_scale(values) if full is None else full, 1e-9)
    out = values / np.asarray(scale, np.float32 if values.dtype == np.float32 else np.float64)
    if out.min(initial=0.0) >= 0.0 and out.max(initial=0.0) <= 1.0:  # nearly always; False where one is NaN
        return out
    out[~np.isfinite(out)] = 0.0
    return np.clip(out, 0.0, 1.0, out=out)


def unit_intensity(values: NDArray[Any]) -> F32:
    """(n,) brightness from 0 to 1 as scans have it."""
    return shares(values).astype(np.float32, copy=False)


def in_bytes(values: NDArray[Any]) -> U8:
    """(n,) brightness as ballots have it, 255 for 1.0."""
    return np.asarray(np.rint(255.0 * shares(values)), dtype=np.uint8)


def from_counts(brightness: NDArray[Any], full: float, like: NDArray[Any]) -> NDArray[Any]:
    """Brightness (m,), ``full`` for 1.0, on the scale and in the type of the column ``like`` (n,)."""
    values = brightness * (full_scale(like) / full)
    return (values if like.dtype.kind == "f" else np.rint(values)).astype(like.dtype)
