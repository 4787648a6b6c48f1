"""A private PostgreSQL cluster for tests: own directory, own socket, nothing of the machine's databases touched.

Durable as in production (fsync stays on), so that crash tests mean something.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

USER = "postgres"


def programs() -> Path | None:
    """The directory of initdb and pg_ctl, newest version first; None if PostgreSQL's server is not installed."""
    for folder in sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda p: float(p.parent.name), reverse=True):
        if (folder / "initdb").exists():
            return folder
    found = shutil.which("initdb")
    return Path(found).resolve().parent if found else None


class PostgresCluster:
    """One server process on a Unix socket. :meth:`stop` and :meth:`start` play an outage."""

    def __init__(self) -> None:
        folder = programs()
        if folder is None:
            raise FileNotFoundError("PostgreSQL's server is not installed (apt-get install postgresql)")
        self._programs = folder
        self.home = Path(tempfile.mkdtemp(prefix="mapvote-pg-"))
        self._data = self.home / "data"
        if os.getuid() == 0:  # the server refuses to run as root
            shutil.chown(self.home, USER, USER)
        self._run("initdb", "-D", str(self._data), "-U", USER, "--auth=trust", "--encoding=UTF8", "--locale=C.UTF-8")
        self.start()

    def start(self) -> None:
        options = f"-c listen_addresses='' -c unix_socket_directories={self.home} -c max_connections=200"
        self._run(
            "pg_ctl", "-D", str(self._data), "-l", str(self.home / "log"), "-o", options, "-w", "-t", "60", "start"
        )

    def stop(self, *, crash: bool = False) -> None:
        """Stop the server: cutting connections off, or (``crash``) without a checkpoint, as if the power had failed."""
        self._run("pg_ctl", "-D", str(self._data), "-m", "immediate" if crash else "fast", "-w", "stop")

    def create(self, name: str, like: str = "template1") -> str:
        """A new database, empty or a copy of another; its SQLAlchemy URL."""
        self._run("createdb", "-h", str(self.home), "-U", USER, "-T", like, name)
        return f"postgresql+psycopg://{USER}@/{name}?host={self.home}"

    def drop(self, name: str) -> None:
        """Remove a database, cutting off whoever is still connected."""
        self._run("dropdb", "-h", str(self.home), "-U", USER, "--force", name)

    def empty(self, name: str) -> None:
        """Leave nothing in a database, cutting off whoever is still connected: a tenth of the time of a new one."""
        everyone = f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = '{name}'"
        self._run("psql", "-h", str(self.home), "-U", USER, "-q", "-d", "postgres", "-c", everyone)
        schema = "DROP SCHEMA public CASCADE; CREATE SCHEMA public"
        self._run("psql", "-h", str(self.home), "-U", USER, "-q", "-d", name, "-c", schema)

    def close(self) -> None:
        """Stop the server and remove every trace of it."""
        with contextlib.suppress(RuntimeError):  # stopped already
            self.stop(crash=True)
        shutil.rmtree(self.home, ignore_errors=True)

    def _run(self, program: str, *arguments: str) -> None:
        command = [str(self._programs / program), *arguments]
        if os.getuid() == 0:
            command = ["runuser", "-u", USER, "--", *command]
        log = self.home / f"{program}.out"  # not a pipe: the server inherits it, and a pipe would never close
        with log.open("ab") as out:
            done = subprocess.run(command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, cwd="/", check=False)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)} failed:\n{log.read_text()[-2000:]}")


@contextlib.contextmanager
def cluster_for(database: str) -> Iterator[PostgresCluster | None]:
    """A cluster for "postgresql", gone at the end; None for "sqlite"."""
    cluster = PostgresCluster() if database == "postgresql" else None
    try:
        yield cluster
    finally:
        if cluster:
            cluster.close()
