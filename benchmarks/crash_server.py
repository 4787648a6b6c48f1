"""Kill `mapvote serve` with SIGKILL while vehicles send ballots by HTTP and an operator publishes (see crash.py)."""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from functools import cache
from pathlib import Path

import httpx2

from crash import CELLS, TILES, votes_on
from mapvote.client import MapClient
from mapvote.core.types import MapvoteError
from postgres_cluster import PostgresCluster

VEHICLES = 4
"""Pairs of vehicles that send at once."""


class Traffic:
    """Vehicles and an operator at one server, until it is gone."""

    def __init__(self, url: str, seed: int, home: Path) -> None:
        self.acknowledged: list[tuple[str, str]] = []
        self.begun, self._news = threading.Event(), threading.Event()
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
                    point_map = client.fetch()
                    content, version = point_map.tiles[tile], point_map.version or 1
                    for ballot in votes_on(content, version, tile, cell, f"v{number}", f"{self._seed}.{turn}"):
                        if client.send(ballot) != "spooled":
                            self.acknowledged.append((ballot.vehicle, ballot.drive))
                            self.begun.set()
                            self._news.set()
                except MapvoteError:  # gone, or published meanwhile: an honest refusal
                    continue

    def _operator(self) -> None:
        with httpx2.Client(base_url=self._url, timeout=10.0) as http:
            while not self._over.is_set():
                self._news.wait(0.5)  # until a ballot is in: else no vehicle ever has the newest map on a slow machine
                self._news.clear()
                try:
                    http.request("POST", "/v1/publish", json={"override": True})
                except httpx2.TransportError:
                    return


class Launcher:
    """Starts servers quickly: each is forked from a process that has the program loaded already, so that two hundred
    take minutes. From there on it is `mapvote serve`, as a user starts it."""

    def __init__(self) -> None:
        command = [sys.executable, __file__]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def start(self, store: str, config: Path, log: Path) -> tuple[str, int]:
        """(address, process) of a new server."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([store, str(config), str(log)]) + "\n")
        self._process.stdin.flush()
        said = dict(self._process.stdout.readline().split() for _ in range(2))
        if said.keys() != {"pid", "serving"}:
            raise SystemExit(f"the server did not start: {log.read_text()[-2000:]}")
        return said["serving"], int(said["pid"])


def launch() -> None:
    """The launcher's own process: a line of JSON for each server, the process and the address of it for an answer."""
    from mapvote.cli.operate import serve
    from mapvote.server.http import serve as _loaded  # noqa: F401

    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    for line in sys.stdin:
        store, config, log = json.loads(line)
        child = os.fork()
        if child == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            faulthandler.enable()
            os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND), 2)
            try:
                serve(store, port=0, open_=True, config=Path(config))
            except BaseException:
                traceback.print_exc()
            print("died 7", flush=True)  # or whoever waits for the address would wait for ever
            os._exit(7)
        print(f"pid {child}", flush=True)


@cache
def launcher() -> Launcher:
    """One for the whole run."""
    return Launcher()


def killed_server(url: str, seed: int, moment_s: float, cluster: PostgresCluster | None) -> list[tuple[str, str]]:
    """Start a server, kill it (and the database under it) ``moment_s`` after its first acknowledgement."""
    store = url.removeprefix("sqlite:///")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config, log = folder / "server.toml", folder / "log"
        config.write_text("[server]\ndrives_a_day = 1000000\n")
        address, process = launcher().start(store, config, log)
        traffic = Traffic(address, seed, folder)
        try:
            if not traffic.begun.wait(60.0):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process, 0)
                    raise SystemExit(f"kill {seed}: nothing was acknowledged: {log.read_text()[-2000:]}")
                raise SystemExit(f"kill {seed}: the server ended by itself: {log.read_text()[-4000:]}")
            time.sleep(moment_s)
            if cluster is not None:
                cluster.stop(crash=True)
            os.kill(process, 0)  # ProcessLookupError: it ended by itself
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
            traffic.end()
        if "Traceback" in (folder / "log").read_text():
            raise SystemExit(f"kill {seed}: the server stumbled: {(folder / 'log').read_text()[-4000:]}")
    if cluster is not None:
        cluster.start()
    return traffic.acknowledged


if __name__ == "__main__":
    launch()
