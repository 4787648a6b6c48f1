"""Every true and every false cell of a case to its cause, from what the vehicles' scans said (scoring/budget.py)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from mapvote.config import PaperSettings, VotingSettings
from mapvote.core.grid import Grid
from mapvote.core.types import I32, NO_VOTE, U8, Bool, CellState, Reference
from mapvote.detection.paper import MOST_POINTS, WORDS, reading_table
from mapvote_lab.evaluation.experiments.cases import Case
from mapvote_lab.evaluation.experiments.kept import KeptDrive
from mapvote_lab.evaluation.experiments.scene import Scene
from mapvote_lab.evaluation.experiments.sweep import decided, rule_of, tallies
from mapvote_lab.evaluation.scoring.budget import FEW, HIDDEN, N_KINDS, TALL, TALL_HIT, Witness
from mapvote_lab.simulation.scenario import load_scenario
from mapvote_lab.simulation.shapes import sample
from mapvote_lab.simulation.world import Body, Role, make_world

_SAMPLE_M = 0.15


@lru_cache(maxsize=16)
def kinds_table(voting: VotingSettings, paper: PaperSettings) -> tuple[U8, I32]:
    """:func:`reading_table` with the kinds of scoring/budget.py for states: what undetermined and invalid came from."""
    states, weights = reading_table(voting, paper)
    at_all, _ = reading_table(voting.model_copy(update={"skip_tall_cells": False}), paper)
    points = np.arange(WORDS) & MOST_POINTS
    kinds = states.copy()
    kinds[(states == CellState.UNDETERMINED) & (points > 0)] = FEW
    kinds[(states == CellState.UNDETERMINED) & (points == 0)] = HIDDEN
    invalid = (states == NO_VOTE) & (at_all != NO_VOTE)
    kinds[invalid & (points >= paper.n_min)] = TALL_HIT
    kinds[invalid & (points < paper.n_min)] = TALL
    return kinds, weights


def witness(scene: Scene, first_map: Reference, drives: Sequence[KeptDrive], case: Case) -> tuple[U8, Witness]:
    """(what the server decides, what is known of each cell) of one of the paper's cases, over the truth's window."""
    mapped, rule = first_map.counts > 0, rule_of(case)
    server, own = decided(drives, mapped, [case])[case.name]
    votes = np.stack([tallies(drive, mapped, [rule], kinds_table, N_KINDS)[rule] for drive in drives])
    world = make_world(load_scenario(scene.scenario, scene.overrides), scene.seed)
    bodies = world.bodies[1:]
    there = {
        "stands": [b for b in bodies if b.role == Role.KEPT],
        "passing": [b for b in bodies if b.role in (Role.PASSING, Role.UNCLEAR)],
        "crown": [b for b in bodies if b.kind == "tree"],
        "parked": [b for b in bodies if b.kind == "parked car" and b.role == Role.KEPT],
    }
    return server, Witness(
        votes=votes,
        own=own,
        mapped=mapped,
        begins_m=np.where(mapped, first_map.bottom_z - first_map.ground_z, np.inf),
        taken=np.stack([drive.taken for drive in drives]).sum(axis=0, dtype=np.uint16),
        passed_off=np.stack([drive.passed_off for drive in drives]).sum(axis=0, dtype=np.uint16),
        beyond=np.stack([drive.beyond for drive in drives]).sum(axis=0, dtype=np.uint16),
        **{name: cells_of(some, first_map.grid) for name, some in there.items()},
    )


def cells_of(bodies: Sequence[Body], grid: Grid) -> Bool:
    """(rows, cols) cells in which one of ``bodies`` has surface."""
    out = np.zeros(grid.shape, dtype=np.bool_)
    if bodies:
        points = sample(np.concatenate([b.triangles for b in bodies]), _SAMPLE_M, np.random.default_rng(0))
        rows, cols, inside = grid.indices_of(points)
        out[rows[inside], cols[inside]] = True
    return out
