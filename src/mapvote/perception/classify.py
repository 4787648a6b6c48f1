"""One scan against the reference: a state per cell (paper III-A, III-B; METHOD 2)."""

from __future__ import annotations

import numba
import numpy as np

from mapvote.config import VotingSettings
from mapvote.core.grid import CELL_SIZE
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I32, NO_VOTE, U8, U64, CellState, Reference
from mapvote.core.voting import VOTE_UNIT, weight_table
from mapvote.perception.visibility import ScanView, Sight

_UNCHANGED_OCCUPIED = int(CellState.UNCHANGED_OCCUPIED)
_UNCHANGED_EMPTY = int(CellState.UNCHANGED_EMPTY)
_CHANGED_OCCUPIED = int(CellState.CHANGED_OCCUPIED)
_CHANGED_EMPTY = int(CellState.CHANGED_EMPTY)
_UNDETERMINED = int(CellState.UNDETERMINED)
_CLEAR, _BEHIND, _NEVER = int(Sight.CLEAR), int(Sight.BEHIND), int(Sight.NEVER)
_OCCLUSION = {"first_hit": 0, "farthest_return": 1, "column": 2}
_TALL = {"none": 0, "bottom": 1, "height": 2}


@numba.njit(cache=True, nogil=True)
def below_top(word: np.uint64) -> np.uint64:
    """Every bit at or below the highest set one; 0 for 0."""
    for shift in (1, 2, 4, 8, 16, 32):
        word |= word >> np.uint64(shift)
    return word


@numba.njit(cache=True, nogil=True)
def span_of(word: np.uint64) -> np.uint64:
    """The bits from the lowest to the highest set one: the height span of a column; 0 for 0."""
    lowest = word & (~word + np.uint64(1))
    return below_top(word) & ~(lowest - np.uint64(1)) if word else np.uint64(0)


@numba.njit(cache=True, nogil=True)
def _paper(
    counts: I32, hit: U64, passed: U64, sight: U8, occupied: U64, map_counts: I32, bottom_z: F32,
    origin: F64, x0: float, y0: float, occlusion: int, tall: int, tan_top: float, table: I32, n_min: int, one: int,
    states: U8, weights: I32,
) -> None:  # fmt: skip
    rows, cols = counts.shape
    for r in range(rows):
        for c in range(cols):
            weights[r, c] = one
            n, mapped, visible = counts[r, c], map_counts[r, c] > 0, sight[r, c] == _CLEAR
            if occlusion == 1:
                visible = sight[r, c] >= _BEHIND
            elif occlusion == 2:
                crossed = span_of(occupied[r, c]) & passed[r, c]
                visible = crossed != 0 if mapped else sight[r, c] >= _BEHIND
            invalid = False
            if tall == 1 and mapped:
                dx, dy = x0 + (c + 0.5) * CELL_SIZE - origin[0], y0 + (r + 0.5) * CELL_SIZE - origin[1]
                invalid = bottom_z[r, c] > origin[2] + tan_top * np.sqrt(dx * dx + dy * dy)
            elif tall == 2:
                invalid = occupied[r, c] > below_top(hit[r, c])
            if invalid or (sight[r, c] == _NEVER and n == 0):
                states[r, c] = NO_VOTE
            elif n >= n_min:
                states[r, c] = _UNCHANGED_OCCUPIED if mapped else _CHANGED_OCCUPIED
                weights[r, c] = table[min(n, len(table) - 1)]
            elif n > 0 or not visible:
                states[r, c] = _UNDETERMINED
            else:
                states[r, c] = _CHANGED_EMPTY if mapped else _UNCHANGED_EMPTY


def classify_paper(
    view: ScanView, reference: Reference, origin_map: F64, sensor: Sensor, settings: VotingSettings
) -> tuple[U8, I32]:
    """The paper's five states and the votes each is worth: (states uint8, weights int32 in VOTE_UNITs), (rows, cols).

    A cell with n_min points or more is occupied and worth w(n), Eq. (1); with 1 to n_min - 1 undetermined; with none
    empty if it was visible, else undetermined. NO_VOTE where no ray was fired, and, in case 5 (``skip_tall_cells``),
    where the map begins above the sensor's view at that range (METHOD 2). ``origin_map`` (3,): the sensor, map metres.
    """
    states = np.empty(view.counts.shape, dtype=np.uint8)
    weights = np.empty(view.counts.shape, dtype=np.int32)
    table = weight_table(settings.weighted, settings.a, settings.b, settings.k, settings.n_min)
    tall = _TALL[settings.tall_rule if settings.skip_tall_cells else "none"]
    _paper(
        view.counts, view.hit, view.passed, view.sight, reference.occupied, reference.counts, reference.bottom_z,
        origin_map, view.grid.x0, view.grid.y0, _OCCLUSION[settings.occlusion], tall,
        np.tan(np.radians(sensor.fov_top_deg)), table, settings.n_min, VOTE_UNIT, states, weights,
    )  # fmt: skip
    return states, weights
