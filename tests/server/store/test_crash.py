"""kill -9 during ingest and publish loses nothing that was acknowledged (benchmarks/crash.py, which says how)."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from postgres_cluster import programs

ROOT = Path(__file__).parents[3]


def crash(kills: int, database: str, *more: str) -> None:
    command = [sys.executable, "benchmarks/crash.py", "--kills", str(kills), "--database", database, *more]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    found = re.search(r"(\d+) acknowledged ballots, all there; (\d+) versions, all whole", done.stdout)
    assert found, done.stdout
    assert int(found[1]) > kills, "the workers did nothing worth killing"
    assert int(found[2]) > 1


def test_three_kills() -> None:
    crash(3, "sqlite")


@pytest.mark.slow
@pytest.mark.parametrize("more", [(), ("--server",)])
@pytest.mark.parametrize("database", ["sqlite", "postgresql"])
def test_twenty_kills(database: str, more: tuple[str, ...]) -> None:
    """Of a process that calls the store, and of a server under load by HTTP."""
    if database == "postgresql" and programs() is None:
        pytest.skip("PostgreSQL's server is not installed: apt-get install postgresql")
    crash(20, database, *more)
