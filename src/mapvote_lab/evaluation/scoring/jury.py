"""The jury: what a run is held against, and how it did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mapvote.core.columns import column_bits
from mapvote.core.grid import CELL_SIZE, TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.reference import reference_window
from mapvote.core.types import F64, U8, Reference
from mapvote.fusion.fuse import Decision
from mapvote_lab.evaluation.results import Judgement
from mapvote_lab.evaluation.scoring.cells import Scores, determined_share, score_cells
from mapvote_lab.evaluation.scoring.map_points import MapJudge, MapScores, map_obstacles
from mapvote_lab.evaluation.scoring.objects import score_objects
from mapvote_lab.evaluation.scoring.scene_truth import Truth
from mapvote_lab.evaluation.scoring.truths import TRUTHS, ceiling


@dataclass(frozen=True, slots=True)
class CaseOutcome:
    """What the server made of one case's ballots."""

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
        self.points = MapJudge(map_obstacles(first_map), *_above_ground(self.first_map, truth))
        """What became of the first map's points."""
        self._objects = [{"kind": o["kind"], "cells": truth.cells_of(o["footprint"])} for o in truth.objects]

    def of_states(self, states: U8, vehicle_states: Sequence[U8]) -> Judgement:
        """Scores by every truth, coverage, objects; all states over the truth's window."""
        return self._judge(states, vehicle_states, None)

    def of_update(self, outcome: CaseOutcome) -> Judgement:
        """The same, and what became of the map's points."""
        points = self.points.score(map_obstacles(outcome.updated))
        return self._judge(outcome.states, outcome.vehicle_states, points)

    def ceilings(self) -> dict[str, Scores]:
        """By truth: what perfect labels on every measured point would score (scoring/truths.py)."""
        return {name: ceiling(self.truth, cells) for name, cells in self.truths.items()}

    def _judge(self, states: U8, vehicle_states: Sequence[U8], points: MapScores | None) -> Judgement:
        scores = {name: score_cells(states, cells) for name, cells in self.truths.items()}
        return Judgement(
            strict=scores.pop("strict"),
            provenance=scores.pop("provenance"),
            also=scores,
            coverage=determined_share(vehicle_states, self.truths["strict"]),
            objects=score_objects(states, self.truths["strict"], self._objects, CELL_SIZE),
            map=points,
        )


def _above_ground(reference: Reference, truth: Truth) -> tuple[F64, F64, F64]:
    """Surface samples that could be obstacle points: above the map's ground, or outside the window."""
    chosen = []
    for samples in truth.surfaces():
        rows, cols, inside = reference.grid.indices_of(samples)
        cells = rows.clip(0, reference.grid.rows - 1), cols.clip(0, reference.grid.cols - 1)
        _, obstacle = column_bits(samples[:, 2], reference.ground_z[cells], reference.base[cells])
        chosen.append(samples[~inside | obstacle])
    return chosen[0], chosen[1], chosen[2]
