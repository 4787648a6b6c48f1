"""Processes that work through tasks, and that end cleanly with the one that started them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager, nullcontext, suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sys import UnraisableHookArgs


@contextmanager
def processes(workers: int) -> Iterator[ProcessPoolExecutor]:
    """``workers`` spawned processes. On an error or Ctrl-C what waits is dropped, what runs is ended, and waited for.

    A terminal sends Ctrl-C to every process; here only the first one hears it. The others are told to end, so that
    they leave their own files whole, and none prints a traceback.
    """
    spawn = multiprocessing.get_context("spawn")
    before = set(multiprocessing.active_children())
    with _Pool(workers, mp_context=spawn, initializer=_listen) as pool:
        heard = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a new process inherits the blocked signals
        started = [pool.submit(_nothing) for _ in range(workers)]
        signal.pthread_sigmask(signal.SIG_SETMASK, heard)
        try:
            wait(started)
            yield pool
        except BaseException:
            if all(start.done() for start in started):  # a process that does not listen yet would be killed by it
                for process in set(multiprocessing.active_children()) - before:
                    with suppress(ProcessLookupError):
                        os.kill(process.pid or 0, signal.SIGUSR1)
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def load_in(helpers: Executor, workers: int, module: str) -> None:
    """Let ``workers`` idle processes import a module, while this one does something else."""
    for _ in range(workers):
        helpers.submit(import_module, module)


Run = Callable[[Callable[[Any], Any], Sequence[Any]], Iterable[Any]]


@contextmanager
def mapping(workers: int) -> Iterator[Run]:
    """A map over tasks whose results come in the order of the tasks: in this process, or in more spawned ones."""
    with processes(workers) if workers > 1 else nullcontext() as pool:
        yield pool.map if pool else map


class _Pool(ProcessPoolExecutor):
    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        return super().submit(_until_told, fn, *args, **kwargs)


class _Ear:
    """State of a process that may be told to end. It may end in the middle of a task only: between two of them it may
    hold half a
    result, which the first process would wait for for ever."""

    told = False
    working = False


def _listen() -> None:
    signal.signal(signal.SIGUSR1, _hear)
    sys.unraisablehook = _hear_again
    threading.Thread(target=_end_with_the_first, daemon=True).start()


def _end_with_the_first() -> None:
    """End this process with the first one: a first process that was killed sends no signal, and the others would work,
    and then wait, for ever."""
    first = multiprocessing.parent_process()
    assert first is not None
    first.join()
    os._exit(143)


def _hear(*_: object) -> None:
    _Ear.told = True
    if _Ear.working:
        sys.exit(143)


def _hear_again(lost: UnraisableHookArgs) -> None:
    """Python drops an exception raised while it takes an object away: the signal is sent once more, after 0.05 s."""
    if issubclass(lost.exc_type, SystemExit):
        again = threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGUSR1))
        again.daemon = True
        again.start()
    else:
        sys.__unraisablehook__(lost)


def _until_told(task: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    _Ear.working = True
    try:
        if _Ear.told:
            sys.exit(143)
        return task(*args, **kwargs)
    finally:
        _Ear.working = False


def _nothing() -> None:
    """A task that only makes sure of a process to run it."""
