"""A drive takes no more of the computer than it is told to."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

SAY = (
    "import os; from mapvote.live.process import limit_process; limit_process({cores}, {nice}); "
    "import threading; seen = []; "
    "t = threading.Thread(target=lambda: seen.append(len(os.sched_getaffinity(0)))); t.start(); t.join(); "
    "print(len(os.sched_getaffinity(0)), seen[0], os.nice(0))"
)


def run(cores: int | None, nice: int | None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", SAY.format(cores=cores, nice=nice)], capture_output=True, text=True, check=False
    )


def test_a_process_and_its_threads_keep_to_a_core_and_a_priority() -> None:
    before = os.nice(0)
    assert run(1, 3).stdout.split() == ["1", "1", str(min(before + 3, 19))]


@pytest.mark.parametrize(("cores", "said"), [(10_000, "only"), (None, "")])
def test_more_cores_than_there_are_is_an_error(cores: int | None, said: str) -> None:
    done = run(cores, None)
    assert (done.returncode != 0) == bool(said)
    assert said in done.stderr
