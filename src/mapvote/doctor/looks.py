"""One look at every scan of a drive: a few numbers each, cheap enough for all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from mapvote.core.azimuth import azimuth_64
from mapvote.core.types import F32, F64, I64, Drive, MapvoteError, Scan

SECTORS = 36
_POINTS = 12_000
"""Points of a scan that are looked at."""
_BINS, _BIN_M = 400, 0.5
_BLOCK = 512
QUANTA_M = (1.0, 0.5, 0.25, 0.1, 0.05, 0.02)
"""Steps to which coordinates may have been rounded."""


@dataclass(frozen=True, slots=True)
class Looks:
    """Of every scan that could be read, one row; the others are in ``refused``."""

    index: I64
    """(m,) which scan."""
    count: I64
    """(m,) points."""
    low: F64
    """(m, 3) least coordinate along each axis."""
    high: F64
    """(m, 3)."""
    mean: F64
    """(m, 3)."""
    range_m: F64
    """(m, 3) ranges from the origin: of a tenth, half and 99 % of the points."""
    sectors: F64
    """(m, 36) share of the points in each ten degrees of azimuth, from -180 deg."""
    near: F64
    """(m,) share within 2 m of the origin."""
    unit: F64
    """(m, 3) share of each coordinate that lies in [0, 1]."""
    rounded: F64
    """(m, 6) share of the points whose x, y and z are multiples of QUANTA_M."""
    turns: F64
    """(m,) how often the points, in their order, go round counter-clockwise."""
    print_: F64
    """(m,) a number that two different scans hardly share."""
    has_times: bool
    has_intensity: bool
    refused: dict[int, str]
    """Why a scan could not be read."""

    @property
    def leaps(self) -> F64:
        """(m - 1,) by how much the directions in which a scan sees something differ from those of the one before."""
        leaps: F64 = np.abs(np.diff(self.sectors, axis=0)).sum(axis=1)
        return leaps


class Looking:
    """A drive of which every scan is looked at when it is first read, whoever reads it."""

    def __init__(self, drive: Drive) -> None:
        self.drive = replace(drive, read_scan=self._read)
        """The same drive, looked at on the way."""
        self._unseen = drive
        self._rows: dict[int, F64] = {}
        self._counts: dict[int, int] = {}
        self._refused: dict[int, str] = {}
        self._times = self._intensity = False

    def _read(self, i: int) -> Scan:
        try:
            scan = self._unseen.read_scan(i)
        except MapvoteError as error:
            self._refused[i] = str(error)
            raise
        if i not in self._rows:
            self._rows[i] = _look(scan.points, max(1, len(scan.points) // _POINTS), np.array(QUANTA_M))
            self._counts[i] = len(scan.points)
            self._times |= scan.time_s is not None
            self._intensity |= scan.intensity is not None
        return scan

    def look(self, indices: Iterable[int], progress: Callable[[int, int], None] | None = None) -> Looks:
        """Read those scans that nobody has read yet; returns what all that were read until now show. ``progress`` is
        told (done, in all)."""
        left = [i for i in indices if i not in self._rows and i not in self._refused]
        for done, i in enumerate(left):
            with suppress(MapvoteError):  # it is kept among the refused
                self._read(i)
            if progress is not None:
                progress(done + 1, len(left))
        index = np.array(sorted(self._rows), dtype=np.int64)
        table: NDArray[np.float64] = np.array([self._rows[i] for i in index.tolist()]).reshape(len(index), _WIDTH)
        low, high, mean, range_m, sectors, near, unit, rounded, turns, print_ = np.split(
            table, np.cumsum(_PARTS)[:-1], axis=1
        )
        return Looks(
            index=index,
            count=np.array([self._counts[i] for i in index.tolist()], dtype=np.int64),
            low=low,
            high=high,
            mean=mean,
            range_m=range_m,
            sectors=sectors,
            near=near[:, 0],
            unit=unit,
            rounded=rounded,
            turns=turns[:, 0],
            print_=print_[:, 0],
            has_times=self._times,
            has_intensity=self._intensity,
            refused=dict(self._refused),
        )


def look_at_all(drive: Drive, progress: Callable[[int, int], None] | None = None) -> Looks:
    """Every scan of the drive read once. ``progress`` is told (done, in all)."""
    return Looking(drive).look(range(len(drive)), progress)


_PARTS = (3, 3, 3, 3, SECTORS, 1, 3, len(QUANTA_M), 1, 1)
_WIDTH = sum(_PARTS)


@numba.njit(cache=True, nogil=True)
def _is_whole(points: F32, i: int, quantum: float) -> bool:
    """Whether all coordinates of the i-th of points (n, 3) are multiples of ``quantum``: mostly the first is not."""
    for axis in range(3):
        v = np.float64(points[i, axis]) / quantum
        if not abs(v - np.round(v)) < 1e-3:
            return False
    return True


@numba.njit(inline="always")
def _put(out: F64, at: int, values: F64, share: float) -> None:
    """``values``, each times ``share``, into ``out`` from ``at`` on. A slice would be compiled four times as long: for
    the message of its error numba brings its strings along."""
    for k in range(len(values)):
        out[at + k] = values[k] * share


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look(points: F32, stride: int, quanta: F64) -> F64:
    """One row of :class:`Looks`, its parts one after the other; every ``stride``-th of the points (n, 3).

    Block by block: first what vectors can do, then what goes point by point.
    """
    low, high, total = np.full(3, np.inf), np.full(3, -np.inf), np.zeros(3)
    sectors, ranges, unit, rounded = np.zeros(36), np.zeros(_BINS), np.zeros(3), np.zeros(len(quanta))
    near, turns, before, print_, n = 0.0, 0.0, 0.0, 0.0, 0
    xyz, distance, azimuth = np.empty((3, _BLOCK)), np.empty(_BLOCK), np.empty(_BLOCK)
    bin_, sector = np.empty(_BLOCK, np.int32), np.empty(_BLOCK, np.int32)
    for start in range(0, len(points), stride * _BLOCK):
        block = min(_BLOCK, (len(points) - start + stride - 1) // stride)
        for i in range(block):
            for axis in range(3):
                xyz[axis, i] = points[start + i * stride, axis]
        for i in range(block):
            x, y, z = xyz[0, i], xyz[1, i], xyz[2, i]
            distance[i] = np.sqrt(x * x + y * y + z * z)
            azimuth[i] = azimuth_64(y, x)
            bin_[i] = int(min(distance[i] / _BIN_M, _BINS - 1.0))
            sector[i] = int((azimuth[i] + np.pi) / (2.0 * np.pi) * 36.0)
        for axis in range(3):
            least, most, whole, few = low[axis], high[axis], total[axis], 0
            for i in range(block):
                v = xyz[axis, i]
                least, most = min(least, v), max(most, v)
                whole += v
                few += 0.0 <= v <= 1.0
            low[axis], high[axis], total[axis] = least, most, whole
            unit[axis] += few
        for k in range(len(quanta)):
            each = 1.0 / quanta[k]
            for i in range(block):
                steps = xyz[0, i] * each  # sieved by x, which is mostly no multiple, and without a division
                if abs(steps - np.round(steps)) < 2e-3 and _is_whole(points, start + i * stride, quanta[k]):
                    rounded[k] += 1.0
        for i in range(block):
            ranges[bin_[i]] += 1.0
            sectors[sector[i] % 36] += 1.0
            near += distance[i] < 2.0
            step = azimuth[i] - before
            step -= 2.0 * np.pi * np.round(step / (2.0 * np.pi))
            if n > 0 and abs(step) < 1.0:
                turns += step / (2.0 * np.pi)
            before = azimuth[i]
            print_ += (n % 97 + 1.0) * distance[i]
            n += 1
    out = np.empty(3 + 3 + 3 + 3 + 36 + 1 + 3 + len(quanta) + 1 + 1)
    share = 1.0 / max(n, 1)
    _put(out, 0, low, 1.0)
    _put(out, 3, high, 1.0)
    _put(out, 6, total, share)
    seen, wanted = 0.0, 0
    for k in range(_BINS):
        seen += ranges[k]
        while wanted < 3 and seen >= (0.1 * n if wanted == 0 else 0.5 * n if wanted == 1 else 0.99 * n):
            out[9 + wanted] = (k + 0.5) * _BIN_M
            wanted += 1
    _put(out, 12, sectors, share)
    out[48] = near * share
    _put(out, 49, unit, share)
    _put(out, 52, rounded, share)
    out[-2], out[-1] = turns, print_
    return out
