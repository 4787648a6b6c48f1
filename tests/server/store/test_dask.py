"""Fusion on a cluster: a real Dask scheduler and worker processes give, byte for byte, what one machine gives, and are
sent no secret."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, two_walls, wall
from live_server import mapvote
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote_server.store import fusion_jobs, schema
from mapvote_server.store.database import address_of
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import send

TILES = [(row, col) for row in range(2) for col in range(3)]
CELLS = [(r, c) for r in range(10, 40, 5) for c in range(10, 40, 5)]
HEIGHTS = [0.45, 0.75, 1.05]
SOURCES = str(Path(schema.__file__).parents[3])
"""Wherever mapvote was imported from: workers start in another folder."""
ENVIRONMENT = os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": SOURCES}


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a scheduler with two worker processes."""
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'mapvote[dask]'")
    home = tmp_path_factory.mktemp("dask")
    dask = [sys.executable, "-m", "dask"]
    file, log = home / "scheduler.json", (home / "log").open("w")
    worker = [*dask, "worker", "--scheduler-file", str(file), "--no-nanny", "--nthreads", "1", "--no-dashboard"]
    started = [
        [*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)],
        worker,
        worker,
    ]
    processes = []
    try:
        for command in started:
            processes.append(subprocess.Popen(command, stdout=log, stderr=log, cwd=home, env=ENVIRONMENT))
            deadline = time.monotonic() + 60
            while not file.exists():
                assert time.monotonic() < deadline, (home / "log").read_text()
                time.sleep(0.05)
        yield json.loads(file.read_text())["address"]
    finally:
        for process in reversed(processes):
            process.kill()
            process.wait()
        log.close()


def voted(url: str) -> Store:
    """A store in which five vehicles take down some pillars and build others, on six tiles."""
    tile = make_tile(np.concatenate([wall(CELLS, [0.05]), wall(CELLS, HEIGHTS)]))
    point_map = make_map(dict.fromkeys(TILES, tile))
    store = Store.create(url, point_map, clock=lambda: 1_700_000_000_000_000_000)
    rng = np.random.default_rng(1)
    for i in range(5):
        says = {}
        for index in TILES:
            states = states_plane({cell: CellState.CHANGED_EMPTY for cell in CELLS if rng.random() < 0.6})
            new = [(int(r), int(c)) for r, c in rng.integers(100, 110, (30, 2))]
            for cell in new:
                states[cell] = CellState.CHANGED_OCCUPIED
            jitter = rng.normal(0, 0.02, (3 * len(new), 3)).astype(np.float32)
            says[index] = Say(states, new_points=wall(new, HEIGHTS) + jitter)
        ballot = make_ballot(point_map, says, f"v{i}", "d1", end_ns=1_690_000_000_000_000_000 + i)
        send(store, ballot)
    return store


def published(store: Store) -> dict[str, list[tuple[object, ...]]]:
    """Everything that a publication wrote."""
    tables = (schema.versions, schema.version_tiles, schema.blobs, schema.decisions)
    with store.database.reading() as connection:
        return {
            table.name: sorted((tuple(row) for row in connection.execute(sa.select(table))), key=repr)
            for table in tables
        }


@pytest.mark.slow
def test_a_cluster_publishes_byte_for_byte_what_one_machine_does(
    cluster: str, database_url: str, tmp_path: Path
) -> None:
    from distributed import Client

    here, there = voted(f"sqlite:///{tmp_path / 'here.db'}"), voted(database_url)
    policy = FuseSettings(max_deleted_share=1.0)
    assert publish(here, policy).published
    with Client(cluster, timeout="20s", set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)
        outcome = publish(there, policy, executor=client.get_executor(pure=False))
    assert (outcome.published, len(outcome.tiles)) == (True, len(TILES))
    assert outcome.points_added > 0
    assert outcome.points_deleted > 0
    assert published(here) == published(there)
    here.close()
    there.close()


@pytest.mark.slow
def test_the_verb_fuses_on_the_cluster_and_says_when_there_is_none(cluster: str, tmp_path: Path) -> None:
    voted(f"sqlite:///{tmp_path / 'store.db'}").close()
    verb = mapvote("publish", tmp_path / "store.db", "--cluster", "tcp://127.0.0.1:1")
    refused = subprocess.run(verb, capture_output=True, text=True, env=ENVIRONMENT, check=False)
    assert refused.returncode == 1
    assert "no Dask scheduler answers" in refused.stderr
    verb = mapvote("publish", "store.db", "--override", "--cluster", cluster)  # workers stand in another folder
    done = subprocess.run(verb, capture_output=True, text=True, env=ENVIRONMENT, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "published" in done.stdout


class Elsewhere(Executor):
    """A cluster: what is to be done there is pickled on its way."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **more: Any) -> Future[Any]:
        self.sent.append(pickle.dumps((fn, args, more)))
        done: Future[Any] = Future()
        function, arguments, named = pickle.loads(self.sent[-1])
        done.set_result(function(*arguments, **named))
        return done


def test_a_task_for_a_cluster_carries_no_password_its_worker_has_its_own(
    postgres_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = sa.make_url(postgres_url).set(password="a-secret")
    store = Store.create(whole.render_as_string(hide_password=False), two_walls())
    says = {(0, 0): Say(states_plane({(10, 10): CellState.CHANGED_EMPTY}))}
    send(store, *[make_ballot(two_walls(), says, vehicle, "d1") for vehicle in ("a", "b")])
    monkeypatch.setenv("MAPVOTE_STORE", whole.render_as_string(hide_password=False))
    fusion_jobs._database.cache_clear()
    cluster = Elsewhere()
    assert publish(store, FuseSettings(max_deleted_share=1.0), executor=cluster).version == 2
    assert cluster.sent
    assert not any(b"a-secret" in sent for sent in cluster.sent)
    used = fusion_jobs._database(address_of(whole))
    assert used.url.password == "a-secret"
    used.close()
    fusion_jobs._database.cache_clear()
    store.close()
