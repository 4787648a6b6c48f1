"""The command line: one short function per verb, heavy imports inside the verbs.

A mistake that a user can mend is one line on stderr and exit code 1; Ctrl-C is one line and exit code 130, and leaves
nothing half-written. A traceback is a bug.
"""

from __future__ import annotations

import os
import sys
from importlib.metadata import entry_points
from typing import Annotated

import typer

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    # Before numpy is imported: its products here are small, and threads that wait for each other cost twice the CPU
    # time. Work is spread over vehicles and tiles instead. A number that the user sets stays.
    os.environ.setdefault(_threads, "1")

from mapvote.cli import drives, files, lanelets, live, setup  # noqa: E402
from mapvote.cli.options import Panel  # noqa: E402
from mapvote.cli.terminal import complain  # noqa: E402
from mapvote.core.types import MapvoteError  # noqa: E402

app = typer.Typer(
    name="mapvote",
    help="Keep 3D point-cloud maps true: vehicles vote on what has changed.",
    epilog="`mapvote COMMAND --help` is the manual of a command. `mapvote demo` shows all of it in a minute.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
VERBS = {
    Panel.DRIVE: (
        drives.build, drives.vote, live.send, live.show, live.topics, live.play, live.drive, live.autoware, drives.diff,
        drives.merge, lanelets.affected, files.doctor,
    ),
    Panel.MAP: (files.import_map, files.export, files.info, files.update),
    Panel.SETUP: (setup.config, setup.warmup),
}  # fmt: skip
"""The verbs as ``mapvote --help`` lists them."""
for panel, verbs in VERBS.items():
    for verb in verbs:
        app.command(verb.__name__.removesuffix("_map"), rich_help_panel=panel)(verb)
for other_package in entry_points(group="mapvote.verbs"):
    # The server and the laboratory (demo, simulate, evaluate) add their verbs here; this package knows neither.
    other_package.load()(app)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"mapvote {version('mapvote')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="print the version and end")
    ] = False,
) -> None:
    """Keep 3D point-cloud maps true: vehicles vote on what has changed."""


def run() -> None:
    """Run the verb that the command line names, and end the process with its exit code."""
    try:
        app(prog_name="mapvote")
    except MapvoteError as error:
        complain(str(error))
    except ModuleNotFoundError as error:
        from mapvote.core.extras import missing_extra

        mend = missing_extra(error)
        if mend is None:
            raise
        complain(mend)
    except OSError as error:
        complain(f"{error.filename or 'input or output'}: {error.strerror or error}")
    except SystemExit as end:
        if end.code == 130:
            complain("interrupted; what was not finished was not written")
        raise
    sys.exit(1)
