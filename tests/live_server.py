"""A real server process on loopback, as a user starts it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def mapvote(*arguments: object) -> list[str]:
    """The command line of the installed program, run by this Python."""
    return [sys.executable, "-m", "mapvote", *map(str, arguments)]


@contextmanager
def serving(*arguments: object, log: Path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """(address, process) of `mapvote serve ARGUMENTS --port 0 --open`, which needs keys if any is issued; stopped at
    the end."""
    with log.open("a") as errors:
        environment = os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        command = mapvote("serve", *arguments, "--port", 0, "--open")
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment)
        assert process.stdout is not None
        try:
            line = process.stdout.readline()
            if not line.startswith("serving "):
                raise RuntimeError(f"the server did not start: {log.read_text()[-2000:]}")
            yield line.split()[1], process
        finally:
            process.terminate()
            process.wait(30)
            process.stdout.close()
