"""Databases for the server's tests: a fresh one each, SQLite in a file or PostgreSQL in a private cluster."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from postgres_cluster import PostgresCluster, programs

_DATABASE = "mapvote"


@pytest.fixture(autouse=True)
def _without_certificates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Servers here speak HTTP: each client would read all certificates of the system first, 30 ms."""
    monkeypatch.delenv("SSL_CERT_FILE", raising=False)
    monkeypatch.setenv("SSL_CERT_DIR", str(tmp_path))


@pytest.fixture(scope="session")
def postgres_cluster() -> Iterator[PostgresCluster]:
    """A private PostgreSQL server for the whole session; skipped where PostgreSQL is not installed."""
    if programs() is None:
        pytest.skip("PostgreSQL's server is not installed: apt-get install postgresql")
    pytest.importorskip("psycopg", reason="psycopg is not installed: pip install 'mapvote[postgres]'")
    cluster = PostgresCluster()
    yield cluster
    cluster.close()


@pytest.fixture(scope="session")
def postgres_database(postgres_cluster: PostgresCluster) -> str:
    return postgres_cluster.create(_DATABASE)


@pytest.fixture
def postgres_url(postgres_cluster: PostgresCluster, postgres_database: str) -> Iterator[str]:
    """The SQLAlchemy URL of an empty PostgreSQL database, emptied after the test."""
    yield postgres_database
    postgres_cluster.empty(_DATABASE)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """A test of a ``database_url`` runs on SQLite and, if slow tests run or it is of the contract, on PostgreSQL."""
    if "database_url" in metafunc.fixturenames:
        contract = metafunc.definition.get_closest_marker("contract") is not None
        there = pytest.param("postgresql", marks=() if contract else pytest.mark.slow)
        metafunc.parametrize("database_url", ["sqlite", there], indirect=True)


@pytest.fixture
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The SQLAlchemy URL of an empty database, see :func:`pytest_generate_tests`."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'store.db'}"
    url: str = request.getfixturevalue("postgres_url")
    return url


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 16 MB of its own; only root may mount one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = os.getuid() == 0 and subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(disk)], capture_output=True, check=False
    )
    if not mounted or mounted.returncode:
        pytest.skip("only root can mount a small disk to fill")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)
