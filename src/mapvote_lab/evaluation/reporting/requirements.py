"""What must hold on unseen seeds, asked of the matrix's results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mapvote_lab.evaluation.experiments.attacks import ATTACKS
from mapvote_lab.evaluation.experiments.cases import COLUMNS_V1
from mapvote_lab.evaluation.experiments.imported_map import TAUGHT
from mapvote_lab.evaluation.reporting.matrix_tables import FIGURES, Results, rounds_of, spread


@dataclass(frozen=True, slots=True)
class Demand:
    """Bounds on a figure of some rounds, the worst of them; or on what it gains or loses against other rounds."""

    what: str
    experiment: str
    rounds: Sequence[str]
    figure: str
    mean: float
    """The mean over seeds must be no worse."""
    aim: float
    worst: float | None = None
    """No seed may be worse."""
    against: tuple[str, Sequence[str]] | None = None
    """(experiment, rounds) on the same seed, the best of them: the demand is on the difference."""

    def values(self, results: Results) -> list[float]:
        """One a seed that has been run."""
        figure = FIGURES[self.figure]
        worst, best = (min, max) if figure.more_is_better else (max, min)
        mine = rounds_of(results, self.experiment)
        base = rounds_of(results, self.against[0]) if self.against else {}
        out = []
        for seed in sorted({seed for name in self.rounds for seed in mine.get(name, {})}):
            value = worst(figure.of(mine[name][seed]) for name in self.rounds if seed in mine.get(name, {}))
            if self.against:
                there = [figure.of(base[name][seed]) for name in self.against[1] if seed in base.get(name, {})]
                if not there:
                    continue
                value -= best(there)
            out.append(value)
        return out

    def row(self, results: Results) -> str | None:
        """A line of Markdown with the verdict; None if nothing has been run."""
        values = self.values(results)
        if not values:
            return None
        more = FIGURES[self.figure].more_is_better
        s = spread(values, more)

        def holds(value: float, bound: float | None) -> bool:
            return bound is None or (value >= bound if more else value <= bound)

        met = holds(s.mean, self.mean) and holds(s.worst, self.worst)
        verdict = "aim" if holds(s.mean, self.aim) and met else "yes" if met else "NO"
        bound = f"{self.mean:g}" + ("" if self.worst is None else f"; {self.worst:g}")
        measured = f"{s.mean:.4f} ± {s.deviation:.4f}; {s.worst:.4f}"
        return f"| {self.what} | {bound} | {self.aim:g} | {measured} | {s.seeds} | {verdict} |"


_CASE_1 = ("1", "1 farthest_return", "1 column")
_COLUMNS = (COLUMNS_V1,)


def _loss(what: str, experiment: str, figure: str, must: float, aim: float, rounds: Sequence[str] = _COLUMNS) -> Demand:
    return Demand(what, experiment, rounds, figure, -must, -aim, against=("main", _COLUMNS))


def _liars(experiment: str, k: int) -> list[Demand]:
    n = 2 * k + 1
    rounds = [f"{COLUMNS_V1}, {k} of {n} {name}" for name in ATTACKS]
    honest = (experiment, (f"{COLUMNS_V1}, {n} honest",))
    what = f"{k} of {n} lie, the worst lie: macro"
    return [
        Demand(f"{what} {figure}", experiment, rounds, figure, -0.04, -0.01, against=honest)
        for figure in ("strict", "provenance")
    ]


def _more_vehicles(few: int, many: int) -> Demand:
    what, rounds = f"{many} vehicles against {few}: macro strict", (f"{COLUMNS_V1}, {many} vehicles",)
    return Demand(
        what, "vehicles", rounds, "strict", -0.02, 0.0, -0.02, ("vehicles", (f"{COLUMNS_V1}, {few} vehicles",))
    )


DEMANDS: Sequence[Demand] = (
    Demand("macro-F1 strict", "main", _COLUMNS, "strict", 0.94, 0.96, 0.92),
    Demand("macro-F1 provenance", "main", _COLUMNS, "provenance", 0.955, 0.975, 0.94),
    Demand("F1 changed-empty strict", "main", _COLUMNS, "empty", 0.93, 0.96, 0.91),
    Demand("F1 changed-occupied strict", "main", _COLUMNS, "occupied", 0.895, 0.925, 0.86),
    Demand("macro-F1 border", "main", _COLUMNS, "border", 0.968, 0.98, 0.955),
    Demand("macro-F1 border, provenance", "main", _COLUMNS, "border_provenance", 0.98, 0.99, 0.97),
    Demand("F1 changed-empty border", "main", _COLUMNS, "border_empty", 0.965, 0.985),
    Demand("F1 changed-occupied border", "main", _COLUMNS, "border_occupied", 0.94, 0.965),
    Demand("over the best case 1, macro strict", "main", _COLUMNS, "strict", 0.10, 0.20, against=("main", _CASE_1)),
    Demand("stale points deleted", "main", _COLUMNS, "stale", 0.99, 0.997, 0.98),
    Demand("valid points wrongly deleted", "main", _COLUMNS, "valid", 0.00005, 0.00001),
    Demand("new points added", "main", _COLUMNS, "new", 0.965, 0.99, 0.95),
    Demand("determined, over case 1 column", "main", _COLUMNS, "coverage", -0.02, 0.0, against=("main", ("1 column",))),
    _loss("pose noise: macro provenance", "noise", "provenance", 0.02, 0.01),
    _loss("pose noise: F1 changed-empty", "noise", "empty", 0.03, 0.01),
    _loss("pose noise, told: macro provenance", "noise told", "provenance", 0.06, 0.02),
    _loss("pose noise, told: F1 changed-empty", "noise told", "empty", 0.03, 0.01),
    _loss("imported map, taught: macro strict", "imported", "strict", 0.01, 0.0, (TAUGHT,)),
    _loss("imported map, taught: macro provenance", "imported", "provenance", 0.01, 0.0, (TAUGHT,)),
    *_liars("liars", 1),
    *_liars("many liars", 1),
    *_liars("many liars", 2),
    *_liars("many liars", 3),
    _loss("12 parked cars a pass: macro strict", "parked", "strict", 0.04, 0.01),
    _loss("12 parked cars a pass: macro provenance", "parked", "provenance", 0.04, 0.01),
    Demand(
        "12 parked cars: above one-stage, macro strict", "parked", _COLUMNS, "strict", 0.0, 0.0,
        against=("parked", (f"{COLUMNS_V1} one-stage",)),
    ),
    Demand("2 Hz: macro strict", "2 Hz", _COLUMNS, "strict", 0.88, 0.93),
    Demand("16 beams: macro strict", "16 beams", _COLUMNS, "strict", 0.92, 0.93),
    Demand("64 beams: macro strict", "64 beams", _COLUMNS, "strict", 0.92, 0.93),
    _more_vehicles(3, 5),
    _more_vehicles(5, 7),
    _more_vehicles(7, 10),
    Demand("objects found (a connected change of 1 m2)", "main", _COLUMNS, "met", 1.0, 1.0, 1.0),
    Demand("objects found by half of their cells", "main", _COLUMNS, "found", 1.0, 1.0, 1.0),
    Demand("false objects above 2 m2", "main", _COLUMNS, "false_objects", 0.0, 0.0, 0.0),
)  # fmt: skip


def table(results: Results) -> str:
    """Markdown: every demand that has been asked, with what was measured and whether it holds."""
    rows = [row for row in (demand.row(results) for demand in DEMANDS) if row]
    head = "| what | must (mean; worst) | aim | measured (mean ± deviation; worst) | seeds | holds |"
    return "\n".join([head, "|---|---|---|---|---|---|", *rows]) + "\n"
