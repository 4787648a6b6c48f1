"""The program as a user types it, in this process: the same parser, verbs and files, without a second of imports."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from typer.main import get_command
from typer.testing import CliRunner

from mapvote.cli import app


def typed(*words: object, code: int = 0, **environment: str) -> str:
    """All that the program says to these words, ending with this code; errors are raised as the program raises them."""
    return _run(words, code, environment)[1]


def type_in(line: str) -> str:
    """The program's stdout for a command line, typed in the current folder; ``>`` works as in a shell."""
    words = shlex.split(line, comments=True)
    assert words[0] == "mapvote", line
    end = words.index(">") if ">" in words else len(words)
    said, _ = _run(words[1:end], 0, {})
    for file in words[end + 1 :]:
        Path(file).write_text(said)
    return said


@cache
def _program() -> Any:
    """All verbs with their options: made once, for that takes a twentieth of a second."""
    return get_command(app)


def _run(words: Sequence[object], code: int, environment: Mapping[str, str]) -> tuple[str, str]:
    """What was written to stdout; to stdout and stderr together."""
    env = {"COLUMNS": "200", "NO_COLOR": "1", **environment}
    ended = 0
    with CliRunner().isolation(env=env) as (stdout, _, both):
        try:
            _program().main(args=[str(word) for word in words], prog_name="mapvote")
        except SystemExit as end:
            ended = end.code if isinstance(end.code, int) else int(end.code is not None)
        sys.stdout.flush()
        sys.stderr.flush()
        said = stdout.getvalue().decode(), both.getvalue().decode()
    assert ended == code, f"{words}\n{said[1]}"
    return said
