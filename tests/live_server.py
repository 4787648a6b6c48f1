"""A real server on loopback: a process, as a user starts it, or a thread of this one."""

from __future__ import annotations

import gc
import logging
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import structlog

from mapvote.config import load_with_sources
from mapvote_server.api import serve
from mapvote_server.gate import gate_by
from mapvote_server.store.store import Store


def mapvote(*arguments: object) -> list[str]:
    """The command line of the installed program, run by this Python."""
    return [sys.executable, "-m", "mapvote", *map(str, arguments)]


@contextmanager
def serving(*arguments: object, log: Path, settings: str = "") -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """(address, process) of `mapvote serve ARGUMENTS --port 0 --open`, which needs keys if any is issued; stopped at
    the end, when no traceback may be in the log. ``settings``: of a file, in TOML."""
    with log.open("a") as errors:
        environment = os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        command = mapvote("serve", *arguments, *_config(log, settings), "--port", 0, "--open")
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
    assert "Traceback" not in log.read_text(), log.read_text()[-3000:]


def _config(log: Path, settings: str) -> list[object]:
    file = log.with_suffix(".toml")
    file.write_text(settings)
    return ["--config", file] if settings else []


@contextmanager
def serving_here(store: Path, *, log: Path, settings: str = "") -> Iterator[str]:
    """Address of a server in a thread, open until a key is issued: for tests that neither stop nor measure it. It
    costs no seconds of imports. ``log``: what it would say on stderr; ``settings`` as in :func:`serving`."""
    read, _ = load_with_sources(Path(str(_config(log, settings)[1])) if settings else None)
    opened, switch_s = Store.open(f"sqlite:///{store}"), sys.getswitchinterval()
    servers: queue.Queue[serve._Server] = queue.Queue()
    addresses: queue.Queue[str] = queue.Queue()

    class Kept(serve._Server):
        async def startup(self, *arguments: Any, **more: Any) -> None:
            await super().startup(*arguments, **more)
            servers.put(self)

    def run() -> None:
        serve.serve(
            opened, read, port=0, opened=True, gate=gate_by(read.ndt, read.server.gate_drives), ready=addresses.put
        )

    thread = threading.Thread(target=run)
    with log.open("a") as written, mock.patch.object(serve, "_Server", Kept):
        structlog.configure(logger_factory=structlog.WriteLoggerFactory(written))
        heard = logging.StreamHandler(written)
        logging.getLogger().addHandler(heard)
        try:
            thread.start()
            server = servers.get(timeout=30.0)
            try:
                yield addresses.get()
            finally:
                server.should_exit = True
                thread.join(30.0)
        finally:
            logging.getLogger().removeHandler(heard)
            structlog.reset_defaults()
            sys.setswitchinterval(switch_s)
            gc.unfreeze()
            opened.close()
    assert "Traceback" not in log.read_text(), log.read_text()[-3000:]
