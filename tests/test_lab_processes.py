"""Processes that work: whatever they are at, they end with the one that started them, and it does not wait for ever."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mapvote_lab.processes import load_in, processes

TASKS = """
import pathlib, signal, sys, time
from mapvote_lab.processes import processes

signal.signal(signal.SIGINT, signal.default_int_handler)

def deaf(_):
    pathlib.Path("ready").touch()
    return sum(range(25_000_000))  # seconds in one call: nothing is heard meanwhile

def long(_):
    try:
        pathlib.Path("ready").touch()
        time.sleep(60)
    finally:
        pathlib.Path("whole").touch()

def large(_):
    pathlib.Path("ready").touch()
    return bytes(200_000_000)  # takes its time on the way to the first process

if __name__ == "__main__":
    try:
        with processes(2) as pool:
            list(pool.map(globals()[sys.argv[1]], range(int(sys.argv[2]))))
    except KeyboardInterrupt:
        sys.exit(130)
"""


def interrupted(folder: Path, task: str, tasks: int, wait_s: float = 0.0, stop: int = signal.SIGINT) -> int:
    """The exit code after Ctrl-C to the whole process group, ``wait_s`` after a task has begun.

    Another ``stop`` goes to the first process alone.
    """
    (folder / "work.py").write_text(TASKS)
    process = subprocess.Popen(
        [sys.executable, "work.py", task, str(tasks)], cwd=folder, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    try:
        while not (folder / "ready").exists():
            assert process.poll() is None
            time.sleep(0.01)
        time.sleep(wait_s)
        if stop == signal.SIGINT:
            os.killpg(process.pid, stop)
        else:
            process.send_signal(stop)
        _, err = process.communicate(timeout=30)  # to the end of the pipe: until no process holds it any more
        assert "Traceback" not in err
        return process.returncode
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


@pytest.mark.slow
def test_ctrl_c_ends_a_process_that_waits_beside_one_that_hears_nothing(tmp_path: Path) -> None:
    """The one that waited ended first, and the other, told twice at once, waited for a next task for ever."""
    assert interrupted(tmp_path, "deaf", 1, 0.1) == 130


@pytest.mark.slow
def test_ctrl_c_lets_a_task_leave_its_files_whole(tmp_path: Path) -> None:
    assert interrupted(tmp_path, "long", 4) == 130
    assert (tmp_path / "whole").exists()


@pytest.mark.slow
@pytest.mark.parametrize("wait_s", [0.0, 0.05, 0.1, 0.3])
def test_ctrl_c_while_a_large_result_is_on_its_way(tmp_path: Path, wait_s: float) -> None:
    """Half a result would be waited for for ever."""
    assert interrupted(tmp_path, "large", 40, wait_s) == 130


@pytest.mark.slow
def test_processes_end_with_a_first_one_that_was_killed(tmp_path: Path) -> None:
    assert interrupted(tmp_path, "long", 4, stop=signal.SIGKILL) == -signal.SIGKILL


@pytest.mark.slow
def test_an_error_in_one_task_ends_the_others_and_is_raised() -> None:
    start = time.monotonic()
    with pytest.raises(ZeroDivisionError), processes(2) as pool:
        list(pool.map(_nap, (-1.0, 60.0)))
    assert time.monotonic() - start < 30


def _nap(seconds: float) -> float:
    time.sleep(max(seconds, 0.0))
    return 1 / (1 + seconds)


def is_loaded(module: str) -> bool:
    return module in sys.modules


@pytest.mark.parametrize("loading", ["", "wave"])
def test_a_process_loads_what_it_is_told_before_its_first_task(loading: str) -> None:
    with processes(1) as pool:
        if loading:
            load_in(pool, 1, loading)
        assert pool.submit(is_loaded, "wave").result() == bool(loading)
