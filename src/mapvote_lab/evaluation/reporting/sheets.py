"""A table, and how it looks on a terminal, in Markdown and in HTML; and report.html, a page that needs nothing else
(pictures inlined, no script, no request).
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from rich import box
from rich.table import Table
from rich.text import Text


@dataclass(frozen=True, slots=True)
class Sheet:
    """One table; the first column names the row."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    faint: str = ""
    """Columns with this heading hold figures of others, such as the paper's, and are drawn faintly."""

    def to_rich(self) -> Table:
        """For the terminal."""
        table = Table(title=Text(self.title), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
        for i, heading in enumerate(self.headings):
            style = "dim" if self.faint and heading == self.faint else None
            table.add_column(Text(heading), justify="right" if i else "left", style=style, overflow="fold")
        for row in self.rows:
            table.add_row(*map(Text, row))
        return table

    def to_markdown(self, with_title: bool = True) -> str:
        """Lines that end with a newline."""
        lines = [self.headings, ["---"] * len(self.headings), *self.rows]
        title = f"**{self.title}**\n\n" if with_title else ""
        return title + "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def to_html(self) -> str:
        """A table element that scrolls where it is too wide."""
        kinds = [' class="dim"' if self.faint and heading == self.faint else "" for heading in self.headings]

        def line(tag: str, cells: Iterable[str]) -> str:
            row = zip(kinds, cells, strict=True)
            return "<tr>" + "".join(f"<{tag}{kind}>{escape(cell)}</{tag}>" for kind, cell in row) + "</tr>"

        body = "\n".join([line("th", self.headings), *(line("td", row) for row in self.rows)])
        return f'<div class="scroll"><table><caption>{escape(self.title)}</caption>{body}</table></div>'


_STYLE = """
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

_PIXELS = 1.7
"""Of a picture to one of the page: sharp on fine screens."""


@dataclass(frozen=True, slots=True)
class ReportSection:
    """A heading, paragraphs of plain text, pictures with captions, tables, and lines to type."""

    heading: str
    text: Sequence[str] = ()
    pictures: Sequence[tuple[Path, str]] = ()
    tables: Sequence[Sheet] = ()
    commands: str = ""
    markup: str = ""
    """HTML as it is, from those who made it safe."""


def page(title: str, lead: str, facts: Sequence[tuple[str, str]], sections: Sequence[ReportSection]) -> str:
    """The page. ``facts`` are (figure, what it is); every text is escaped, every picture inlined as it lies on disk."""
    cards = "".join(f"<div><b>{escape(figure)}</b><span>{escape(what)}</span></div>" for figure, what in facts)
    body = "\n".join(_section(section) for section in sections)
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{escape(title)}</title>\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n<h1>{escape(title)}</h1>\n"
        f'<p class="lead">{escape(lead)}</p>\n<div class="facts">{cards}</div>\n{body}\n</body>\n</html>\n'
    )


def _section(section: ReportSection) -> str:
    parts = [f"<h2>{escape(section.heading)}</h2>"]
    parts += [f"<p>{escape(text)}</p>" for text in section.text]
    parts += [section.markup] if section.markup else []
    for path, caption in section.pictures:
        raw = path.read_bytes()
        width = round(int.from_bytes(raw[16:20], "big") / _PIXELS)  # PNG: the width stands in its first chunk
        data = base64.b64encode(raw).decode()
        parts.append(
            f'<figure><img width="{width}" alt="{escape(caption, quote=True)}" src="data:image/png;base64,{data}">'
            f"<figcaption>{escape(caption)}</figcaption></figure>"
        )
    parts += [table.to_html() for table in section.tables]
    if section.commands:
        parts.append(f"<pre>{escape(section.commands)}</pre>")
    return "\n".join(parts)
