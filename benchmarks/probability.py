"""Fit the probabilities of a change and of a false deletion to simulated scenes, and check them on others.

    python benchmarks/probability.py CACHE [--fit SCENE:SEED[:SCANS] ...] [--check ...] [--out results/probability.csv]

One command: drives what CACHE lacks, prints the numbers that detection/surfaces.py and fusion/loss_budget.py hold
(a test does not: paste them), then what docs/measurements/probability.md shows, of the scenes that nothing was fitted
to: ECE, Brier score and bins, beside those of the votes alone, and for each budget of false deletions what waits, what
goes, what was promised of that and what came of it. ``--as-is`` fits nothing and checks the numbers that the program
has. The first stage is of single vehicles against the strict truth; the second of what all vehicles decide; the third,
harm, of what any two of them or more decide, for such cells are few. Every scene weighs alike but in the third, where
every cell does.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapvote.codec.ballot import STEPS_PER_NAT, UNSAID
from mapvote.core.types import F64, I64, Bool, CellState
from mapvote.detection import surfaces as confidence
from mapvote.fusion import loss_budget
from mapvote_lab.evaluation.scores import binned
from probability_scenes import Cells, called, decided, driven, stacked, taken

FIT = ("corner:1", "corner:22", "corner:44", "corner:61", "junction:1", "street:2", "slanted:1")
CHECK = ("corner:32", "corner:42", "corner:62", "corner:63", "corner:64", "corner:65", "junction:2", "junction:3",
         "street:10", "street:11", "street:13", "corner:61:::5", "junction:2:::5", "street:2:::5")  # fmt: skip
BUDGETS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4)
FEWEST = 2
"""Vehicles that a change needs."""
KINDS = {"built": CellState.CHANGED_OCCUPIED, "demolished": CellState.CHANGED_EMPTY}
RIDGE = 0.1
"""Of the harm curve: events are few, and each parameter must pay for itself."""


def fitted(told: F64, true: Bool, weights: F64, ridge: float = 1e-3) -> F64:
    """(k,) of a logistic curve over ``told`` (n, k), by Newton's method."""
    curve = np.zeros(told.shape[1])
    for _ in range(100):
        said = 1.0 / (1.0 + np.exp(-told @ curve))
        slope = told.T @ (weights * (true - said)) - ridge * curve
        bend = (told.T * (weights * said * (1.0 - said))) @ told + ridge * np.eye(len(curve))
        step = np.linalg.solve(bend, slope)
        curve = curve + step
        if np.abs(step).max() < 1e-9:
            break
    return curve


def evenly(scene: I64) -> F64:
    """(n,) weights by which every scene counts alike."""
    sizes = np.bincount(scene)
    return len(scene) / (np.count_nonzero(sizes) * sizes[scene])


def fit(streets: Sequence[str], cache: Path) -> None:
    """Set the program's numbers by these scenes, and print them."""
    driven_streets = [driven(name, cache) for name in streets]
    alone = stacked([called(street, k) for k, street in enumerate(driven_streets)])
    curves = []
    for name, state in KINDS.items():
        mine = taken(alone, alone.scored & (alone.states == state))
        told = np.column_stack([np.ones(len(mine.states)), mine.looked, mine.depth_m])
        curves.append(told_as("detection/surfaces.py", name, fitted(told, mine.true, evenly(mine.scene))))
    confidence._BUILT, confidence._DEMOLISHED = curves
    parts = [cells for k, street in enumerate(driven_streets) for cells in decided(street, k, curves, FEWEST)]
    every = stacked(parts)
    said = taken(every, every.scored & (every.vehicles == every.vehicles.max()) & (every.odds != UNSAID))
    for name, state in KINDS.items():
        mine = taken(said, said.states == state)
        told = np.column_stack([np.ones(len(mine.states)), mine.odds / STEPS_PER_NAT])
        curve = told_as("fusion/loss_budget.py", f"{name}, said", fitted(told, mine.true, evenly(mine.scene)))
        setattr(loss_budget, f"_{name.upper()}_SAID", curve)
    emptied = taken(every, (every.states == CellState.CHANGED_EMPTY) & (every.odds != UNSAID))
    row = np.minimum(emptied.standing, loss_budget.STANDING) / loss_budget.STANDING
    told = np.column_stack([np.ones(len(row)), row, emptied.odds / STEPS_PER_NAT])
    ones = np.ones(len(told))
    print(f"{emptied.harm.sum()} of {len(told)} emptied cells of {len(parts)} tiles and rounds lost what stands")
    alone_curve = fitted(told[:, :2], emptied.harm, ones, RIDGE)
    loss_budget._FALSE_DELETION = told_as("fusion/loss_budget.py", "false deletion", alone_curve)
    curve = fitted(told, emptied.harm, ones, RIDGE)
    loss_budget._FALSE_DELETION_SAID = told_as("fusion/loss_budget.py", "false deletion, said", curve)


def told_as(where: str, name: str, curve: F64) -> F64:
    """The curve, rounded as it is printed."""
    rounded = np.round(curve, 3)
    print(f"{where}: {name}: {rounded.tolist()}")
    return rounded


def check(names: Sequence[str], cache: Path, out: Path | None) -> None:
    """Print, and write as CSV, how the program's numbers do on these scenes."""
    curves = confidence._BUILT, confidence._DEMOLISHED
    every = [stacked(list(decided(driven(name, cache), k, curves, FEWEST))) for k, name in enumerate(names)]
    rows: list[dict[str, object]] = []
    by_kind = {
        name: [taken(c, c.scored & (c.states == state) & (c.vehicles == c.vehicles.max())) for c in every]
        for name, state in KINDS.items()
    }
    for name, of_all in by_kind.items():
        print(f"\n{name}: scene | cells | true | ECE, by votes | Brier, by votes, share alone | bins")
        for scene, cells in [*zip(names, of_all, strict=True), ("all", stacked(of_all))]:
            rows += reliability_of(scene, name, cells)
    print(
        "\nbudget | scene | emptied | go | wait | lost what stands: before, now, promised | "
        "of what waits: lost, said | stale points that go"
    )
    emptied = [taken(c, (c.states == CellState.CHANGED_EMPTY) & (c.vehicles == c.vehicles.max())) for c in every]
    for budget in BUDGETS:
        for scene, cells in [*zip(names, emptied, strict=True), ("all", stacked(emptied))]:
            rows.append(within(budget, scene, cells))
        pairs = stacked([taken(c, c.states == CellState.CHANGED_EMPTY) for c in every])
        rows.append(within(budget, "all, and any two vehicles", pairs))
        silent = replace(pairs, odds=np.full_like(pairs.odds, UNSAID))
        rows.append(within(budget, "the same, had they not said how sure they are", silent))
    if out is not None:
        columns = list(dict.fromkeys(key for row in rows for key in row))
        with out.open("w", newline="") as stream:
            table = csv.DictWriter(stream, fieldnames=columns, lineterminator="\n")
            table.writeheader()
            table.writerows({name: _short(value) for name, value in row.items()} for row in rows)


def _short(value: object) -> object:
    return float(f"{value:.4g}") if isinstance(value, float) else value


def reliability_of(scene: str, kind: str, cells: Cells) -> list[dict[str, object]]:
    """A row a bin, of decided cells of one kind."""
    known = cells.states, cells.votes, cells.against, cells.beside
    found = binned(loss_budget.change_probability(*known, cells.odds), cells.true)
    before = binned(loss_budget.change_probability(*known), cells.true)
    share = float(cells.true.mean())
    bins = [f"{p:.2f} -> {t:.2f} ({n})" for p, t, n in zip(found.predicted, found.true, found.cells, strict=True) if n]
    errors = f"{found.calibration_error:.3f}, {before.calibration_error:.3f}"
    brier = f"{found.brier:.3f}, {before.brier:.3f}, {share * (1 - share):.3f}"
    print(f"{scene} | {len(cells.states)} | {share:.3f} | {errors} | {brier} | {', '.join(bins)}")
    whole = {"scene": scene, "kind": kind, "ece": found.calibration_error, "brier": found.brier}
    old = {"ece_by_votes": before.calibration_error, "brier_by_votes": before.brier}
    return [
        whole | old | {"bin": k, "cells": int(n), "predicted": p, "true": t}
        for k, (p, t, n) in enumerate(zip(found.predicted, found.true, found.cells, strict=True))
        if n
    ]


def within(budget: float, scene: str, cells: Cells) -> dict[str, object]:
    """What a budget lets go of the cells that are emptied, what was promised of these, and what came of it."""
    said = loss_budget.false_deletion_probability(cells.standing, cells.odds)
    goes = said <= budget
    promised = float(said[goes].mean()) if goes.any() else 0.0
    lost, n = int(cells.harm[goes].sum()), int(goes.sum())
    stale = int(cells.stale[goes].sum()) / max(int(cells.stale.sum()), 1)
    wait = 1.0 - n / max(len(said), 1)
    rate = lost / max(n, 1)
    of_waiting = [float(one[~goes].mean()) if n < len(said) else 0.0 for one in (cells.harm, said)]
    told = f"{int(cells.harm.sum())}, {lost} ({rate:.1e}), {promised:.1e} | {of_waiting[0]:.1e}, {of_waiting[1]:.1e}"
    print(f"{budget:g} | {scene} | {len(said)} | {n} | {100 * wait:.1f} % | {told} | {100 * stale:.1f} %")
    return {
        "scene": scene, "kind": "false deletions", "budget": budget, "emptied": len(said), "go": n,
        "false_before": int(cells.harm.sum()), "false": lost, "promised": promised, "stale_share": stale,
        "waiting_false": of_waiting[0], "waiting_said": of_waiting[1],
    }  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cache", type=Path, help="folder for drives, maps and what vehicles knew")
    parser.add_argument("--fit", nargs="*", default=FIT)
    parser.add_argument("--check", nargs="*", default=CHECK)
    parser.add_argument("--as-is", action="store_true", help="fit nothing")
    parser.add_argument("--out", type=Path, help="CSV")
    asked = parser.parse_args()
    if not asked.as_is:
        fit(asked.fit, asked.cache)
    if asked.check:
        check(asked.check, asked.cache, asked.out)
