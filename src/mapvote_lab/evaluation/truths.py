"""The truth as the simulator wrote it, and the truths that decided cells are held against.

The only module that opens a truth folder.

A wall two centimetres from a cell's border fills one cell of a noise-free truth, and two of any cloud with two
centimetres of range noise. **border** is a truth without the cells that change sides when the surfaces move by
``TruthReading.border_m``. :func:`ceiling` is the score of a judge who knows of every point of such a cloud whether its
surface came, went or stayed, but has to answer in cells.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace
from scipy import ndimage

from mapvote.config import PaperSettings
from mapvote.core.columns import column_bits
from mapvote.core.geometry import inverse
from mapvote.core.grid import CELL_SIZE, Grid, Lattice, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.reference import reference_window
from mapvote.core.types import F64, I32, NO_VOTE, U8, Bool, CellState, MapvoteError, Reference
from mapvote.formats.drives.trajectory import read_poses
from mapvote.fusion.fuse import Decision
from mapvote_lab.evaluation.scores import (
    NEIGHBOURS,
    CaseResult,
    MapJudge,
    MapScores,
    PoseErrors,
    Scores,
    cells_with,
    determined_share,
    map_obstacles,
    score_cells,
    score_objects,
)
from mapvote_lab.simulation.truth import Label
from mapvote_lab.simulation.world import Role


@record()
@dataclass(frozen=True, slots=True)
class TruthReading:
    """How cells are read from the simulator's truth."""

    around_m: float = 0.6
    """Cells this far outside a footprint still belong to the object, metres: walls stand on its outline."""
    border_m: float = 0.05
    """A cell is unsure if it changes sides when the surfaces move by this, metres."""
    noise_m: float = 0.02
    """Standard deviation of the range noise of the simulated sensors, metres."""
    draws: int = 8
    """Times that every surface sample is measured for a ceiling."""
    least_points: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64, 128)
    """Points that a ceiling tries as enough for a changed cell."""
    on_surface_m: float = 0.3
    """A map point farther than this from every surface lies on none, metres (as evaluation/scores.py has it)."""


TRUTH_READING = TruthReading()


@dataclass(frozen=True, slots=True)
class Truth:
    """Cells, surfaces, objects and poses of one simulated scene, in the frame in which the survey's RTK speaks."""

    folder: Path
    x0: float
    y0: float
    strict: U8
    provenance: U8
    reason: U8
    """Why a cell is unscored (docs/simulation.md)."""
    densest: U8
    """Most points of built bodies that one scan of a vehicle had in the cell."""
    hit: Bool
    """Where a vehicle recorded a point of a built body."""
    passed: Bool
    """Where a vehicle's ray went through the place of a demolished surface."""
    objects: tuple[dict[str, Any], ...]
    """``kind`` "built" or "demolished", ``footprint`` [[x, y], ..], ``height_m``."""

    @property
    def grid(self) -> Grid:
        """Its cells, on a lattice of their own."""
        return Grid(Lattice(self.x0, self.y0), 0, 0, *self.strict.shape)

    def grid_on(self, lattice: Lattice) -> Grid:
        """The truth's window on a map's lattice; MapvoteError if the two do not fall on the same cells."""
        row = (self.y0 - lattice.y0) / CELL_SIZE
        col = (self.x0 - lattice.x0) / CELL_SIZE
        if abs(row - round(row)) > 1e-6 or abs(col - round(col)) > 1e-6:
            raise MapvoteError(
                f"{self.folder}: its cells start at ({self.x0}, {self.y0}), off the map's lattice "
                f"({lattice.x0}, {lattice.y0}): build the map on multiples of {CELL_SIZE} m"
            )
        return Grid(lattice, round(row), round(col), *self.strict.shape)

    def poses(self, drive: str) -> F64:
        """(n, 4, 4) true T_map_lidar of a drive at its stamps."""
        return read_poses(self.folder / drive / "poses.txt")

    def moving(self, drive: str, scan: int) -> Bool:
        """(n,) which points of the scan's file hit a body that moves."""
        return read_moving(self.folder, drive, scan)

    def surfaces(self) -> tuple[F64, F64, F64]:
        """(kept, added, removed): noise-free surface samples (n, 3), map metres."""
        with np.load(self.folder / "surface.npz") as file:
            points = file["points"].astype(np.float64)
            label = file["label"]
        return points[label == Role.KEPT], points[label == Role.ADDED], points[label == Role.REMOVED]

    def cells_of(self, footprint: list[list[float]], around_m: float = TRUTH_READING.around_m) -> Bool:
        """(rows, cols) cells whose centres lie in a convex footprint or within ``around_m`` of it."""
        corners = np.asarray(footprint)
        turn = np.roll(corners, -1, axis=0) - corners
        x1, y1 = np.roll(corners, -1, axis=0).T
        area = 0.5 * float(np.sum(corners[:, 0] * y1 - corners[:, 1] * x1))
        outward = np.column_stack([turn[:, 1], -turn[:, 0]]) * np.sign(area) / np.linalg.norm(turn, axis=1)[:, None]
        x, y = self.grid.centres()
        inside = np.ones(self.strict.shape, dtype=np.bool_)
        for (cx, cy), (nx, ny) in zip(corners, outward, strict=True):
            inside &= (x[None, :] - cx) * nx + (y[:, None] - cy) * ny <= around_m
        return inside


def read_moving(truth: Path, drive: str, scan: int) -> Bool:
    """(n,) which points of the scan's file hit a body that moves, from the folder of a truth."""
    return np.asarray(np.load(truth / drive / "moving" / f"{scan:06d}.npy"), dtype=np.bool_)


def read_truth(scene: Path) -> Truth:
    """The truth beside simulated drives: ``scene``/truth. MapvoteError if it is not there or not whole."""
    folder = scene / "truth"
    try:
        with np.load(folder / "truth.npz") as file:
            strict = file["strict"]
            provenance = file["provenance"]
            reason = file["reason"]
            densest = file["densest"]
            hit = file["hit"]
            passed = file["passed"]
            x0 = float(file["x0"])
            y0 = float(file["y0"])
        objects = json.loads((folder / "objects.json").read_text())["objects"]
    except (OSError, KeyError, ValueError) as error:
        raise MapvoteError(f"{folder}: no usable truth ({error}); simulate the scene again") from error
    return Truth(folder, x0, y0, strict, provenance, reason, densest, hit, passed, tuple(objects))


def lay_on(states: U8, grid: Grid, window: Grid) -> U8:
    """``states`` over ``grid`` as an array over ``window`` of the same lattice; NO_VOTE where they do not reach."""
    out = np.full(window.shape, NO_VOTE, dtype=np.uint8)
    common = grid.intersection(window)
    if 0 in common.shape:
        return out
    out[common.slices_in(window)] = states[common.slices_in(grid)]
    return out


def rigid_between(T_map_a: F64, T_world_a: F64, arm_m: float = 2.0) -> F64:
    """T_map_world (4, 4) that best carries one trajectory (n, 4, 4) onto the other, least squares (Kabsch 1976).

    Each pose stands for its position and for points ``arm_m`` along its axes, so that a straight road, whose positions
    leave the turn about it open, still fixes all six degrees of freedom.
    """
    to = T_map_a[:, :3, 3].mean(axis=0)
    of = T_world_a[:, :3, 3].mean(axis=0)
    spread = (T_map_a[:, :3, 3] - to).T @ (T_world_a[:, :3, 3] - of)
    spread += arm_m**2 * np.einsum("nij,nkj->ik", T_map_a[:, :3, :3], T_world_a[:, :3, :3])
    u, _, vt = np.linalg.svd(spread)
    T = np.eye(4)
    T[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    T[:3, 3] = to - T[:3, :3] @ of
    return T


def pose_errors(T_found: F64, T_true: F64) -> tuple[F64, F64]:
    """(metres (n,), radians (n,)) between poses (n, 4, 4) in one frame."""
    metres = np.linalg.norm(T_found[:, :3, 3] - T_true[:, :3, 3], axis=1)
    cosines = [0.5 * (np.trace((inverse(a) @ b)[:3, :3]) - 1.0) for a, b in zip(T_found, T_true, strict=True)]
    return metres, np.arccos(np.clip(cosines, -1.0, 1.0))


def error_summary(T_found: F64, T_true: F64) -> PoseErrors:
    """Errors of poses (n, 4, 4), both in one frame; a scan that was not localised is a row of NaN."""
    there = np.isfinite(T_found).all(axis=(1, 2))
    metres, radians = pose_errors(T_found[there], T_true[there])
    if not there.any():
        metres = np.zeros(1)
        radians = np.zeros(1)
    return PoseErrors(
        scans=len(T_found),
        localised=int(there.sum()),
        median_m=float(np.median(metres)),
        p99_m=float(np.percentile(metres, 99)),
        max_m=float(metres.max()),
        median_deg=float(np.degrees(np.median(radians))),
    )


def border(truth: Truth, cells: U8, reading: TruthReading = TRUTH_READING) -> U8:
    """(rows, cols) ``cells``, one of the two definitions of ``truth``; unscored where ``reading.border_m`` decide.

    These are changed cells whose changed surface lies only in the rim of the cell, changed cells next to whose rim
    something stands, and unchanged cells that no standing surface fills firmly, with a changed one at their rim.
    Surfaces are the noise-free samples, .1 m apart (standing ones .25 m), of what rays could reach.
    """
    seen, added, removed = _around(truth, cells)
    changed = np.isin(cells, (Label.CHANGED_OCCUPIED, Label.CHANGED_EMPTY))
    moved = {
        kind: _rims(truth, samples, reading.border_m)
        for kind, samples in ((Label.CHANGED_OCCUPIED, added), (Label.CHANGED_EMPTY, removed))
    }
    stands, stands_near = _rims(truth, seen, reading.border_m)
    unsure = changed & stands_near
    for kind, (firm, near) in moved.items():
        unsure |= (cells == kind) & ~firm
        unsure |= ~changed & near & ~stands
    return np.where(unsure, np.uint8(Label.UNSCORED), cells)


def _around(truth: Truth, cells: U8) -> tuple[F64, F64, F64]:
    """Surface samples (n, 3) that (stand, came, went); of the standing ones those that can be seen near a change."""
    kept, added, removed = truth.surfaces()
    changed = np.isin(cells, (Label.CHANGED_OCCUPIED, Label.CHANGED_EMPTY))
    near = ndimage.binary_dilation(changed | (_count(truth, np.concatenate([added, removed])) > 0), NEIGHBOURS)
    beside = near & ~changed  # standing points of a changed cell were hidden, or lie on the ground
    return kept[truth.grid.value_at(beside, kept)], added, removed


def _rims(truth: Truth, samples: F64, border_m: float) -> tuple[Bool, Bool]:
    """(cells with a sample farther than ``border_m`` from their rim, cells with one no farther than that outside
    it)."""
    x = (samples[:, 0] - truth.x0) % CELL_SIZE
    y = (samples[:, 1] - truth.y0) % CELL_SIZE
    inner = np.abs(np.column_stack([x, y]) - CELL_SIZE / 2).max(axis=1, initial=0.0) < CELL_SIZE / 2 - border_m
    firm = _count(truth, samples[inner]) > 0
    near = np.zeros_like(firm)
    for dx in (-border_m, border_m):
        for dy in (-border_m, border_m):
            near |= _count(truth, samples + np.array([dx, dy, 0.0])) > 0
    return firm, near


def _count(truth: Truth, samples: F64) -> I32:
    """(rows, cols) samples in each cell."""
    r, c, inside = truth.grid.indices_of(samples)
    rows, cols = truth.strict.shape
    return np.bincount(r[inside] * cols + c[inside], minlength=rows * cols).reshape(rows, cols).astype(np.int32)


def ceiling(truth: Truth, cells: U8, reading: TruthReading = TRUTH_READING) -> Scores:
    """The best that perfect labels on a cloud with range noise score against ``cells``.

    Every surface sample is measured ``reading.draws`` times, ``reading.noise_m`` off in the plane. A cell is changed if
    it holds enough points of a surface that came, or went, and none of one that stands; how many are enough is chosen
    on the truth itself, so no method that votes in cells can be expected to do better.
    """
    kept, added, removed = _around(truth, cells)
    rng = np.random.default_rng(0)
    stands, came, went = (_measured(truth, samples, rng, reading) for samples in (kept, added, removed))
    best = [score_cells(_answer(stands, came, went, least), cells) for least in reading.least_points]
    return max(best, key=lambda scores: scores.macro_f1)


def _measured(truth: Truth, samples: F64, rng: np.random.Generator, reading: TruthReading) -> I32:
    out = np.zeros(truth.strict.shape, dtype=np.int32)
    for _ in range(reading.draws):
        noise = rng.normal(0.0, reading.noise_m, samples.shape)
        noise[:, 2] = 0.0
        out += _count(truth, samples + noise)
    return out


def _answer(stands: I32, came: I32, went: I32, least: int) -> U8:
    states = np.full(stands.shape, CellState.UNCHANGED_EMPTY, dtype=np.uint8)
    states[(went >= least) & (stands < least) & (came < least)] = CellState.CHANGED_EMPTY
    states[(came >= least) & (stands < least) & (went < least)] = CellState.CHANGED_OCCUPIED
    return states


def could_be_known(truth: Truth, first_map: Reference) -> U8:
    """Provenance, less what a vote by scans cannot know: (rows, cols).

    A built surface of which no scan of any vehicle had n_min points in the cell (they count the true points, of the
    simulator), and a demolished one of which the map holds no point. Both are unscored.
    """
    out = truth.provenance.copy()
    out[(out == Label.CHANGED_OCCUPIED) & (truth.densest < PaperSettings().n_min)] = Label.UNSCORED
    out[(out == Label.CHANGED_EMPTY) & (first_map.counts == 0)] = Label.UNSCORED
    return out


def known(truth: Truth, first_map: Reference, reading: TruthReading = TRUTH_READING) -> U8:
    """``border`` of the strict truth, less the cells of which nobody could know better: (rows, cols).

    Unscored besides are a built surface of which no vehicle recorded a point in the cell, a demolished one through
    whose place no vehicle's ray went, and an unchanged cell in which the first map holds points on nothing: it has
    points, and no surface that stood at the survey comes within ``reading.on_surface_m`` of the cell.
    """
    out = border(truth, truth.strict, reading)
    undecided = ((out == Label.CHANGED_OCCUPIED) & ~truth.hit) | ((out == Label.CHANGED_EMPTY) & ~truth.passed)
    kept, _, removed = truth.surfaces()
    stood = cells_with(np.concatenate([kept, removed]), first_map.grid)
    near = ndimage.binary_dilation(stood, NEIGHBOURS, iterations=round(reading.on_surface_m / CELL_SIZE))
    on_nothing = (out == Label.UNCHANGED) & (first_map.counts > 0) & ~near
    return np.where(undecided | on_nothing, np.uint8(Label.UNSCORED), out)


TRUTHS: Mapping[str, Callable[[Truth, Reference], U8]] = {
    "known": known,
    "strict": lambda truth, first_map: truth.strict,
    "provenance": lambda truth, first_map: truth.provenance,
    "could be known": could_be_known,
    "border": lambda truth, first_map: border(truth, truth.strict),
    "border, provenance": lambda truth, first_map: border(truth, truth.provenance),
}
"""Label of each cell by each truth, over the window of the truth: 0 unchanged, 1 changed-occupied, 2 changed-empty, 255
unscored; ``first_map`` is the map that is voted on, over the same window (docs/decisions/truth.md)."""


@dataclass(frozen=True, slots=True)
class CaseOutcome:
    """Result of fusing one case's ballots."""

    updated: PointMap
    states: U8
    """Decided, over the truth's window."""
    vehicle_states: list[U8]
    """Each vehicle's own decision, over the truth's window."""
    decisions: Mapping[TileIndex, Decision]
    seconds: float
    """Spent on fusing."""


class Jury:
    """Scores whatever was decided about one first map against one truth."""

    def __init__(self, first_map: PointMap, truth: Truth) -> None:
        self.truth = truth
        self.window = truth.grid_on(first_map.lattice)
        self.first_map = reference_window(first_map, self.window)
        """Over the truth's window."""
        self.truths = {name: judge(truth, self.first_map) for name, judge in TRUTHS.items()}
        """(rows, cols) of each, by name."""
        scored = partial(truth.grid.value_at, truth.strict != Label.UNSCORED)
        self.points = MapJudge(map_obstacles(first_map), *_above_ground(self.first_map, truth), scored)
        """Judges the fate of the first map's points."""
        self._objects = [{"kind": o["kind"], "cells": truth.cells_of(o["footprint"])} for o in truth.objects]

    def of_states(self, states: U8, vehicle_states: Sequence[U8], points: MapScores | None = None) -> CaseResult:
        """Scores by every truth, coverage, objects; all states over the truth's window. No ballot was sent."""
        scores = {name: score_cells(states, cells) for name, cells in self.truths.items()}
        return CaseResult(
            strict=scores.pop("strict"),
            provenance=scores.pop("provenance"),
            also=scores,
            coverage=determined_share(vehicle_states, self.truths["strict"]),
            objects=score_objects(states, self.truths["strict"], self._objects),
            map=points,
            bytes_per_vehicle=[],
        )

    def of_update(self, outcome: CaseOutcome, sizes: Sequence[int] = (), state_sizes: Sequence[int] = ()) -> CaseResult:
        """The same scores, the fate of the map's points, and the bytes of each ballot and of its votes alone."""
        updated = map_obstacles(outcome.updated)
        judged = self.of_states(outcome.states, outcome.vehicle_states, self.points.score(updated))
        insides = [(one["kind"], partial(self.truth.grid.value_at, one["cells"])) for one in self._objects]
        judged = replace(judged, rests=self.points.rests(updated, insides))
        return replace(judged, bytes_per_vehicle=list(sizes), state_bytes_per_vehicle=list(state_sizes))

    def ceilings(self) -> dict[str, Scores]:
        """Scores of perfect labels on every measured point, by truth."""
        return {name: ceiling(self.truth, cells) for name, cells in self.truths.items()}


def _above_ground(reference: Reference, truth: Truth) -> tuple[F64, F64, F64]:
    """Surface samples that could be obstacle points: above the map's ground, or outside the window."""
    chosen = []
    for samples in truth.surfaces():
        rows, cols, inside = reference.grid.indices_of(samples)
        cells = rows.clip(0, reference.grid.rows - 1), cols.clip(0, reference.grid.cols - 1)
        _, obstacle = column_bits(samples[:, 2], reference.ground_z[cells], reference.base[cells])
        chosen.append(samples[~inside | obstacle])
    return chosen[0], chosen[1], chosen[2]
