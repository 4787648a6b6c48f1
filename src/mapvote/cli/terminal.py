"""Output that all verbs share: errors of one line, tables, and progress.

Whatever comes from users and files is shown as it is: rich takes square brackets in plain strings for its markup.
Progress goes to stderr, so that stdout can be piped.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import TaskID
    from rich.text import Text


def complain(message: str) -> None:
    """One line on stderr; the words of the message unchanged."""
    from rich.console import Console
    from rich.text import Text

    line = Text.assemble(("mapvote:", "bold red"), " ", message)
    Console(stderr=True, soft_wrap=True).print(line, highlight=False)


def print_table(headings: Sequence[str], rows: Iterable[Iterable[str | Text] | None], title: str | None = None) -> None:
    """A table of plain text on stdout, without a head if no heading says anything; None is a line between rows.

    In a terminal, text that does not fit is folded, never cut. In a pipe or a file each row is one line, however wide.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    head = any(headings)
    table = Table(title=None if title is None else Text(title), title_justify="left", show_header=head)
    for heading in headings:
        table.add_column(Text(heading), overflow="fold")
    for row in rows:
        if row is None:
            table.add_section()
        else:
            table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    console = Console()
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = 10_000
        console.width = console.measure(table).maximum
    console.print(table)


@contextmanager
def waiting(task: str) -> Iterator[None]:
    """A turning wheel beside the name of a ``task`` that cannot say how far it is; nothing without a terminal."""
    if not sys.stderr.isatty():  # rich is not even imported
        yield
        return
    from rich.console import Console
    from rich.markup import escape

    console = Console(stderr=True)
    if not console.is_terminal:
        yield
        return
    with console.status(escape(task)):
        yield


@contextmanager
def progress(title: str) -> Iterator[Callable[..., None]]:
    """A bar for one piece of work, told (done, in all), perhaps a new name; gone at the end. Nothing where there is no
    terminal."""
    if not sys.stderr.isatty():  # rich is not even imported
        yield lambda *_: None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(transient=True, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(f"{escape(title)}, getting ready", total=None)

        def tell(done: int, total: int, stage: str = title) -> None:
            bar.update(task, description=escape(stage), completed=done, total=total)

        yield tell


@contextmanager
def stages() -> Iterator[Callable[[str, int, int], None]]:
    """A bar for each stage as it begins, told (stage, done, in all); they stay, with the time that each took. Without a
    terminal a line for each stage."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    if not sys.stderr.isatty():  # a file or a pipe: a line as each stage begins
        begun: set[str] = set()

        def tell_begin(stage: str, done: int, total: int) -> None:
            if stage not in begun:
                begun.add(stage)
                print(f"{time.strftime('%H:%M:%S')} {stage} ({total})", file=sys.stderr, flush=True)

        yield tell_begin
        return
    columns = TextColumn("{task.description:<24}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True)) as bar:
        tasks: dict[str, TaskID] = {}

        def tell(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done, total=total)

        yield tell


@contextmanager
def stages_that_vanish() -> Iterator[Callable[[str, int, int], None]]:
    """One bar, told (stage, done, in all), that takes the name of each stage in turn and is gone at the end."""
    with progress("getting ready") as tell:
        yield lambda stage, done, total: tell(done, total, stage)
