"""The results of one evaluation as tables, text, JSON and CSV. Everything is taken from the one result."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from pathlib import Path

from msgspec.structs import asdict
from rich.console import Console

from mapvote.formats.atomic import whole_file
from mapvote_lab.evaluation.reporting.sheets import Sheet
from mapvote_lab.evaluation.results import CaseResult, EvaluationResult, to_json
from mapvote_lab.evaluation.scoring import paper_tables
from mapvote_lab.evaluation.scoring.cells import CLASSES, ByClass, Scores, ratio
from mapvote_lab.evaluation.scoring.truths import BANDS

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


def _class_table(title: str, ours: Mapping[str, ByClass], printed: Mapping[str, tuple[float, ...]]) -> Sheet:
    """A line a case, our figure and the paper's for each class."""
    rows = []
    for case, values in ours.items():
        pairs = zip(values, printed.get(case, (None,) * len(CLASSES)), strict=True)
        rows.append([case_name(case), *(_share(value) for pair in pairs for value in pair)])
    return Sheet(title, ["", *(h for name in CLASSES for h in (HEADINGS[name], "paper"))], rows, faint="paper")


def tables(result: EvaluationResult) -> Iterator[Sheet]:
    """Tables II, III and IV with the paper's figures beside ours, then the truths, the readings of the paper if asked
    for, the map, the poses and the yardsticks' cost."""
    for truth in ("strict", "provenance"):
        scores = {case: _by_truth(entry)[truth] for case, entry in result.cases.items()}
        precision, recall = ({c: s.precision for c, s in scores.items()}, {c: s.recall for c, s in scores.items()})
        yield _class_table(f"Table II: precision ({truth} truth)", precision, paper_tables.PRECISION)
        yield _class_table(f"Table III: recall ({truth} truth)", recall, paper_tables.RECALL)
    yield _f1_table(result)
    yield _truth_sizes(result)
    if result.readings:
        for truth in next(iter(next(iter(result.readings.values())).values())):
            yield readings_table(result.readings, truth, result.settings["paper"]["occluded"])
    yield from _map_table(result)
    yield from _localisation_tables(result)
    yield from _cost_table(result)


def _f1_table(result: EvaluationResult) -> Sheet:
    rows = []
    for case, entry in result.cases.items():
        sent = entry.bytes_per_vehicle
        rows.append(
            [
                case_name(case),
                *(_share(_by_truth(entry)[truth].macro_f1) for truth in result.ceilings),
                _share(paper_tables.F1.get(case)),
                _share(entry.strict.kim_f1),
                _share(entry.coverage),
                f"{sum(sent) / len(sent) / 1000:.1f}" if sent else "",
            ]
        )
    perfect = [_share(scores.macro_f1) for scores in result.ceilings.values()]
    rows.append(["perfect labels", *perfect, "", "", "", ""])
    headings = ["", *result.ceilings, "paper", "Kim's F1, strict", "coverage", "kB a ballot"]
    return Sheet("Table IV: F1, mean of the three classes; coverage; upload", headings, rows, faint="paper")


def _truth_sizes(result: EvaluationResult) -> Sheet:
    rows = []
    for truth, by_class in result.truth_sizes.items():
        for name, bands in by_class.items():
            counts = [sum(bands.values()), *(bands[band] for band in BANDS)]
            rows.append([f"{truth}, {name.replace('_', ' ')}", *(f"{n:,}" for n in counts)])
    return Sheet("The truths: changed cells by the height of their lowest surface", ["", "all", *BANDS], rows)


def readings_table(readings: Mapping[str, Mapping[str, Mapping[str, Scores]]], truth: str, occluded: str) -> Sheet:
    """A line a reading, macro-F1 by case against one truth; the paper's Table IV last. ``occluded``: as it is set."""
    cases = list(next(iter(readings.values())))
    rows = []
    for name, by_case in readings.items():
        shown = f"as set: occluded {occluded}" if name == "as set" else name
        rows.append([shown, *(f"{by_case[case][truth].macro_f1:.3f}" for case in cases)])
    rows.append(["paper, Table IV", *(f"{paper_tables.F1[case]:.3f}" for case in cases)])
    title = f"Readings of the paper: F1, mean of the three classes ({truth} truth)"
    return Sheet(title, ["reading", *(f"case {case}" for case in cases)], rows)


def _map_table(result: EvaluationResult) -> Iterator[Sheet]:
    rows = []
    for case, entry in result.cases.items():
        if entry.map is not None:
            scores, objects, false = entry.map, entry.objects, entry.objects.false_m2
            rows.append(
                [
                    case_name(case),
                    _percent(scores.stale_deleted, 2),
                    _percent(scores.valid_deleted, 3),
                    _percent(scores.new_added, 2),
                    _percent(scores.added_false, 2),
                    f"{sum(objects.found)} of {len(objects.found)}",
                    f"{len(false)}, largest {false[0]:.1f} m²" if false else "none",
                ]
            )
    headings = [
        "", "stale deleted", "valid deleted", "new surface added", "added on no surface", "objects found",
        "false objects",
    ]  # fmt: skip
    if rows:
        yield Sheet("The updated map", headings, rows)


def _localisation_tables(result: EvaluationResult) -> Iterator[Sheet]:
    of_title = {
        "Localisation against the true poses, in the map's frame": result.localisation,
        "What the map is for: one vehicle's scans within 30 m of a change": result.changed_areas,
    }
    headings = ["", "scans", "localised", "median", "99 %", "largest", "median angle"]
    for title, errors in of_title.items():
        rows = [
            [
                name,
                str(entry.scans),
                _percent(ratio(entry.localised, entry.scans)),
                *(f"{100 * metres:.1f} cm" for metres in (entry.median_m, entry.p99_m, entry.max_m)),
                f"{entry.median_deg:.3f}°",
            ]
            for name, entry in errors.items()
        ]
        if rows:
            yield Sheet(title, headings, rows)


def _cost_table(result: EvaluationResult) -> Iterator[Sheet]:
    rows = [
        [name, str(entry.beams), f"{entry.ms_per_scan:.1f}", f"{entry.memory_bytes / 1e6:.1f} MB"]
        for name, entry in result.timings.methods.items()
    ]
    if rows:
        yield Sheet("Cost on the vehicle", ["", "beams", "ms a scan, median", "memory of its grid"], rows)


def as_text(result: EvaluationResult) -> str:
    """All tables, plain, 140 columns."""
    out = io.StringIO()
    console = Console(file=out, width=140, color_system=None, highlight=False)
    for sheet in tables(result):
        console.print(sheet.to_rich())
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines()) + "\n"


def result_json(result: EvaluationResult) -> str:
    """The result with sorted keys; ValueError if a number is NaN or infinite."""
    return to_json(result, sort_keys=True)


def result_csv(result: EvaluationResult) -> str:
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
