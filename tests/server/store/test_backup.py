"""The backups of docs/operations.md while votes arrive: no vote acknowledged before the backup began is lost."""

from __future__ import annotations

import re
import shutil
import sqlite3
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import httpx2
import pytest
import sqlalchemy as sa

from contract import ROOT
from hand_made import make_ballot, two_walls
from live_server import serving
from mapvote.codec.ballot import encode
from mapvote_server.store import schema
from mapvote_server.store.integrity import check
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from postgres_cluster import PostgresCluster, programs
from stores import wall_gone

OPERATIONS = (ROOT / "docs/operations.md").read_text()


@contextmanager
def votes_arriving(url: str) -> Iterator[list[str]]:
    """The drives that were acknowledged so far; two vehicles send one after the other until the end."""
    acknowledged: list[str] = []
    done = threading.Event()
    trouble: list[str] = []
    base = two_walls()

    def send(vehicle: str) -> None:
        with httpx2.Client(base_url=url, timeout=60.0) as http:
            number = 0
            while not done.is_set():
                number += 1
                ballot = make_ballot(
                    base, {(0, 0): wall_gone()}, vehicle, f"{vehicle}{number}", end_ns=time.time_ns() - 10**9
                )
                answer = http.put(f"/v1/ballots/{vehicle}/{vehicle}{number}", content=encode(ballot))
                if answer.status_code != 201:
                    trouble.append(answer.text)
                    return
                acknowledged.append(f"{vehicle}{number}")

    threads = [threading.Thread(target=send, args=(name,)) for name in "ab"]
    for thread in threads:
        thread.start()
    try:
        while len(acknowledged) < 20 and not trouble:
            done.wait(0.01)
        yield acknowledged
        enough = len(acknowledged) + 5
        while len(acknowledged) < enough and not trouble:
            done.wait(0.01)
    finally:
        done.set()
        for thread in threads:
            thread.join(60.0)
    assert trouble == []


def drives_in(store: Store) -> set[str]:
    with store.database.reading() as connection:
        return set(connection.execute(sa.select(schema.ballots.c.drive)).scalars())


def rehearse(source: str | Path, log: Path, back_up: Callable[[], None], restored: str) -> None:
    """Back up while votes arrive; what was restored has every vote acknowledged before, is sound, and goes on."""
    with serving(source, log=log, settings="[server]\nballots_per_minute = 1e6\ndrives_a_day = 100000\n") as (url, _):
        with votes_arriving(url) as acknowledged:
            before = set(acknowledged)
            back_up()
            while_backing_up = len(acknowledged) - len(before)
        after = set(acknowledged)
    with closing(Store.open(restored)) as store:
        found = drives_in(store)
        assert len(before - found) == 0, f"{len(before - found)} of {len(before)} acknowledged votes are lost"
        assert found < after, "the backup is of a moment, and votes came later"
        assert check(store) == []
        assert publish(store, override=True).published
    print(f"{len(before)} votes before, {while_backing_up} while backing up, {len(after) - len(found)} after")


@pytest.mark.slow
def test_the_backup_of_sqlite_loses_no_acknowledged_vote_and_is_sound(tmp_path: Path) -> None:
    """By SQLite's online backup, which `sqlite3 STORE .backup` and Python's sqlite3 both call."""
    assert re.search(r'sqlite3 fleet\.db "\.backup fleet-backup\.db"', OPERATIONS)
    source = tmp_path / "fleet.db"
    Store.create(f"sqlite:///{source}", two_walls()).close()

    def back_up() -> None:
        if shutil.which("sqlite3"):
            command = ["sqlite3", str(source), f".backup {tmp_path / 'fleet-backup.db'}"]
            subprocess.run(command, check=True, timeout=60.0)
            return
        with closing(sqlite3.connect(source)) as here, closing(sqlite3.connect(tmp_path / "fleet-backup.db")) as there:
            here.backup(there)

    rehearse(source, tmp_path / "log", back_up, f"sqlite:///{tmp_path / 'fleet-backup.db'}")


@pytest.mark.slow
def test_the_backup_of_postgresql_loses_no_acknowledged_vote_and_is_sound(
    tmp_path: Path, postgres_cluster: PostgresCluster
) -> None:
    """By pg_dump and pg_restore."""
    told = r"pg_dump --format=custom mapvote > mapvote\.dump +# pg_restore --dbname mapvote mapvote\.dump"
    assert re.search(told, OPERATIONS)
    folder = programs()
    assert folder is not None
    source = postgres_cluster.create("live")
    Store.create(source, two_walls()).close()
    restored = postgres_cluster.create("restored")
    here = ["--host", str(postgres_cluster.home), "--username", "postgres"]
    dump = tmp_path / "mapvote.dump"

    def back_up() -> None:
        with dump.open("wb") as out:
            command = [str(folder / "pg_dump"), *here, "--format=custom", "live"]
            subprocess.run(command, check=True, stdout=out, timeout=60.0)
        command = [str(folder / "pg_restore"), *here, "--dbname", "restored", str(dump)]
        subprocess.run(command, check=True, timeout=60.0)

    try:
        rehearse(source, tmp_path / "log", back_up, restored)
    finally:
        for name in ("live", "restored"):
            postgres_cluster.drop(name)
