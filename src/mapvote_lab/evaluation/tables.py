"""The results of one evaluation as tables, text and JSON; how a table looks on a terminal, in Markdown and in
HTML; and report.html, a page that needs nothing else (pictures inlined, no script, no request).
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mapvote_lab.evaluation.scores import (
    PAPER_F1,
    PAPER_SCORES,
    ByClass,
    CaseResult,
    EvaluationResult,
    ObjectRests,
    Scores,
    ratio,
)

PAPER = "paper"
"""Heading of a column of the paper's own figures, which is drawn faintly."""


@dataclass(frozen=True, slots=True)
class Sheet:
    """One table; the first column names the row."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]

    def to_rich(self) -> Table:
        """For the terminal."""
        table = Table(title=Text(self.title), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
        for i, heading in enumerate(self.headings):
            style = "dim" if heading == PAPER else None
            table.add_column(Text(heading), justify="right" if i else "left", style=style, overflow="fold")
        for row in self.rows:
            table.add_row(*map(Text, row))
        return table

    def to_markdown(self) -> str:
        """Lines that end with a newline."""
        lines = [self.headings, ["---"] * len(self.headings), *self.rows]
        title = f"**{self.title}**\n\n"
        return title + "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def to_html(self) -> str:
        """A table element that scrolls where it is too wide."""
        kinds = [' class="dim"' if heading == PAPER else "" for heading in self.headings]

        def line(tag: str, cells: Iterable[str]) -> str:
            row = zip(kinds, cells, strict=True)
            return "<tr>" + "".join(f"<{tag}{kind}>{escape(cell)}</{tag}>" for kind, cell in row) + "</tr>"

        body = "\n".join([line("th", self.headings), *(line("td", row) for row in self.rows)])
        return f'<div class="scroll"><table><caption>{escape(self.title)}</caption>{body}</table></div>'


_PAGE_STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; max-width: 1080px; padding: 2rem 1.5rem 4rem; background: #fff; color: #22303c;
       font: 16px/1.55 system-ui, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .4rem; }
h2 { font-size: 1.25rem; margin: 2.6rem 0 .5rem; padding-top: .6rem; border-top: 1px solid #d5dde3; }
p { margin: .5rem 0; max-width: 74ch; }
.lead { font-size: 1.08rem; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: .8rem; margin: 1.4rem 0; }
.facts div { background: #f2f5f7; border-radius: 8px; padding: .7rem .9rem; }
.facts b { display: block; font-size: 1.45rem; line-height: 1.2; }
.facts span { font-size: .84rem; color: #5b6a76; }
figure { margin: 1rem 0; }
figure img { max-width: 100%; height: auto; display: block; }
figcaption { font-size: .88rem; color: #5b6a76; margin-top: .3rem; max-width: 80ch; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .8rem 0 1.4rem; font-size: .9rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding-bottom: .35rem; white-space: nowrap; }
th { font-weight: 600; border-bottom: 1.5px solid #8795a1; }
th, td { padding: .22rem .75rem; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
tr:nth-child(even) td { background: #f7f9fa; }
td.dim, th.dim { color: #7a8894; }
pre { background: #f2f5f7; border-radius: 8px; padding: .9rem 1.1rem; overflow-x: auto; font-size: .88rem; }
"""


@dataclass(frozen=True, slots=True)
class ReportSection:
    """A heading, paragraphs of plain text, pictures with captions, tables, and lines to type."""

    heading: str
    text: Sequence[str] = ()
    pictures: Sequence[tuple[Path, str]] = ()
    tables: Sequence[Sheet] = ()
    commands: str = ""
    markup: str = ""
    """HTML that its maker has escaped."""


def page(title: str, lead: str, facts: Sequence[tuple[str, str]], sections: Sequence[ReportSection]) -> str:
    """The page. ``facts`` are (figure, what it is); every text is escaped, every picture inlined as it lies on disk."""
    cards = "".join(f"<div><b>{escape(figure)}</b><span>{escape(meaning)}</span></div>" for figure, meaning in facts)
    body = "\n".join(_section(section) for section in sections)
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{escape(title)}</title>\n'
        f"<style>{_PAGE_STYLE}</style>\n</head>\n<body>\n<h1>{escape(title)}</h1>\n"
        f'<p class="lead">{escape(lead)}</p>\n<div class="facts">{cards}</div>\n{body}\n</body>\n</html>\n'
    )


def _section(section: ReportSection) -> str:
    parts = [f"<h2>{escape(section.heading)}</h2>"]
    parts += [f"<p>{escape(text)}</p>" for text in section.text]
    parts += [section.markup] if section.markup else []
    for path, caption in section.pictures:
        raw = path.read_bytes()
        width = round(
            int.from_bytes(raw[16:20], "big") / 1.7
        )  # PNG: width in the first chunk; 1.7: sharp on fine screens
        data = base64.b64encode(raw).decode()
        parts.append(
            f'<figure><img width="{width}" alt="{escape(caption, quote=True)}" src="data:image/png;base64,{data}">'
            f"<figcaption>{escape(caption)}</figcaption></figure>"
        )
    parts += [table.to_html() for table in section.tables]
    if section.commands:
        parts.append(f"<pre>{escape(section.commands)}</pre>")
    return "\n".join(parts)


def case_name(case: str) -> str:
    """A case's heading: "case 5" for "5", else as it is called."""
    return f"case {case}" if case[:1].isdigit() else case


def _share(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _percent(value: float, digits: int = 1) -> str:
    return f"{100 * value:.{digits}f} %"


def _by_truth(entry: CaseResult) -> dict[str, Scores]:
    return {"strict": entry.strict, "provenance": entry.provenance, **entry.also}


def _class_table(title: str, scores: Mapping[str, Scores], of: Callable[[Scores], ByClass]) -> Sheet:
    """A line a case, our figure and the paper's for each class; ``of``: which figures."""
    rows = []
    headings = ("unchanged", "changed (occ.)", "changed (empty)")
    for case, ours in scores.items():
        printed = of(PAPER_SCORES[case]) if case in PAPER_SCORES else (None,) * len(headings)
        rows.append(
            [case_name(case), *(_share(value) for pair in zip(of(ours), printed, strict=True) for value in pair)]
        )
    return Sheet(title, ["", *(h for heading in headings for h in (heading, PAPER))], rows)


def tables(result: EvaluationResult) -> Iterator[Sheet]:
    """Tables II, III and IV with the paper's figures beside ours, then the truths, the readings of the paper if asked
    for, the map, the poses and the yardsticks' cost."""
    for truth in ("strict", "provenance"):
        scores = {case: _by_truth(entry)[truth] for case, entry in result.cases.items()}
        yield _class_table(f"Table II: precision ({truth} truth)", scores, lambda s: s.precision)
        yield _class_table(f"Table III: recall ({truth} truth)", scores, lambda s: s.recall)
    yield _f1_table(result)
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
                _share(PAPER_F1.get(case)),
                _share(entry.strict.kim_f1),
                _share(entry.coverage),
                f"{sum(sent) / len(sent) / 1000:.1f}" if sent else "",
            ]
        )
    perfect = [_share(scores.macro_f1) for scores in result.ceilings.values()]
    rows.append(["perfect labels", *perfect, "", "", "", ""])
    headings = ["", *result.ceilings, PAPER, "Kim's F1, strict", "coverage", "kB a ballot"]
    return Sheet("Table IV: F1, mean of the three classes; coverage; upload", headings, rows)


def readings_table(readings: Mapping[str, Mapping[str, Mapping[str, Scores]]], truth: str, occluded: str) -> Sheet:
    """A line a reading, macro-F1 by case against one truth; the paper's Table IV last. ``occluded``: as it is set."""
    cases = list(next(iter(readings.values())))
    rows = []
    for name, by_case in readings.items():
        shown = f"as set: occluded {occluded}" if name == "as set" else name
        rows.append([shown, *(f"{by_case[case][truth].macro_f1:.3f}" for case in cases)])
    rows.append(["paper, Table IV", *(f"{PAPER_F1[case]:.3f}" for case in cases)])
    title = f"Readings of the paper: F1, mean of the three classes ({truth} truth)"
    return Sheet(title, ["reading", *(f"case {case}" for case in cases)], rows)


def _map_table(result: EvaluationResult) -> Iterator[Sheet]:
    rows = []
    for case, entry in result.cases.items():
        if entry.map is not None:
            scores = entry.map
            objects = entry.objects
            false = entry.objects.false_m2
            rows.append(
                [
                    case_name(case),
                    _percent(scores.stale_deleted, 2),
                    _percent(scores.valid_deleted, 3),
                    _percent(scores.new_added, 2),
                    _percent(scores.added_false, 2),
                    _percent(scores.added_false_scored, 2),
                    f"{sum(objects.found)} of {len(objects.found)}",
                    f"{len(false)}, largest {false[0]:.1f} m²" if false else "none",
                    *_rests(entry.rests),
                ]
            )
    headings = [
        "", "stale deleted", "valid deleted", "new surface added", "added on no surface", "in scored cells",
        "objects found", "false objects", "visible rests", "most left", "least added",
    ]  # fmt: skip
    if rows:
        yield Sheet("The updated map", headings, rows)


def _rests(rests: ObjectRests | None) -> list[str]:
    """Demolished objects with a visible rest, the largest share left of one, the smallest share added of a new one."""
    if rests is None:
        return ["", "", ""]
    most = _percent(max(rests.left)) if rests.left else ""
    return [f"{rests.visible} of {len(rests.left)}", most, _percent(min(rests.added)) if rests.added else ""]


def _localisation_tables(result: EvaluationResult) -> Iterator[Sheet]:
    of_title = {
        "Localisation against the true poses, in the map's frame": result.localisation,
        "Purpose of the map: one vehicle's scans within 30 m of a change": result.changed_areas,
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
