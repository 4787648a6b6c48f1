"""Which rows of one array are rows of another, bit for bit: an edit of a map leaves every other point as it was."""

from __future__ import annotations

import numpy as np

from mapvote.core.kernel import allocating, inlined
from mapvote.core.types import F32, F64, I32, Bool, read_only


def found_among(rows: F32 | F64, others: F32 | F64) -> Bool:
    """(n,) whether each of ``rows`` (n, k) is among ``others`` (m, k), of one dtype. -0.0 is not 0.0."""
    found: Bool = _found(_words(rows), _words(others))
    return found


def _words(rows: F32 | F64) -> I32:
    return read_only(np.ascontiguousarray(rows).view(np.int32))


@allocating
def _found(rows: I32, others: I32) -> Bool:
    """By a hash table of ``others``, at most half full, with linear probing."""
    size = 16
    while size < 2 * len(others):
        size *= 2
    table = np.full(size, -1, dtype=np.int64)
    for i in range(len(others)):
        slot = _hash(others[i]) & (size - 1)
        while table[slot] >= 0 and not _same(others[table[slot]], others[i]):
            slot = (slot + 1) & (size - 1)
        table[slot] = i
    out = np.zeros(len(rows), dtype=np.bool_)
    for i in range(len(rows)):
        slot = _hash(rows[i]) & (size - 1)
        while table[slot] >= 0 and not out[i]:
            out[i] = _same(others[table[slot]], rows[i])
            slot = (slot + 1) & (size - 1)
    return out


@inlined
def _hash(row: I32) -> np.int64:
    """FNV-1a (Fowler, Noll, Vo) by words, its high half folded in."""
    h = np.int64(-3750763034362895579)
    for word in row:
        h = (h ^ np.int64(word)) * np.int64(1099511628211)
    return h ^ (h >> 32)


@inlined
def _same(a: I32, b: I32) -> bool:
    for k in range(len(a)):  # noqa: SIM110 - numba compiles no generator in a call
        if a[k] != b[k]:
            return False
    return True
