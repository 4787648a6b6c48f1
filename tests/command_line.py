"""The program as a user types it, in this process: the same parser, verbs and files, without a second of imports."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from typer.testing import CliRunner, Result

from mapvote.cli import app


def typed(*words: object, code: int = 0, **environment: str) -> str:
    """All that the program says to these words, ending with this code; errors are raised as the program raises them."""
    return _run(words, code, environment).output


def type_in(line: str) -> str:
    """The program's stdout for a command line, typed in the current folder; ``>`` works as in a shell."""
    words = shlex.split(line, comments=True)
    assert words[0] == "mapvote", line
    end = words.index(">") if ">" in words else len(words)
    said = _run(words[1:end], 0, {}).stdout
    for file in words[end + 1 :]:
        Path(file).write_text(said)
    return said


def _run(words: Sequence[object], code: int, environment: Mapping[str, str]) -> Result:
    env = {"COLUMNS": "200", "NO_COLOR": "1", **environment}
    result = CliRunner().invoke(app, [str(word) for word in words], env=env, prog_name="mapvote")
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, f"{words}\n{result.output}"
    return result
