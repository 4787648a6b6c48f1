"""The program as a user types it, in this process: the same parser, verbs and files, without a second of imports."""

from __future__ import annotations

import shlex
from pathlib import Path

from typer.testing import CliRunner

from mapvote.cli import app


def type_in(line: str) -> str:
    """What the program says to a command line, typed in the current folder; ``>`` works as in a shell."""
    words = shlex.split(line, comments=True)
    assert words[0] == "mapvote", line
    file = words[words.index(">") + 1] if ">" in words else None
    result = CliRunner().invoke(app, words[1 : words.index(">") if file else None], env={"COLUMNS": "200"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, f"{line}\n{result.output}"
    if file:
        Path(file).write_text(result.stdout)
    return result.stdout
