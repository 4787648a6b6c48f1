"""`mapvote autoware` beside a client with message types of its own: a server that is away, a first start, a rollback,
kills. The client obeys every answer and never loses its map."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from hand_made import two_walls
from live.loopback_dds import until
from live_server import mapvote, serving
from mapvote_server.store.publish import publish
from mapvote_server.store.rollback import rollback
from mapvote_server.store.store import Store
from stores import vote_gone

pytest.importorskip("cyclonedds")
AWAY = "http://127.0.0.1:9"
OLD = [f"/opt/autoware/map/{k}.pcd" for k in range(60)]
"""Tiles that the client holds from the loader before."""


@contextmanager
def loader(url: str, folder: Path, domain: int) -> Iterator[subprocess.Popen[bytes]]:
    """A service, killed by -9 at the end if it still runs."""
    with (folder.parent / "autoware.log").open("a") as log:
        command = mapvote("autoware", url, folder, "--domain", domain, "--every", 0.2)
        process = subprocess.Popen(command, stdout=log, stderr=log, env=os.environ | {"PYTHONUNBUFFERED": "1"})
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    opened = Store.create(f"sqlite:///{tmp_path / 'fleet.db'}", two_walls())
    yield opened
    opened.close()


def until_told(log: Path, word: str, times: int) -> None:
    """Until the log has the word more than so many times."""
    until(lambda: log.read_text().count(word) > times)


def new_version(store: Store) -> None:
    """Publish that the walls are gone, or roll that back."""
    if store.current() % 2 == 1:
        vote_gone(store, drive=f"d{store.current()}")
        assert publish(store, override=True).published
    else:
        rollback(store, store.current() - 1)


@pytest.mark.slow
def test_without_a_server_a_fresh_folder_offers_no_service_and_a_folder_of_before_is_served(
    tmp_path: Path, store: Store, domain: int
) -> None:
    from live.foreign_client import ForeignClient

    client = ForeignClient(domain, OLD)
    with loader(AWAY, tmp_path / "map", domain):
        until(lambda: "no service is offered" in (tmp_path / "autoware.log").read_text())
        assert not client.sees_a_service
        assert not client.ask(3.0, 3.0, 150.0, 0.5)
    assert client.held == set(OLD)
    server = serving(tmp_path / "fleet.db", log=tmp_path / "serve.log")
    with server as (url, _), loader(url, tmp_path / "map", domain):
        until(lambda: client.ask(3.0, 3.0, 150.0, 2.0))
        first = set(client.held)
        assert first
        assert not first & set(OLD)
        new_version(store)
        until(lambda: client.ask(3.0, 3.0, 150.0, 20.0) and client.held != first)
        new_version(store)  # a rollback
        until(lambda: client.ask(3.0, 3.0, 150.0, 20.0) and client.held == first)
    with loader(AWAY, tmp_path / "map", domain) as process:
        # Until DDS notices that the killed service is gone, a request may still go to it.
        until(lambda: client.ask(3.0, 3.0, 150.0, 2.0))
        assert client.held == first
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0


@pytest.mark.slow
def test_no_start_or_kill_empties_a_client(tmp_path: Path, store: Store, domain: int) -> None:
    """Every fifth start has a fresh folder, every third no server, every seventh a new version on the way. Half are
    killed as soon as they serve or within 2 s, the others at any moment of their start. `STARTS=50 pytest -m slow`
    makes so many."""
    from live.foreign_client import ForeignClient

    client, dice = ForeignClient(domain, OLD), random.Random(7)
    starts = int(os.environ.get("STARTS", "8"))
    fewest, ended = [len(OLD)], threading.Event()

    def drive() -> None:
        while not ended.is_set():
            client.ask(3.0, 3.0, 150.0, 0.3)
            fewest[0] = min(fewest[0], len(client.held))

    vehicle = threading.Thread(target=drive)
    vehicle.start()
    answered = 0
    try:
        with serving(tmp_path / "fleet.db", log=tmp_path / "serve.log") as (url, _):
            for k in range(starts):
                before = client.replies
                log = tmp_path / "autoware.log"
                told = log.read_text().count("serving") if log.exists() else 0
                served = k % 3 != 2 and k % 4 != 3
                with loader(url if k % 3 != 2 else AWAY, tmp_path / f"map_{k // 5}", domain) as process:
                    if served:
                        until_told(log, "serving", told)
                    ended.wait(dice.uniform(0.0, 2.0))
                    if k % 7 == 0:
                        new_version(store)
                        ended.wait(dice.uniform(0.0, 1.0))
                    process.kill()
                answered += client.replies > before
    finally:
        ended.set()
        vehicle.join()
    assert fewest[0] > 0
    assert answered > 0.4 * starts, "the kills were to meet services that answer"


@pytest.mark.slow
def test_a_service_that_is_stopped_answers_what_had_arrived(tmp_path: Path, store: Store, domain: int) -> None:
    """Stopped at any moment: each request that found a service gets its answer."""
    from live.foreign_client import ForeignClient

    client, lost = ForeignClient(domain, []), 0
    with serving(tmp_path / "fleet.db", log=tmp_path / "serve.log") as (url, _):
        for k in range(4):
            with loader(url, tmp_path / "map", domain) as process:
                until(lambda: client.ask(3.0, 3.0, 150.0, 1.0))
                stopper = threading.Timer(0.15 + 0.05 * k, process.send_signal, (signal.SIGTERM,))
                stopper.start()
                while process.poll() is None and client.sees_a_service:
                    lost += not client.ask(3.0, 3.0, 150.0, 3.0) and client.sees_a_service
                stopper.join()
                process.wait(30)
    assert lost == 0
