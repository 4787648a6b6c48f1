"""One scan against the reference: a state per cell (paper III-A, III-B)."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from mapvote.config import VotingSettings
from mapvote.core.columns import EVERY_BIT, below_top, span_of
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Grid, Lattice, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I32, N_STATES, NO_VOTE, U8, U64, CellState, Reference
from mapvote.core.voting import VOTE_UNIT, cast, decide, weight_table
from mapvote.detection.votes import TileVotes
from mapvote.perception.frontend import Observation
from mapvote.perception.raycast import ScanView, Sight

_UNCHANGED_OCCUPIED = int(CellState.UNCHANGED_OCCUPIED)
_UNCHANGED_EMPTY = int(CellState.UNCHANGED_EMPTY)
_CHANGED_OCCUPIED = int(CellState.CHANGED_OCCUPIED)
_CHANGED_EMPTY = int(CellState.CHANGED_EMPTY)
_UNDETERMINED = int(CellState.UNDETERMINED)
_CLEAR, _BEHIND, _NEVER = int(Sight.CLEAR), int(Sight.BEHIND), int(Sight.NEVER)
_OCCLUSION_FIRST, _OCCLUSION_FARTHEST, _OCCLUSION_COLUMN = 0, 1, 2
_OCCLUSION = {
    "first_hit": _OCCLUSION_FIRST,
    "farthest_return": _OCCLUSION_FARTHEST,
    "column": _OCCLUSION_COLUMN,
}
_TALL_NONE, _TALL_BOTTOM, _TALL_HEIGHT = 0, 1, 2
_TALL = {"none": _TALL_NONE, "bottom": _TALL_BOTTOM, "height": _TALL_HEIGHT}


class Seen(NamedTuple):
    """The planes of :class:`mapvote.perception.raycast.ScanView`, and where the scan was taken."""

    counts: I32
    hit: U64
    passed: U64
    sight: U8
    origin: F64
    """(3,) the sensor, map metres."""
    x0: float
    y0: float
    """Lower-left corner of the planes, map metres."""


class Mapped(NamedTuple):
    """What the map has in the same cells, as in :class:`mapvote.core.types.Reference`."""

    occupied: U64
    counts: I32
    bottom_z: F32


class Rule(NamedTuple):
    """The settings, as numbers."""

    occlusion: int
    tall: int
    tan_top: float
    """Slope of the sensor's highest ray."""
    table: I32
    """Votes of n points in VOTE_UNITs, Eq. (1); the last for any more."""
    n_min: int


@numba.njit(cache=True, nogil=True)
def _paper(seen: Seen, mapped: Mapped, rule: Rule, states: U8, weights: I32) -> None:
    counts, hit, passed, sight, origin, x0, y0 = seen  # unpacked once: a group handed on for each cell would cost much
    occupied, map_counts, bottom_z = mapped
    rows, cols = counts.shape
    for r in range(rows):
        for c in range(cols):
            weights[r, c] = VOTE_UNIT
            n, is_mapped = counts[r, c], map_counts[r, c] > 0
            # Was the cell seen, by one of the three occlusion rules (docs/decisions/paper.md)?
            visible = sight[r, c] >= (_CLEAR if rule.occlusion == _OCCLUSION_FIRST else _BEHIND)
            if rule.occlusion == _OCCLUSION_COLUMN and is_mapped:
                visible = span_of(occupied[r, c]) & passed[r, c] != 0
            # Case 5: the map begins above the view at that range, or reaches above the scan's points.
            invalid = False
            if rule.tall == _TALL_BOTTOM and is_mapped:
                dx, dy = x0 + (c + 0.5) * CELL_SIZE - origin[0], y0 + (r + 0.5) * CELL_SIZE - origin[1]
                invalid = bottom_z[r, c] > origin[2] + rule.tan_top * np.sqrt(dx * dx + dy * dy)
            elif rule.tall == _TALL_HEIGHT:
                invalid = occupied[r, c] > below_top(hit[r, c])
            # The five states (paper III-A).
            if invalid or (sight[r, c] == _NEVER and n == 0):
                states[r, c] = NO_VOTE
            elif n >= rule.n_min:
                states[r, c] = _UNCHANGED_OCCUPIED if is_mapped else _CHANGED_OCCUPIED
                weights[r, c] = rule.table[min(n, len(rule.table) - 1)]
            elif n > 0 or not visible:
                states[r, c] = _UNDETERMINED
            else:
                states[r, c] = _CHANGED_EMPTY if is_mapped else _UNCHANGED_EMPTY


def classify_paper(
    view: ScanView, reference: Reference, origin_map: F64, sensor: Sensor, settings: VotingSettings
) -> tuple[U8, I32]:
    """The paper's five states and the votes each is worth: (states uint8, weights int32 in VOTE_UNITs), (rows, cols).

    A cell with n_min points or more is occupied and worth w(n), Eq. (1); with 1 to n_min - 1 undetermined; with none
    empty if it was visible, else undetermined. NO_VOTE where no ray was fired, and, in case 5 (``skip_tall_cells``),
    where the map begins above the sensor's view at that range. ``origin_map`` (3,): the sensor, map metres.
    """
    states = np.empty(view.counts.shape, dtype=np.uint8)
    weights = np.empty(view.counts.shape, dtype=np.int32)
    table = weight_table(settings.weighted, settings.a, settings.b, settings.k, settings.n_min)
    tall = _TALL[settings.tall_rule if settings.skip_tall_cells else "none"]
    grid = view.grid
    seen = Seen(view.counts, view.hit, view.passed, view.sight, origin_map, grid.x0, grid.y0)
    tan_top = float(np.tan(np.radians(sensor.fov_top_deg)))
    rule = Rule(_OCCLUSION[settings.occlusion], tall, tan_top, table, settings.n_min)
    _paper(seen, Mapped(reference.occupied, reference.counts, reference.bottom_z), rule, states, weights)
    return states, weights


class Tally:
    """Votes per cell and class over a drive: :func:`mapvote.core.voting.cast` on the tiles that a window touches."""

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        self.tiles: dict[TileIndex, I32] = {}
        """(256, 256, 5) int32 in VOTE_UNITs."""

    def cast(self, grid: Grid, states: U8, weights: I32) -> None:
        """Cast one scan's ``states`` (rows, cols of ``grid``) with ``weights``."""
        for tile in grid.tiles():
            window = self.lattice.tile(tile)
            common = window.intersection(grid)
            if tile not in self.tiles:
                self.tiles[tile] = np.zeros((TILE_CELLS, TILE_CELLS, N_STATES), dtype=np.int32)
            inner, outer = common.slices_in(window), common.slices_in(grid)
            cast(self.tiles[tile][inner], states[outer], weights[outer])


class PaperVoter:
    """Paper III: every scan classifies every cell and casts its votes."""

    def __init__(self, voting: VotingSettings, sensor: Sensor, point_map: PointMap) -> None:
        self.voting, self.sensor = voting, sensor
        self._tally = Tally(point_map.lattice)

    def observe(self, seen: Observation) -> U64:
        """Cast one scan's votes; returns (rows, cols) words of voxels whose points may be new."""
        states, weights = classify_paper(seen.view, seen.reference, seen.scan.origin_map, self.sensor, self.voting)
        self._tally.cast(seen.view.grid, states, weights)
        return np.where(states == CellState.CHANGED_OCCUPIED, EVERY_BIT, np.uint64(0))

    def votes(self) -> dict[TileIndex, TileVotes]:
        """Every tile with a vote, in ascending order."""
        out = {}
        for tile, tally in sorted(self._tally.tiles.items()):
            if tally.any():
                new = np.where(tally[..., CellState.CHANGED_OCCUPIED] > 0, EVERY_BIT, np.uint64(0))
                out[tile] = TileVotes(tally, decide(tally), None, None, new, None)
        return out
