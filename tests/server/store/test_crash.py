"""kill -9 during ingest and publish loses nothing that was acknowledged: what benchmarks/crash.py does at length."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import sqlalchemy as sa

from postgres_cluster import programs

ROOT = Path(__file__).parents[3]


def crash(kills: int, database: str) -> None:
    command = [sys.executable, "benchmarks/crash.py", "--kills", str(kills), "--database", database]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    found = re.search(r"(\d+) acknowledged ballots, all there; (\d+) versions, all whole", done.stdout)
    assert found, done.stdout
    assert int(found[1]) >= kills, "the server did nothing worth killing"
    assert int(found[2]) > 1


@pytest.mark.slow
@pytest.mark.parametrize("database", ["sqlite", "postgresql"])
def test_kills_lose_nothing_that_was_acknowledged(database: str) -> None:
    if database == "postgresql" and programs() is None:
        pytest.skip("PostgreSQL's server is not installed: apt-get install postgresql")
    crash(int(os.environ.get("KILLS", "5")), database)


def test_the_postgresql_of_the_tests_is_durable(postgres_url: str) -> None:
    engine = sa.create_engine(postgres_url)
    with engine.connect() as connection:
        for setting in ("fsync", "synchronous_commit"):
            assert connection.execute(sa.text(f"SHOW {setting}")).scalar_one() == "on"
    engine.dispose()
