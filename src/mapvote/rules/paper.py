"""One scan against the reference: its observation of each cell, and the state that follows (paper III-A, III-B).

An observation is 16 bits per cell and does not depend on how the paper's open sentences are read: the number of points,
whether the cell could be seen under every rule of sight, whether the map is too tall there. Every reading of the paper
is a look-up table over these words, so stored words answer all readings without the scan.

Each open sentence of the paper is a setting of ``[paper]``. The defaults are the readings that reproduce the paper's
Tables II to IV; docs/method.md says why.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import lru_cache, reduce
from typing import get_args

import numpy as np
from pydantic import ValidationError

from mapvote.codec.ballot import Planes
from mapvote.config import PaperSettings, Settings, VotingSettings, wanted_of
from mapvote.core.columns import EVERY_BIT, below_top, span_of
from mapvote.core.grid import CELL_SIZE, Grid, TileIndex, window_around
from mapvote.core.kernel import kernel
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.sensors import Sensor
from mapvote.core.types import F32, F64, I32, NO_VOTE, U8, U16, U64, Bool, CellState, MapvoteError, Reference
from mapvote.core.voting import VOTE_UNIT, plurality, to_wire, weight_table
from mapvote.perception.frontend import Observation
from mapvote.perception.raycast import ScanView, Sight, cast_rays
from mapvote.rules.voter import Counted, Tally


@record(votes=True)
@dataclass(frozen=True, slots=True)
class PaperCounts:
    """Counts of the paper's rule."""

    counted_points: int = 15
    """Number up to which points are counted, where Eq. (1) has reached its bound."""


PAPER_COUNTS = PaperCounts()
# Kernels take no records: they read these names.
COUNTED_POINTS = PAPER_COUNTS.counted_points
CLEAR, CLEAR_OF_CELLS, BEFORE_FARTHEST, THROUGH_COLUMN, FIRED = (1 << k for k in range(4, 9))
"""Bits of a word: no return above the ground before the cell; no return in an occupied cell before it; not behind the
farthest return; a ray through the heights in which the map has points; any ray in this direction. Movers occlude."""
WITHOUT_MOVERS = 5
"""Bits by which the same five bits are shifted for the scan without the points of moving objects."""
BEGINS_ABOVE, REACHES_HIGHER = 1 << 14, 1 << 15
"""The map begins above the sensor's view at that range; it reaches higher than the scan's points."""
N_WORDS = 1 << 16
_BEHIND, _CLEAR, _UNSEEN = np.uint8(Sight.BEHIND), np.uint8(Sight.CLEAR), np.uint8(Sight.NEVER)
LEVEL = np.array([0.0, 0.0, 1.0])


@kernel
def _of_sight(sight: U8, clear_of_cells: U8, passed: U64, occupied: U64, shift: int, words: U16) -> None:
    """The five bits of one view into ``words``, in place; all planes (rows, cols)."""
    for r in range(sight.shape[0]):
        for c in range(sight.shape[1]):
            if sight[r, c] == _UNSEEN:
                continue
            word = FIRED
            if sight[r, c] >= _BEHIND:
                word |= BEFORE_FARTHEST
            if sight[r, c] == _CLEAR:
                word |= CLEAR
            if clear_of_cells[r, c] == _CLEAR:
                word |= CLEAR_OF_CELLS
            if (span_of(occupied[r, c]) & passed[r, c] != 0) if occupied[r, c] else sight[r, c] >= _BEHIND:
                word |= THROUGH_COLUMN
            words[r, c] |= np.uint16(word << shift)


@kernel
def _of_points(
    counts: I32, hit: U64, occupied: U64, bottom_z: F32, eye: tuple[F64, F64], x0: float, y0: float, tan_top: float,
    words: U16,
) -> None:  # fmt: skip
    """``eye``: the sensor's place and its upward axis, (3,) each."""
    origin, up = eye
    for r in range(counts.shape[0]):
        for c in range(counts.shape[1]):
            word = min(counts[r, c], COUNTED_POINTS)
            if occupied[r, c]:
                dx = x0 + (c + 0.5) * CELL_SIZE - origin[0]
                dy = y0 + (r + 0.5) * CELL_SIZE - origin[1]
                dz = bottom_z[r, c] - origin[2]
                above = dx * up[0] + dy * up[1] + dz * up[2]  # as the sensor leans, not as the world lies
                if above > tan_top * np.sqrt(max(dx * dx + dy * dy + dz * dz - above * above, 0.0)):
                    word |= BEGINS_ABOVE
            if occupied[r, c] > below_top(hit[r, c]):
                word |= REACHES_HIGHER
            words[r, c] |= np.uint16(word)


def cell_words(
    view: ScanView,
    reference: Reference,
    origin_map: F64,
    sensor: Sensor,
    clear_of_cells: U8 | None = None,
    without_movers: tuple[ScanView, U8] | None = None,
    up_map: F64 = LEVEL,
) -> U16:
    """(rows, cols) words of one scan seen from ``origin_map`` (3,), map metres, by a sensor with the upward axis
    ``up_map`` (3,).

    ``clear_of_cells``: the :class:`Sight` of each cell where only occupied cells occlude; default: the view's.
    ``without_movers``: view and that sight of the scan without its movers; default: those of the whole scan.
    """
    words = np.zeros(view.counts.shape, dtype=np.uint16)
    tan_top = float(np.tan(np.radians(sensor.fov_top_deg)))
    grid = view.grid
    _of_points(
        view.counts,
        view.hit,
        reference.occupied,
        reference.bottom_z,
        (origin_map, up_map),
        grid.x0,
        grid.y0,
        tan_top,
        words,
    )
    cells = view.sight if clear_of_cells is None else clear_of_cells
    _of_sight(view.sight, cells, view.passed, reference.occupied, 0, words)
    still, still_cells = (view, cells) if without_movers is None else without_movers
    _of_sight(still.sight, still_cells, still.passed, reference.occupied, WITHOUT_MOVERS, words)
    return words


def sightings(seen: Observation, sensor: Sensor, n_min: int, reading: PaperSettings | None = None) -> U16:
    """(rows, cols) words over the view's grid. Only the bits that the setting ``reading`` uses are computed; None: all.
    ``n_min``: points that make a cell occupied, where only occupied cells occlude."""
    by_cells = reading is None or reading.line_of_sight == "cells"
    removed = reading is None or reading.movers == "removed"
    everything = np.ones(len(seen.moving), dtype=np.bool_)
    cells = _clear_of_cells(seen, everything, n_min) if by_cells else None
    without = None
    if removed:
        still = ~seen.moving
        view = _cast(seen, still, seen.scan.obstacle)
        without = view, _clear_of_cells(seen, still, n_min) if by_cells else view.sight
    words = cell_words(seen.view, seen.reference, seen.scan.origin_map, sensor, cells, without, seen.scan.up_map)
    if reading is not None:
        words[~votes_in(seen.view.grid, seen.scan.origin_map, reading.window_m)] = 0
    return words


def votes_in(grid: Grid, origin_map: F64, window_m: float) -> Bool:
    """(rows, cols) of ``grid``: the cells of the square of ``window_m`` around the vehicle."""
    inner = window_around(grid.lattice, float(origin_map[0]), float(origin_map[1]), window_m).intersection(grid)
    out = np.zeros(grid.shape, dtype=np.bool_)
    out[inner.slices_in(grid)] = True
    return out


def _clear_of_cells(seen: Observation, chosen: Bool, n_min: int) -> U8:
    """Sight where only returns in cells with n_min obstacle points or more occlude the cells behind them."""
    scan = seen.scan
    counted = chosen & scan.obstacle & (scan.cell >= 0)
    counts = np.bincount(scan.cell[counted], minlength=seen.reference.counts.size)
    return _cast(seen, chosen, counted & (counts[scan.cell] >= n_min)).sight


def _cast(seen: Observation, chosen: Bool, obstacle: Bool) -> ScanView:
    """The rays of the ``chosen`` points (n,) alone; ``obstacle`` (n,): those that occlude the cells behind them."""
    scan = seen.scan
    views = []
    for lidar in scan.lidars:
        own = chosen[lidar.part]
        still = np.zeros(int(own.sum()), dtype=np.bool_)
        rows = np.ascontiguousarray(lidar.own_rows(scan.rows)[:, own])
        origin_map = lidar.origin_map(scan.origin_map)
        cell = scan.cell[lidar.part][own]
        views.append(cast_rays(rows, origin_map, obstacle[lidar.part][own], still, seen.reference, cell))
    return reduce(ScanView.joined, views)


@lru_cache(maxsize=64)
def reading_table(voting: VotingSettings, paper: PaperSettings) -> tuple[U8, I32]:
    """The reading as a table: (states (2, 65536) by whether the map holds points and by word, weights (65536,)).

    A cell with n_min points or more is occupied and worth w(n), Eq. (1), in VOTE_UNITs; with fewer undetermined or
    empty; with none empty if it was visible, else undetermined or without a vote. NO_VOTE where no ray was fired, and,
    in case 5 (``skip_tall_cells``), where the map is too tall.
    """
    # The five states by the number of points and by sight.
    words = np.arange(N_WORDS)
    n = words & COUNTED_POINTS
    shift = WITHOUT_MOVERS if paper.movers == "removed" else 0
    sights = {"points": CLEAR, "cells": CLEAR_OF_CELLS, "farthest": BEFORE_FARTHEST, "column": THROUGH_COLUMN}
    visible = words & (sights[paper.line_of_sight] << shift) != 0
    fired = words & (FIRED << shift) != 0
    occupied = n >= paper.n_min
    empty = (n == 0) & visible
    if paper.few_points == "empty":
        empty |= (n > 0) & ~occupied
    unseen = int(CellState.UNDETERMINED) if paper.occluded == "votes" else NO_VOTE
    states = np.empty((2, N_WORDS), dtype=np.uint8)
    # A table each for cells without and with points in the map.
    for mapped, if_occupied, if_empty in (
        (0, CellState.CHANGED_OCCUPIED, CellState.UNCHANGED_EMPTY),
        (1, CellState.UNCHANGED_OCCUPIED, CellState.CHANGED_EMPTY),
    ):
        states[mapped] = np.where(n > 0, CellState.UNDETERMINED, np.where(fired, unseen, NO_VOTE))
        states[mapped, empty] = if_empty
        states[mapped, occupied] = if_occupied
        if voting.skip_tall_cells:
            tall = {"bottom": BEGINS_ABOVE, "height": REACHES_HIGHER}[paper.tall_rule]
            states[mapped, words & tall != 0] = NO_VOTE
    points = weight_table(voting.weighted, voting.a, voting.b, voting.k, paper.n_min, COUNTED_POINTS)
    return states, np.where(occupied, points[n], VOTE_UNIT).astype(np.int32)


def classify_paper(words: U16, mapped: Bool, voting: VotingSettings, paper: PaperSettings) -> tuple[U8, I32]:
    """The paper's five states and the votes each is worth: (states uint8, weights int32 in VOTE_UNITs), (rows, cols).

    ``words`` (rows, cols): the scan's (:func:`sightings`); ``mapped``: where the map holds obstacle points; see
    :func:`reading_table`.
    """
    states, weights = reading_table(voting, paper)
    return states[mapped.astype(np.intp), words], weights[words]


def paper_voter(settings: Settings, sensor: Sensor, point_map: PointMap) -> PaperVoter:
    """The voter of ``PAPER`` (core/rule.py)."""
    return PaperVoter(settings.voting, settings.paper, sensor, point_map)


class PaperVoter:
    """Paper III: every scan classifies every cell and casts its votes."""

    def __init__(self, voting: VotingSettings, paper: PaperSettings, sensor: Sensor, point_map: PointMap) -> None:
        self.voting = voting
        self.paper = paper
        self.sensor = sensor
        self._tally = Tally(point_map.lattice)

    def observe(self, seen: Observation) -> U64:
        """Cast one scan's votes; returns (rows, cols) words of voxels whose points may be new."""
        words = sightings(seen, self.sensor, self.paper.n_min, self.paper)
        states, weights = classify_paper(words, seen.reference.counts > 0, self.voting, self.paper)
        self._tally.cast(seen.view.grid, states, weights)
        return np.where(states == CellState.CHANGED_OCCUPIED, EVERY_BIT, np.uint64(0))

    def each(self, only: Collection[TileIndex] | None = None) -> Iterator[tuple[TileIndex, Counted]]:
        """Every tile with a vote, in ascending order; ``only``: of these tiles."""
        for tile, tally in sorted(self._tally.tiles.items()):
            if (only is None or tile in only) and tally.any():
                new = np.where(tally[..., CellState.CHANGED_OCCUPIED] > 0, EVERY_BIT, np.uint64(0))
                yield tile, Counted(Planes(states=plurality(tally), tally=to_wire(tally)), new)


def readings_of(base: PaperSettings, only: str | None = None) -> dict[str, PaperSettings]:
    """By name ("as set", "occluded abstains", "n_min 3", ..): ``base``, and it with one sentence read otherwise.

    ``only``: the one setting that is varied; None: each in turn.
    """
    numbers = {"n_min": (3, 5, 8), "window_m": (80.0, 60.0, 40.0)}
    readings = {"as set": base}
    for setting, field in PaperSettings.model_fields.items():
        for value in numbers.get(setting) or get_args(field.annotation):
            if only in (None, setting) and value != getattr(base, setting):
                readings[f"{setting} {value}"] = base.model_copy(update={setting: value})
    return readings


def read(base: PaperSettings, changes: str) -> PaperSettings:
    """``base`` with ``changes`` such as "occluded=abstains, n_min=3". MapvoteError names the settings that exist."""
    values = base.model_dump()
    for piece in changes.split(","):
        setting, _, value = (part.strip() for part in piece.partition("="))
        if setting not in values:
            raise MapvoteError(f"reading {piece.strip()!r}: choose {', '.join(values)}, as in occluded=abstains")
        values[setting] = value
    try:
        return PaperSettings.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise MapvoteError(f"reading {first['loc'][0]}={first['input']}: {wanted_of(first)}") from error
