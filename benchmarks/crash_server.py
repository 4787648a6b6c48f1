"""Kill `mapvote serve` with SIGKILL while vehicles send ballots by HTTP and an operator publishes (see crash.py)."""

from __future__ import annotations

import random
import tempfile
import threading
import time
from pathlib import Path

import httpx2

from crash import CELLS, TILES, votes_on
from live_server import serving
from mapvote.client import MapClient
from mapvote.core.types import MapvoteError
from postgres_cluster import PostgresCluster

VEHICLES = 4
"""Pairs of vehicles that send at once."""


class Traffic:
    """Vehicles and an operator at one server, until it is gone."""

    def __init__(self, url: str, seed: int, home: Path) -> None:
        self.acknowledged: list[tuple[str, str]] = []
        self.begun = threading.Event()
        self._url, self._seed, self._home = url, seed, home
        self._over = threading.Event()
        self._threads = [threading.Thread(target=self._vehicles, args=(i,)) for i in range(VEHICLES)]
        self._threads.append(threading.Thread(target=self._operator))
        for thread in self._threads:
            thread.start()

    def end(self) -> None:
        """After the kill: wait until everybody has noticed."""
        self._over.set()
        for thread in self._threads:
            thread.join()

    def _vehicles(self, number: int) -> None:
        rng = random.Random(self._seed * VEHICLES + number)
        with MapClient(self._url, home=self._home / str(number), attempts=1) as client:
            turn = 0
            while not self._over.is_set():
                turn += 1
                tile, cell = rng.choice(TILES), rng.choice(CELLS)
                try:
                    content = client.fetch().tiles[tile]
                    for ballot in votes_on(content, tile, cell, f"v{number}", f"{self._seed}.{turn}"):
                        if client.send(ballot) != "spooled":
                            self.acknowledged.append((ballot.vehicle, ballot.drive))
                            self.begun.set()
                except MapvoteError:  # gone, or published meanwhile: an honest refusal
                    continue

    def _operator(self) -> None:
        with httpx2.Client(base_url=self._url, timeout=10.0) as http:
            while not self._over.is_set():
                try:
                    http.request("POST", "/v1/publish", json={"override": True})
                except httpx2.TransportError:
                    return


def killed_server(url: str, seed: int, moment_s: float, cluster: PostgresCluster | None) -> list[tuple[str, str]]:
    """Start a server, kill it (and the database under it) ``moment_s`` after its first acknowledgement."""
    store = url.removeprefix("sqlite:///")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "server.toml").write_text("[server]\ndrives_a_day = 1000000\n")
        with serving(store, "--config", folder / "server.toml", log=folder / "log") as (address, process):
            traffic = Traffic(address, seed, folder)
            try:
                if not traffic.begun.wait(60.0):
                    raise SystemExit(f"kill {seed}: nothing was acknowledged: {(folder / 'log').read_text()[-2000:]}")
                time.sleep(moment_s)
                if cluster is not None:
                    cluster.stop(crash=True)
                if process.poll() is not None:
                    raise SystemExit(f"kill {seed}: the server ended by itself: {(folder / 'log').read_text()[-2000:]}")
            finally:
                process.kill()
                process.wait()
                traffic.end()
        if "Traceback" in (folder / "log").read_text():
            raise SystemExit(f"kill {seed}: the server stumbled: {(folder / 'log').read_text()[-4000:]}")
    if cluster is not None:
        cluster.start()
    return traffic.acknowledged
