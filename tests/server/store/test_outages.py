"""Full disk, read-only disk, database gone: a clear refusal, nothing acknowledged lost, and it recovers by itself."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.config import FuseSettings
from mapvote.core.types import CellState, MapvoteError
from mapvote.server.errors import Unavailable
from mapvote.server.store.publish import publish
from mapvote.server.store.store import Store
from postgres_cluster import PostgresCluster
from stores import send

S = 1_000_000_000
POLICY = FuseSettings(max_deleted_share=1.0)


def vote(store: Store, drive: str, vehicle: str = "v1") -> None:
    """A ballot of some 60 kB that must be acknowledged; Unavailable if the store cannot keep it."""
    noise = np.random.default_rng(len(drive)).random((5000, 3), dtype=np.float32) * np.array([76, 76, 1], np.float32)
    say = Say(states_plane({(10, 10): CellState.CHANGED_EMPTY}), new_points=noise)
    ballot = make_ballot(two_walls(), {(0, 0): say}, vehicle, drive, end_ns=store.clock() - S)
    send(store, ballot)


def vote_until_refused(store: Store, acknowledged: list[str]) -> None:
    for i in range(400):
        vote(store, f"d{i}", f"v{i % 2}")
        acknowledged.append(f"d{i}")


def standing(store: Store) -> set[str]:
    with store.database.reading() as connection:
        return set(connection.exec_driver_sql("SELECT drive FROM ballots WHERE gone_seq IS NULL").scalars())


def test_a_full_disk_refuses_keeps_what_it_acknowledged_and_recovers(small_disk: Path) -> None:
    filler = small_disk / "filler"
    filler.write_bytes(bytes(12 << 20))
    store = Store.create(f"sqlite:///{small_disk / 'store.db'}", two_walls())
    acknowledged: list[str] = []
    with pytest.raises(Unavailable, match=r"full|disk"):
        vote_until_refused(store, acknowledged)
    assert acknowledged, "the disk was full before anything was acknowledged"
    assert standing(store) == set(acknowledged)
    with pytest.raises(Unavailable):
        vote(store, "again")
    filler.unlink()
    vote(store, "later", "v2")
    assert standing(store) == {*acknowledged, "later"}
    assert publish(store, POLICY).published
    store.close()


def test_a_read_only_disk_refuses_and_recovers(small_disk: Path) -> None:
    url = f"sqlite:///{small_disk / 'store.db'}"
    store = Store.create(url, two_walls())
    vote(store, "first")
    store.close()  # a disk with files open for writing cannot be made read-only
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with pytest.raises(MapvoteError, match=r"unable to open|read.?only"):
        vote(Store.open(url), "second")
    subprocess.run(["mount", "-o", "remount,rw", str(small_disk)], check=True)
    store = Store.open(url)
    vote(store, "third")
    assert standing(store) == {"first", "third"}
    store.close()


def test_a_database_that_is_gone_for_a_while_is_unavailable_and_then_itself_again(
    postgres_cluster: PostgresCluster, postgres_url: str
) -> None:
    store = Store.create(postgres_url, two_walls())
    vote(store, "before", "v1")
    postgres_cluster.stop()
    start = time.monotonic()
    for _ in range(3):
        with pytest.raises(Unavailable):
            vote(store, "during", "v2")
        with pytest.raises(Unavailable):
            store.current()
        with pytest.raises(Unavailable):
            publish(store, POLICY)
    assert time.monotonic() - start < 30.0, "each refusal must come soon"
    postgres_cluster.start()
    vote(store, "after", "v2")
    assert standing(store) == {"before", "after"}
    assert publish(store, POLICY).published
    store.close()
