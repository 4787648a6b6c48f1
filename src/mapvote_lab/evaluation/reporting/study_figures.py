"""What a method is worth rule by rule, under worse conditions, and how far its probabilities hold: as charts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mapvote import plots as style
from mapvote.core.types import CellState
from mapvote_lab.evaluation.columns_v1.rules import LETTERS, Rules
from mapvote_lab.evaluation.experiments.attacks import ATTACKS
from mapvote_lab.evaluation.experiments.cases import COLUMNS_V1
from mapvote_lab.evaluation.experiments.imported_map import TAUGHT
from mapvote_lab.evaluation.reporting.matrix_tables import FIGURES, Results, rounds_of
from mapvote_lab.evaluation.results import Judgement
from mapvote_lab.evaluation.scoring.reliability import Reliability

_MEASURES = {
    "mean of the three classes": (style.STANDING, "o"),
    "changed, occupied": (style.NEW, "D"),
    "changed, empty": (style.GONE, "X"),
}
"""Shapes as well as colours."""
_BY_CASE = "1 column"
"""Of the paper's cases the one that scores best on simulated streets."""


@dataclass(frozen=True, slots=True)
class _Condition:
    told: str
    experiment: str
    columns: Sequence[str] = (COLUMNS_V1,)
    """Rounds, of which the worst is shown seed by seed."""
    paper: Sequence[str] = (_BY_CASE,)


def _lying(k: int, experiment: str) -> _Condition:
    rounds = [f"{COLUMNS_V1}, {k} of {2 * k + 1} {name}" for name in ATTACKS]
    return _Condition(f"{k} of {2 * k + 1} lie, the worst lie", experiment, rounds, ())


_CONDITIONS = (
    _Condition("as it is", "main"),
    _Condition("poses off by 0.1 m, 0.2°", "noise"),
    _Condition("the same, and told so", "noise told"),
    _Condition("5 scans a second", "5 Hz"),
    _Condition("2 scans a second", "2 Hz"),
    _Condition("64 beams", "64 beams"),
    _Condition("16 beams", "16 beams"),
    _Condition("12 parked cars a pass", "parked"),
    _Condition("a map of points alone, taught", "imported", (TAUGHT,), ()),
    *(
        _Condition(f"{n} vehicles", "vehicles", (f"{COLUMNS_V1}, {n} vehicles",), (f"{_BY_CASE}, {n} vehicles",))
        for n in (3, 5, 7, 10)
    ),
    _lying(1, "liars"),
    *(_lying(k, "many liars") for k in (2, 3)),
)


def ablation(entries: Mapping[str, Sequence[Judgement]]) -> Figure | None:
    """F1 as columns_v1 grow rule by rule, strict truth: the mean over seeds, and a line down to the worst.

    ``entries``: by case, one a seed. None where fewer than two of its steps were measured.
    """
    steps = {f"{COLUMNS_V1} {LETTERS[:n]}": n for n in range(1, len(LETTERS))} | {COLUMNS_V1: len(LETTERS)}
    shown = [name for name in steps if entries.get(name)]
    if len(shown) < 2:
        return None
    figure, axes = style.new_figure(8.6, 4.2)
    axis = axes[0, 0]
    at = np.array([steps[name] for name in shown])
    for k, (measure, (colour, marker)) in enumerate(_MEASURES.items()):
        values = [np.array([_f1(entry)[k] for entry in entries[name]]) for name in shown]
        axis.plot(at, [v.mean() for v in values], color=colour, marker=marker, ms=6, lw=1.6, label=measure)
        if max(map(len, values)) > 1:
            beside = at + 0.07 * (k - 1)
            axis.vlines(beside, [v.min() for v in values], [v.mean() for v in values], color=colour, lw=1.0)
    axis.set_xticks(range(1, len(LETTERS) + 1), _rule_names(), rotation=28, ha="right")
    axis.set_ylim(0, 1)
    axis.set_ylabel("F1")
    _plain(axis)
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    return figure


def _f1(entry: Judgement) -> tuple[float, float, float]:
    scores = entry.strict
    return scores.macro_f1, scores.f1.changed_occupied, scores.f1.changed_empty


def _rule_names() -> list[str]:
    names = [rule.name.replace("_", " ") for rule in fields(Rules)]
    return [f"{'+ ' * (letter != 'A')}{name} ({letter})" for letter, name in zip(LETTERS, names, strict=True)]


def matrix_ablation(results: Results) -> Figure | None:
    """:func:`ablation` of the matrix's main experiment."""
    rounds = rounds_of(results, "main")
    return ablation({name: list(entries.values()) for name, entries in rounds.items()})


def robustness(results: Results) -> Figure | None:
    """Macro-F1 under every condition that was measured, by both truths: columns_v1, and the paper's best case beside
    them; the mean over seeds, and a line to the worst. None where there is nothing but the street as it is."""
    shown = [c for c in _CONDITIONS if _worst(results, c.experiment, c.columns, "strict")]
    if len(shown) < 2:
        return None
    figure, axes = style.new_figure(9.4, 1.5 + 0.3 * len(shown), 1, 2, sharey=True)
    for axis, truth in zip(axes[0], ("strict", "provenance"), strict=True):
        for y, condition in enumerate(reversed(shown)):
            for colour, marker, rounds in (
                (style.UNSURE, "s", condition.paper),
                (style.STANDING, "o", condition.columns),
            ):
                values = _worst(results, condition.experiment, rounds, truth)
                if values:
                    axis.hlines(y, min(values), np.mean(values), color=colour, lw=1.6)
                    axis.plot(np.mean(values), y, marker, color=colour, ms=6.5, mec=style.INK, mew=0.6)
        reference = float(np.mean(_worst(results, shown[0].experiment, shown[0].columns, truth)))
        axis.axvline(reference, color=style.FAINT, lw=0.8, ls=":")
        axis.set_xlim(min(0.4, axis.get_xlim()[0]), 1.0)
        axis.set_xlabel(f"F1, mean of the three classes, {truth} truth")
        _plain(axis)
    axes[0, 0].set_yticks(range(len(shown)), [c.told for c in reversed(shown)])
    seeds = len(_worst(results, shown[0].experiment, shown[0].columns, "strict"))
    marks = {COLUMNS_V1: (style.STANDING, "o"), f"the paper's case {_BY_CASE}": (style.UNSURE, "s")}
    handles = [
        Line2D([], [], color=colour, marker=marker, mec=style.INK, mew=0.6, label=name)
        for name, (colour, marker) in marks.items()
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False,
                  title=f"mean of {seeds} seed{'s' if seeds > 1 else ''}, a line to the worst")  # fmt: skip
    return figure


def _worst(results: Results, experiment: str, rounds: Sequence[str], figure: str) -> list[float]:
    """One a seed: the worst of the rounds that were run on it."""
    mine = rounds_of(results, experiment)
    seeds = sorted({seed for name in rounds for seed in mine.get(name, {})})
    of = FIGURES[figure].of
    return [min(of(mine[name][seed]) for name in rounds if seed in mine.get(name, {})) for seed in seeds]


def reliability_diagram(found: Mapping[CellState, Reliability]) -> Figure:
    """Predicted probability against the share that did change, a panel for each kind; below, how many cells."""
    figure, axes = style.new_figure(8.2, 4.9, 2, len(found), height_ratios=(3, 1), sharex=True, sharey="row")
    for column, (state, one) in zip(axes.T, found.items(), strict=True):
        colour, marker = (style.NEW, "D") if state == CellState.CHANGED_OCCUPIED else (style.GONE, "X")
        there = one.cells > 0
        column[0].plot([0, 1], [0, 1], color=style.FAINT, lw=0.9, ls="--")
        column[0].vlines(one.predicted[there], one.predicted[there], one.true[there], color=colour, lw=0.9)
        column[0].plot(one.predicted[there], one.true[there], marker, color=colour, ms=7)
        title = f"{style.STATE_NAMES[state]}, {int(one.cells.sum()):,} cells\n"
        column[0].set_title(f"{title}calibration error {one.calibration_error:.3f}, Brier {one.brier:.3f}", loc="left")
        width = 1.0 / len(one.cells)
        column[1].bar((np.arange(len(one.cells)) + 0.5) * width, one.cells, 0.9 * width, color=colour)
        column[1].set_xlabel("probability that is told")
        column[1].set_xlim(0, 1)
        for axis in column:
            _plain(axis)
    axes[0, 0].set_ylim(-0.03, 1.03)
    axes[0, 0].set_ylabel("share that did change")
    axes[1, 0].set_ylabel("cells")
    return figure


def _plain(axis: Any) -> None:
    axis.grid(alpha=0.25, lw=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
