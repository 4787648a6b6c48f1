"""Processes that work through tasks, and that end cleanly with the one that started them."""

from __future__ import annotations

import multiprocessing
import signal
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, wait
from contextlib import contextmanager


@contextmanager
def processes(workers: int) -> Iterator[ProcessPoolExecutor]:
    """``workers`` spawned processes. On an error or Ctrl-C, what waits is dropped and what runs is ended at once.

    A terminal sends Ctrl-C to every process; here only the first one hears it. The others are told to end, so that
    they leave their own files whole, and nobody prints a traceback.
    """
    spawn = multiprocessing.get_context("spawn")
    before = set(multiprocessing.active_children())
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=_end_when_told) as pool:
        heard = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a new process inherits what is blocked
        started = [pool.submit(_nothing) for _ in range(workers)]
        signal.pthread_sigmask(signal.SIG_SETMASK, heard)
        try:
            wait(started)
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(multiprocessing.active_children()) - before:
                process.terminate()
            raise


def _end_when_told() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))


def _nothing() -> None:
    """A task that only makes sure of a process to run it."""
