"""The results of one evaluation as tables, text, JSON and CSV. Everything is taken from the one result."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from pathlib import Path

from msgspec.structs import asdict
from rich import box
from rich.console import Console
from rich.table import Table

from mapvote.formats.atomic import whole_file
from mapvote_lab.evaluation.reporting.study_tables import study_tables
from mapvote_lab.evaluation.results import CaseResult, EvaluationResult, to_json
from mapvote_lab.evaluation.scoring import paper_tables
from mapvote_lab.evaluation.scoring.cells import CLASSES, ByClass, Scores, ratio

HEADINGS = {"unchanged": "unchanged", "changed_occupied": "changed (occ.)", "changed_empty": "changed (empty)"}


def case_name(case: str) -> str:
    """A case's heading: "case 5" for "5", else as it is called."""
    return f"case {case}" if case[:1].isdigit() else case


def _share(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _percent(value: float, digits: int = 1) -> str:
    return f"{100 * value:.{digits}f} %"


def _by_truth(entry: CaseResult) -> dict[str, Scores]:
    return {"strict": entry.strict, "provenance": entry.provenance, **entry.also}


def _class_table(title: str, ours: Mapping[str, ByClass], printed: Mapping[str, tuple[float, ...]]) -> Table:
    """A line a case, our figure and the paper's for each class."""
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    table.add_column("")
    for name in CLASSES:
        table.add_column(HEADINGS[name], justify="right")
        table.add_column("paper", justify="right", style="dim")
    for case, values in ours.items():
        cells = [case_name(case)]
        for k, value in enumerate(values):
            cells += [_share(value), _share(printed[case][k] if case in printed else None)]
        table.add_row(*cells)
    return table


def tables(result: EvaluationResult) -> Iterator[Table]:
    """Tables II, III and IV with the paper's figures beside ours, then the map, the poses and the yardsticks' cost."""
    for truth in ("strict", "provenance"):
        scores = {case: _by_truth(entry)[truth] for case, entry in result.cases.items()}
        precision, recall = ({c: s.precision for c, s in scores.items()}, {c: s.recall for c, s in scores.items()})
        yield _class_table(f"Table II: precision ({truth} truth)", precision, paper_tables.PRECISION)
        yield _class_table(f"Table III: recall ({truth} truth)", recall, paper_tables.RECALL)
    f1 = Table(
        title="Table IV: F1, mean of the three classes; coverage; upload", box=box.SIMPLE_HEAD,
        title_justify="left", title_style="bold",
    )  # fmt: skip
    also = list(result.ceilings)[2:]
    for heading in ("", "strict", "provenance", *also, "paper", "Kim's F1, strict", "coverage", "kB a ballot"):
        f1.add_column(heading, justify="right" if heading else "left", style="dim" if heading == "paper" else "")
    for case, entry in result.cases.items():
        sent = entry.bytes_per_vehicle
        f1.add_row(
            case_name(case),
            *(_share(scores.macro_f1) for scores in _by_truth(entry).values()),
            _share(paper_tables.F1.get(case)),
            _share(entry.strict.kim_f1),
            _share(entry.coverage),
            f"{sum(sent) / len(sent) / 1000:.1f}" if sent else "",
        )
    f1.add_row("perfect labels", *(_share(scores.macro_f1) for scores in result.ceilings.values()), style="dim")
    yield f1
    yield from study_tables(result)
    yield from _map_table(result)
    yield from _localisation_tables(result)
    yield from _cost_table(result)


def _map_table(result: EvaluationResult) -> Iterator[Table]:
    rows = {case: (entry.map, entry.objects) for case, entry in result.cases.items() if entry.map is not None}
    if not rows:
        return
    table = Table(title="The updated map", box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    for heading in ("", "stale deleted", "valid deleted", "new surface added", "added on no surface", "objects found",
                    "false objects"):  # fmt: skip
        table.add_column(heading, justify="right" if heading else "left")
    for case, (scores, objects) in rows.items():
        false = objects.false_m2
        table.add_row(
            case_name(case),
            _percent(scores.stale_deleted, 2),
            _percent(scores.valid_deleted, 3),
            _percent(scores.new_added, 2),
            _percent(scores.added_false, 2),
            f"{sum(objects.found)} of {len(objects.found)}",
            f"{len(false)}, largest {false[0]:.1f} m²" if false else "none",
        )
    yield table


def _localisation_tables(result: EvaluationResult) -> Iterator[Table]:
    of_title = {
        "Localisation against the true poses, in the map's frame": result.localisation,
        "What the map is for: one vehicle's scans within 30 m of a change": result.changed_areas,
    }
    for title, errors in of_title.items():
        if not errors:
            continue
        table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
        for heading in ("", "scans", "localised", "median", "99 %", "largest", "median angle"):
            table.add_column(heading, justify="right" if heading else "left")
        for name, entry in errors.items():
            table.add_row(
                name,
                str(entry.scans),
                _percent(ratio(entry.localised, entry.scans)),
                f"{100 * entry.median_m:.1f} cm",
                f"{100 * entry.p99_m:.1f} cm",
                f"{100 * entry.max_m:.1f} cm",
                f"{entry.median_deg:.3f}°",
            )
        yield table


def _cost_table(result: EvaluationResult) -> Iterator[Table]:
    costs = result.timings.methods
    if not costs:
        return
    table = Table(title="Cost on the vehicle", box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    for heading in ("", "beams", "ms a scan, median", "memory of its grid"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, entry in costs.items():
        table.add_row(name, str(entry.beams), f"{entry.ms_per_scan:.1f}", f"{entry.memory_bytes / 1e6:.1f} MB")
    yield table


def as_text(result: EvaluationResult) -> str:
    """All tables, plain, 140 columns."""
    out = io.StringIO()
    console = Console(file=out, width=140, color_system=None, highlight=False)
    for table in tables(result):
        console.print(table)
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines()) + "\n"


def as_json(result: EvaluationResult) -> str:
    """The result with sorted keys; ValueError if a number is NaN or infinite."""
    return to_json(result, sort_keys=True)


def as_csv(result: EvaluationResult) -> str:
    """One line a number: case, truth, metric, class, value."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["case", "truth", "metric", "class", "value"])
    for case, entry in result.cases.items():
        for truth, scores in _by_truth(entry).items():
            for metric, values in (("precision", scores.precision), ("recall", scores.recall), ("f1", scores.f1)):
                for name, value in zip(CLASSES, values, strict=True):
                    writer.writerow([case, truth, metric, name, f"{value:.6f}"])
            for metric, value in (("macro_f1", scores.macro_f1), ("kim_f1", scores.kim_f1)):
                writer.writerow([case, truth, metric, "", f"{value:.6f}"])
        writer.writerow([case, "", "coverage", "", f"{entry.coverage:.6f}"])
        for size in entry.bytes_per_vehicle:
            writer.writerow([case, "", "bytes", "", size])
        for metric, value in asdict(entry.map).items() if entry.map else ():
            writer.writerow([case, "", metric, "", value])
    return out.getvalue()


def write_text(text: str, path: Path) -> None:
    """Whole or not at all."""
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")
