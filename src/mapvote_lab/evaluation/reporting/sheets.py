"""A table, and how it looks on a terminal, in Markdown and in HTML."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

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
