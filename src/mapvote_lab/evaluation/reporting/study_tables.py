"""What the paper's tables rest on, as tables: readings by case, and truths by height."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from rich import box
from rich.table import Table

from mapvote_lab.evaluation.results import EvaluationResult
from mapvote_lab.evaluation.scoring import paper_tables
from mapvote_lab.evaluation.scoring.cells import Scores
from mapvote_lab.evaluation.scoring.truths import BANDS


def _new(title: str, *headings: str) -> Table:
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    for heading in headings:
        table.add_column(heading, justify="right" if table.columns else "left")
    return table


def study_tables(result: EvaluationResult) -> Iterator[Table]:
    """Those of what was asked: nothing but the sizes of the truths, unless readings were."""
    yield _sizes(result)
    if result.readings:
        truths = list(next(iter(next(iter(result.readings.values())).values())))
        for truth in truths:
            yield readings_table(result.readings, truth, result.settings["paper"]["occluded"])


def _sizes(result: EvaluationResult) -> Table:
    table = _new("The truths: changed cells by the height of their lowest surface", "", "", "all", *BANDS)
    for truth, by_class in result.truth_sizes.items():
        for name, bands in by_class.items():
            cells = [f"{bands[band]:,}" for band in BANDS]
            table.add_row(truth, name.replace("_", " "), f"{sum(bands.values()):,}", *cells)
    return table


def readings_table(readings: Mapping[str, Mapping[str, Mapping[str, Scores]]], truth: str, occluded: str) -> Table:
    """A line a reading, macro-F1 by case against one truth; the paper's Table IV last. ``occluded``: as it is set."""
    cases = list(next(iter(readings.values())))
    table = _new(f"Readings of the paper: F1, mean of the three classes ({truth} truth)", "reading", *map(_case, cases))
    for name, by_case in readings.items():
        shown = f"as set: occluded {occluded}" if name == "as set" else name
        table.add_row(shown, *(f"{by_case[case][truth].macro_f1:.3f}" for case in cases))
    table.add_row("paper, Table IV", *(f"{paper_tables.F1[case]:.3f}" for case in cases), style="dim")
    return table


def _case(name: str) -> str:
    return f"case {name}"
