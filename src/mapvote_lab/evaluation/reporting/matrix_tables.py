"""Mean, spread and worst over seeds."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from mapvote_lab.evaluation.reporting.sheets import Sheet
from mapvote_lab.evaluation.results import MatrixResult, RoundResult
from mapvote_lab.evaluation.scoring.cells import CLASSES
from mapvote_lab.evaluation.scoring.map_points import MapScores

Results = Mapping[str, Mapping[int, MatrixResult]]
"""By experiment and seed: what :meth:`mapvote_lab.evaluation.experiments.matrix.Matrix.run` gave."""
FALSE_OBJECT_M2 = 2.0


@dataclass(frozen=True, slots=True)
class Spread:
    """A figure over seeds."""

    mean: float
    deviation: float
    """Sample standard deviation; 0 of a single seed."""
    worst: float
    seeds: int


@dataclass(frozen=True, slots=True)
class Figure:
    """One number of an entry."""

    title: str
    of: Callable[[RoundResult], float]
    more_is_better: bool = True
    percent: bool = False

    def text(self, s: Spread) -> str:
        """ "mean ± deviation (worst)"."""
        scale, digits = (100.0, 2) if self.percent else (1.0, 3)
        return " ± ".join(f"{scale * x:.{digits}f}" for x in (s.mean, s.deviation)) + f" ({scale * s.worst:.{digits}f})"


def _share(of: Sequence[bool]) -> float:
    return sum(of) / len(of) if of else 1.0


def _false_objects(entry: RoundResult) -> float:
    return float(sum(area > FALSE_OBJECT_M2 for area in entry.objects.false_m2))


def _points(entry: RoundResult) -> MapScores:
    if entry.map is None:
        raise ValueError("every round of the matrix edits a map")
    return entry.map


FIGURES: Mapping[str, Figure] = {
    "strict": Figure("macro strict", lambda e: e.strict.macro_f1),
    "provenance": Figure("macro prov.", lambda e: e.provenance.macro_f1),
    "border": Figure("macro border", lambda e: e.also["border"].macro_f1),
    "border_provenance": Figure("macro border, prov.", lambda e: e.also["border, provenance"].macro_f1),
    "occupied": Figure("F1 ch.-occ. strict", lambda e: e.strict.f1.changed_occupied),
    "empty": Figure("F1 ch.-empty strict", lambda e: e.strict.f1.changed_empty),
    "border_occupied": Figure("F1 ch.-occ. border", lambda e: e.also["border"].f1.changed_occupied),
    "border_empty": Figure("F1 ch.-empty border", lambda e: e.also["border"].f1.changed_empty),
    "strict_old": Figure("macro strict, old surfaces unchanged", lambda e: e.strict_old_unchanged.macro_f1),
    "stale": Figure("stale deleted", lambda e: _points(e).stale_deleted, percent=True),
    "stale_apart": Figure("stale, .6 m off what stands", lambda e: _points(e).stale_apart_deleted, percent=True),
    "valid": Figure("valid deleted", lambda e: _points(e).valid_deleted, more_is_better=False, percent=True),
    "new": Figure("new added", lambda e: _points(e).new_added, percent=True),
    "false": Figure("added on no surface", lambda e: _points(e).added_false, more_is_better=False, percent=True),
    "coverage": Figure("determined by a vehicle", lambda e: e.coverage, percent=True),
    "met": Figure("objects found", lambda e: _share(e.objects.met), percent=True),
    "found": Figure("half of them found", lambda e: _share(e.objects.found), percent=True),
    "false_objects": Figure("false objects > 2 m2", _false_objects, more_is_better=False),
}


def spread(values: Sequence[float], more_is_better: bool = True) -> Spread:
    """``values``: one a seed, at least one."""
    deviation = statistics.stdev(values) if len(values) > 1 else 0.0
    return Spread(statistics.fmean(values), deviation, min(values) if more_is_better else max(values), len(values))


def rounds_of(results: Results, experiment: str) -> dict[str, dict[int, RoundResult]]:
    """By round and seed: the entries of one experiment."""
    out: dict[str, dict[int, RoundResult]] = {}
    for seed, result in results.get(experiment, {}).items():
        for name, entry in result.rounds.items():
            out.setdefault(name, {})[seed] = entry
    return out


def _over_seeds(figure: Figure, entries: Mapping[int, RoundResult]) -> str:
    return figure.text(spread([figure.of(entry) for entry in entries.values()], figure.more_is_better))


def table(results: Results, experiment: str) -> Sheet:
    """A line for each round, "mean ± deviation (worst)" for each figure."""
    headings = ["", *(f.title + ", %" * f.percent for f in FIGURES.values())]
    found = rounds_of(results, experiment)
    rows = [[name, *(_over_seeds(f, entries) for f in FIGURES.values())] for name, entries in found.items()]
    return Sheet(f"{experiment} (seeds {', '.join(map(str, results.get(experiment, {})))})", headings, rows)


def ceiling_table(results: Results, experiment: str) -> Sheet:
    """What perfect labels would score, seed by seed: macro-F1, then changed-occupied / changed-empty."""
    found = results.get(experiment, {})
    names = list(next(iter(found.values())).ceilings) if found else []
    rows = []
    for seed, result in found.items():
        scores = [result.ceilings[name] for name in names]
        shown = [f"{s.macro_f1:.3f} ({s.f1.changed_occupied:.3f} / {s.f1.changed_empty:.3f})" for s in scores]
        rows.append([str(seed), *shown])
    return Sheet(f"{experiment}, what perfect labels would score", ["seed", *names], rows)


def class_table(results: Results, experiment: str) -> Sheet:
    """Precision / recall of the paper's three classes (Tables II and III), means over the seeds, strict truth."""
    rows = []
    for name, entries in rounds_of(results, experiment).items():
        row = [name]
        for label in CLASSES:
            p = statistics.fmean(getattr(entry.strict.precision, label) for entry in entries.values())
            r = statistics.fmean(getattr(entry.strict.recall, label) for entry in entries.values())
            row.append(f"{p:.4f} / {r:.4f}" if label == CLASSES[0] else f"{p:.3f} / {r:.3f}")
        rows.append(row)
    headings = ["", *(f"{name.replace('_', '-')} P / R" for name in CLASSES)]
    return Sheet(f"{experiment}, class by class", headings, rows)
