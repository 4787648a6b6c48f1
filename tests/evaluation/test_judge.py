"""benchmarks/judge.py --against: a scan costs no tenth more than at the commit that was measured last."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SPEED = ROOT / "docs/measurements/speed.md"


def last_measured() -> str:
    """The newest commit in the table by commit."""
    commits: list[str] = re.findall(r"^\| ([0-9a-f]{7,40}) \|", SPEED.read_text(), re.M)
    return commits[-1]


def judge(out: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "benchmarks/judge.py"), str(out), *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def test_a_revision_that_the_clone_lacks_is_named_with_the_mend(tmp_path: Path) -> None:
    run = judge(tmp_path, "--against", "0" * 40)
    assert run.returncode == 1
    assert f"{'0' * 40} is not in this clone; git fetch --unshallow" in run.stderr


@pytest.mark.slow
def test_a_scan_costs_no_tenth_more_than_at_the_commit_measured_last(tmp_path: Path) -> None:
    rev = last_measured()
    known = subprocess.run(["git", "-C", str(ROOT), "cat-file", "-e", f"{rev}^{{commit}}"], check=False)
    if known.returncode:
        pytest.skip(f"{rev} is not in this clone: a shallow one has no history to compare with")
    run = judge(tmp_path, "--street", "corner:1:vlp16", "--last", "60", "--against", rev)
    assert run.returncode == 0, run.stdout + run.stderr
    assert f"times that of {rev}" in run.stdout
