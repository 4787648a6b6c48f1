"""The command line: one short function per verb, heavy imports inside the verbs.

Errors a user can mend are MapvoteError: one line on stderr, exit code 1. A traceback is a bug.
"""

from __future__ import annotations

import sys

import typer
from rich.console import Console

from mapvote.cli import evaluation, files, inspect, server, update, vehicle
from mapvote.core.types import MapvoteError

app = typer.Typer(
    name="mapvote",
    help="Keep 3D point-cloud maps true: vehicles vote on what has changed.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode="markdown",
)


def main() -> None:
    """Entry point of the ``mapvote`` command."""
    register(app)
    try:
        app(standalone_mode=True)
    except MapvoteError as error:
        Console(stderr=True, soft_wrap=True).print(f"[bold red]mapvote:[/] {error}", highlight=False)
        sys.exit(1)


def register(app: typer.Typer) -> None:
    """Add every verb to ``app``. Modules import nothing heavy at their top."""
    evaluation.register(app)
    vehicle.register(app)
    files.register(app)
    update.register(app)
    server.register(app)
    inspect.register(app)
