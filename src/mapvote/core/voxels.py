"""A growing cloud on the world lattice: sums per 0.3 m voxel, so that a map is what all scans say together.

A voxel's point is the mean of everything measured in it. The first point, or any single one, carries its scan's
whole error in range and pose; the mean is as unbiased and several times less noisy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.core.kernel import inlined, kernel
from mapvote.core.types import F32, F64, I32, I64, Bool, MapvoteError, read_only

_OFFSET = 1 << 20
"""Indices are counted from here, so that keys are positive and never 0: within +-2^20 voxels (314 km at 0.3 m)."""

BESIDE = (1 << 42, 1 << 21, 1)
"""Steps of the key to the next voxel along x, y and z."""


@inlined
def packed_key(ix: np.int64, iy: np.int64, iz: np.int64) -> np.int64:
    """The key of a voxel: equal keys, same voxel; ascending by x, then y, then z. Indices (counted from -2^20) >= 0."""
    return (ix << 42) | (iy << 21) | iz


@inlined
def voxel_key(x: float, y: float, z: float, size: float) -> np.int64:
    """The key of the voxel of side ``size`` that holds (x, y, z)."""
    ix = np.floor(x / size)
    iy = np.floor(y / size)
    iz = np.floor(z / size)
    return packed_key(np.int64(ix) + _OFFSET, np.int64(iy) + _OFFSET, np.int64(iz) + _OFFSET)


@inlined
def slot_of(key: np.int64, table: I64) -> np.uint64:
    """Where a hash table (2^k,) of keys holds ``key``, or the free slot (0) where it belongs: open addressing, linear
    probing; Fibonacci hashing with the high half folded in, so that the low bits depend on all three indices.
    Unsigned: an index that cannot be negative needs no test for it."""
    mask = np.uint64(len(table) - 1)
    h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = (h ^ (h >> np.uint64(32))) & mask
    while table[slot] != 0 and table[slot] != key:
        slot = (slot + np.uint64(1)) & mask
    return slot


@kernel
def _group(keys: I64, table: I32, of: I32, first: I64) -> np.int64:
    """Number equal keys (n,) > 0 in the order in which they come; a key of 0 belongs to none.

    Returns how many there are, with ``of`` (n,) the number of each key, -1 for 0, and in ``first`` (n,) the index of
    the first of each; or -1 if they would fill more than half of ``table`` (2^k,), which holds zeros. A slot of it that
    is taken holds 1 + the index of the first key that belongs there: half as much memory as the key itself.
    """
    m = np.uint64(0)
    most = np.uint64(len(table) // 2)
    mask = np.uint64(len(table) - 1)
    for i in range(np.uint64(0), np.uint64(len(keys))):
        key = keys[i]
        of[i] = -1
        if key == 0:
            continue
        h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)  # as slot_of
        slot = (h ^ (h >> np.uint64(32))) & mask
        while table[slot] != 0 and keys[np.uint64(table[slot] - 1)] != key:
            slot = (slot + np.uint64(1)) & mask
        if table[slot] == 0:
            if m >= most:
                return np.int64(-1)
            table[slot] = np.int32(i + np.uint64(1))
            of[i] = np.int32(m)
            first[m] = i
            m += np.uint64(1)
        else:
            of[i] = of[np.uint64(table[slot] - 1)]
    return np.int64(m)


def grouped(keys: I64, slots: int = 1 << 14) -> tuple[I32, I64]:
    """(``of`` (n,), ``first`` (m,)) of :func:`_group`, by a table of ``slots`` (2^k) or more: 16,384 fit a cache."""
    of = np.empty(len(keys), dtype=np.int32)
    first = np.empty(len(keys), dtype=np.int64)
    while True:
        m = _group(keys, np.zeros(slots, dtype=np.int32), of, first)
        if m >= 0:
            return of, first[:m]
        slots *= 4


@kernel
def enter_first(keys: I64, table: I64, first: I64) -> np.int64:
    """Half of :func:`_group`, in half of its time: how many different keys (n,) > 0 there are that ``table`` (2^k,)
    does not hold, and into ``first`` the index of the first of each. They are entered into it, 0 is a free slot; -1 if
    they are more than half of it."""
    m = np.uint64(0)
    most = np.uint64(len(table) // 2)
    for i in range(np.uint64(0), np.uint64(len(keys))):
        slot = slot_of(keys[i], table)
        if table[slot] == 0:
            if m >= most:
                return np.int64(-1)
            table[slot] = keys[i]
            first[m] = i
            m += np.uint64(1)
    return np.int64(m)


def first_of_each(keys: I64, slots: int = 1 << 14) -> I64:
    """(m,) the index of the first of each of the keys (n,) > 0, ascending; as :func:`grouped` has it."""
    while True:
        first = np.empty(slots // 2, dtype=np.int64)
        m = enter_first(keys, np.zeros(slots, dtype=np.int64), first)
        if m >= 0:
            return first[:m].copy()
        slots *= 4


def found_among(rows: F32 | F64, others: F32 | F64) -> Bool:
    """(n,) whether each of ``rows`` (n, k) is, bit for bit, among ``others`` (m, k), of one dtype. -0.0 is not 0.0.

    Rows are numbered word by word: equal numbers, equal words so far.
    """
    words = np.concatenate([others, rows]).view(np.uint32)
    number = np.zeros(len(words), dtype=np.int64)
    slots = 1 << (2 * len(words)).bit_length()
    for word in words.T:
        number = grouped(((number << 32) | word) + 1, slots)[0].astype(np.int64)
    present = np.zeros(len(words), dtype=np.bool_)
    present[number[: len(others)]] = True
    return present[number[len(others) :]]


@kernel
def _find(keys: I64, table_keys: I64, table_rows: I32, n: int, rows: I32) -> int:
    """The ``rows`` (m,) of voxels with ``keys`` (m,) in a cloud of n; new ones come last. Returns the new n."""
    for j in range(len(keys)):
        slot = slot_of(keys[j], table_keys)
        if table_keys[slot] == 0:
            table_keys[slot] = keys[j]
            table_rows[slot] = n
            n += 1
        rows[j] = table_rows[slot]
    return n


@kernel
def _add(points: F64, of_point: I32, rows: I32, sums: F64) -> None:
    """Points (n, 3) into the ``sums`` of their voxels, whose ``rows`` (m,) these are; ``of_point`` (n,) says which."""
    for j in range(len(rows)):  # all rows are requested before any is waited for
        sums[rows[j], 7] += 1.0
    for i in range(len(points)):
        if of_point[i] < 0:
            continue
        k = rows[of_point[i]]
        # Moments are taken from the first point: large world coordinates would eat the digits.
        if sums[k, 0] == 0.0:
            sums[k, 4] = points[i, 0]
            sums[k, 5] = points[i, 1]
            sums[k, 6] = points[i, 2]
        sums[k, 0] += 1.0
        sums[k, 1] += points[i, 0] - sums[k, 4]
        sums[k, 2] += points[i, 1] - sums[k, 5]
        sums[k, 3] += points[i, 2] - sums[k, 6]


class VoxelCloud:
    """Sums of points per lattice voxel, and the number of scans that hit each voxel."""

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        self._keys = np.zeros(1 << 16, dtype=np.int64)
        self._rows = np.zeros(1 << 16, dtype=np.int32)
        self._sums = np.zeros((1 << 15, 8))
        """Count, moments from the first point, the first point, scans: a row is one line of the processor's cache."""
        self._n = 0

    def enter(self, points_map: F64, skip: Bool | None = None) -> None:
        """Enter one scan: points (n, 3) in map metres, those of ``skip`` (n,) left out.

        Five points of a scan share a voxel: they are gathered before the cloud, which no cache holds, is read.
        """
        points = np.ascontiguousarray(points_map, dtype=np.float64)
        keys = voxel_keys(points, self.lattice.x0, self.lattice.y0)
        if skip is not None:
            keys[skip] = 0
        of_point, first = grouped(keys, 1 << 16)
        while self._n + len(first) > len(self._sums):
            self._grow()
        rows = np.empty(len(first), dtype=np.int32)
        self._n = _find(keys[first], self._keys, self._rows, self._n, rows)
        _add(points, of_point, rows, self._sums)

    def _grow(self) -> None:
        """Twice the room: every voxel is entered anew, in the order of rows."""
        filled = np.flatnonzero(self._keys)
        by_row = np.empty(self._n, dtype=np.int64)
        by_row[self._rows[filled]] = self._keys[filled]
        self._keys = np.zeros(2 * len(self._keys), dtype=np.int64)
        self._rows = np.zeros(2 * len(self._rows), dtype=np.int32)
        _find(by_row, self._keys, self._rows, 0, np.empty(self._n, dtype=np.int32))
        sums = np.zeros((2 * len(self._sums), 8))  # rows that were never written take no memory yet
        sums[: self._n] = self._sums[: self._n]
        self._sums = sums

    def __len__(self) -> int:
        return self._n

    def points(self) -> tuple[F64, I32]:
        """(mean point (m, 3) map metres, scans that hit it (m,)) of every voxel, in the lattice's x, y, z order."""
        occupied = np.flatnonzero(self._keys)
        rows: NDArray[np.int32] = self._rows[occupied[np.argsort(self._keys[occupied])]]
        sums = self._sums[: self._n]  # in the order of arrival; sorted when they are few
        means = sums[:, 4:7] + sums[:, 1:4] / sums[:, :1]
        return means.take(rows, axis=0), sums[:, 7].astype(np.int32)[rows]


@kernel
def _enter_keys(points: F64, x0: float, y0: float, size: float, keys: I64) -> int:
    """Fill ``keys`` (n,). Returns the index of the first of the points (n, 3) that lies beyond all keys, or -1."""
    reach = float(_OFFSET) * size
    beyond = -1
    for i in range(len(points)):
        x = points[i, 0] - x0
        y = points[i, 1] - y0
        z = points[i, 2]
        if not (abs(x) < reach and abs(y) < reach and abs(z) < reach) and beyond < 0:
            beyond = i
        keys[i] = voxel_key(x, y, z, size)
    return beyond


def voxel_keys(points: NDArray[np.floating], x0: float, y0: float, size: float = CELL_SIZE) -> I64:
    """(n,) int64 key of each point's voxel on the lattice, see :func:`packed_key`. Voxel layers start at z = 0.

    MapvoteError for a point beyond 2^20 voxels of (x0, y0, 0): two voxels would share one key.
    """
    keys = np.empty(len(points), dtype=np.int64)
    beyond = _enter_keys(np.array(points, dtype=np.float64, order="C"), x0, y0, size, keys)
    if beyond >= 0:
        x, y, z = points[beyond]
        raise MapvoteError(
            f"a point at ({x:.1f}, {y:.1f}, {z:.1f}) is farther than {1e-3 * _OFFSET * size:.0f} km from the corner of "
            f"the map's lattice ({x0:.1f}, {y0:.1f}): leave the point out, or begin the lattice near the points"
        )
    return keys


def voxel_downsample(points: NDArray[np.floating], size: float, x0: float = 0.0, y0: float = 0.0) -> I64:
    """Indices (m,) of one point per voxel, the first of each in input order, ascending. Deterministic."""
    return first_of_each(voxel_keys(points, x0, y0, size))


@kernel
def _thin_keys(points: NDArray[np.float32], every: int, size: float, keys: I64) -> None:
    """The key (m,) of every ``every``-th of the points (3 n,), in voxels of side ``size``."""
    scale = 1.0 / size
    middle = float(_OFFSET)
    step = np.uint64(3 * every)
    one = np.uint64(1)
    two = np.uint64(2)
    for j in range(np.uint64(0), np.uint64(len(keys))):  # int32 vectorises, and holds what is within reach
        i = j * step
        # The middle is added first: cutting off is then rounding down, and quicker than floor.
        ix = np.int32(points[i] * scale + middle)
        iy = np.int32(points[i + one] * scale + middle)
        keys[j] = packed_key(np.int64(ix), np.int64(iy), np.int64(np.int32(points[i + two] * scale + middle)))


def thin(points: NDArray[np.floating], size: float, every: int = 1) -> I64:
    """Indices (m,) of the first of (n, 3) points in each voxel of side ``size``, ascending. Within 2^20 voxels of 0.
    ``every``: use only every so many-th point of a dense scan.

    Does in a millisecond what :func:`voxel_downsample` does on the lattice; for scans, in their own frame.
    """
    cloud = read_only(np.ascontiguousarray(points, dtype=np.float32))
    keys = np.empty((len(cloud) + every - 1) // every, dtype=np.int64)
    _thin_keys(cloud.reshape(-1), every, size, keys)
    return first_of_each(keys, 1 << 15) * every
