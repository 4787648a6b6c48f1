"""How sure a vehicle is of each cell that it calls changed <-> bytes: log-odds, one byte a cell.

The states say which cells these are, so none is named again: a ballot has as many of these bytes as changed cells, in
their order, under zstd.
"""

from __future__ import annotations

import numpy as np

from mapvote.codec.arrays import compress, unpack_plane
from mapvote.core.types import F64, I8, I64, U8, CellState, MapvoteError

STEPS = 4
"""To a nat: rounding moves a probability by .03 at the most, and eighths would take a fifth more bytes."""
MOST = 127
"""31.75 nats: beyond all that anybody can know."""
UNSAID = -128
"""Where no confidence is stated; no ballot holds it."""
_CO, _CE = int(CellState.CHANGED_OCCUPIED), int(CellState.CHANGED_EMPTY)  # against a CellState numpy compares in int64


def in_steps(log_odds: F64) -> I8:
    """(n,) log-odds in nats as whole steps, the nearest, no farther from 0 than MOST."""
    return np.clip(np.rint(log_odds * STEPS), -MOST, MOST).astype(np.int8)


def in_nats(steps: I8) -> F64:
    """(n,) log-odds in nats; UNSAID has no meaning."""
    return steps.astype(np.float64) / STEPS


def changed_cells_of(states: U8) -> I64:
    """(m,) flat cells that the states (256, 256) call changed, ascending."""
    return np.flatnonzero((states == _CO) | (states == _CE))


def pack_odds(steps: I8) -> bytes:
    """(m,) of the changed cells of a tile, in their order."""
    return compress(np.ascontiguousarray(steps, dtype=np.int8).tobytes())


def unpack_odds(data: bytes, cells: int) -> I8:
    """(cells,) int8. MapvoteError if damaged, not one for each of so many changed cells, or nothing that a vehicle
    says."""
    steps = unpack_plane(data, "<i1", (cells,), "ballot: odds")
    if (steps == UNSAID).any():
        raise MapvoteError("ballot: odds holds a value that is no log-odds")
    return steps
