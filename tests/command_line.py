"""The program as a user types it, in this process: the same parser, verbs and files, without a second of imports."""

from __future__ import annotations

import shlex
from pathlib import Path

from typer.testing import CliRunner

from mapvote.cli import app


def typed(*words: object, code: int = 0, **environment: str) -> str:
    """What the program says to these words, and ends with this code; an error is raised as the program raises it."""
    env = {"COLUMNS": "200", "NO_COLOR": "1", **environment}
    result = CliRunner().invoke(app, [str(word) for word in words], env=env, prog_name="mapvote")
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, f"{words}\n{result.output}"
    return result.output


def type_in(line: str) -> str:
    """What the program says to a command line, typed in the current folder; ``>`` works as in a shell."""
    words = shlex.split(line, comments=True)
    assert words[0] == "mapvote", line
    if ">" not in words:
        return typed(*words[1:])
    said = typed(*words[1 : words.index(">")])
    Path(words[words.index(">") + 1]).write_text(said)
    return said
