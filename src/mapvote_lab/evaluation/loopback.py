"""Vehicles vote through a real server: its own process on this machine, spoken to by HTTP alone (paper, Figure 1)."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx2

from mapvote.client import MapClient
from mapvote.codec.ballot import Ballot
from mapvote.core.point_map import PointMap
from mapvote.core.types import MapvoteError

_STOP_S = 20.0


@dataclass(frozen=True, slots=True)
class PublishedRound:
    """What a server made of a fleet's ballots."""

    updated: PointMap
    """The newest map, as a vehicle downloads it."""
    version: int
    held: str
    """Why the server held the version until the operator overrode it; "" if it did not."""


@contextmanager
def running_server(store: Path, first_map: Path, log: Path) -> Iterator[str]:
    """The URL of ``mapvote serve`` on a new ``store``, on any free port; stopped on leaving. Logs go to ``log``.

    MapvoteError with the server's last line if it does not come up.
    """
    command = [sys.executable, "-m", "mapvote", "serve", str(store), "--map", str(first_map)]
    command += ["--port", "0", "--open"]
    with log.open("w") as errors, subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True) as server:
        try:
            assert server.stdout is not None
            said = server.stdout.readline().split()
            if len(said) != 2 or said[0] != "serving":
                last = (log.read_text().splitlines() or ["it said nothing"])[-1]
                raise MapvoteError(f"the server did not start ({last}); is mapvote installed with its server extra?")
            yield said[1]
        finally:
            server.terminate()
            try:
                server.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                server.kill()


def vote_by_http(ballots: Sequence[Ballot], first_map: Path, folder: Path) -> PublishedRound:
    """Start a server, send every ballot as its vehicle would, publish, and download the newest map.

    ``folder`` keeps the store, the clients' homes and the server's log. MapvoteError if the server refuses a ballot.
    """
    folder.mkdir(parents=True, exist_ok=True)
    store = folder / "store.db"
    for old in folder.glob("store.db*"):
        old.unlink()
    with running_server(store, first_map, folder / "server.log") as url:
        for ballot in ballots:
            with MapClient(url, home=folder / ballot.vehicle) as client:
                if client.send(ballot) == "spooled":
                    raise MapvoteError(f"{url}: did not take {ballot.vehicle}'s ballot; see {folder / 'server.log'}")
        ask = {"reason": "a round of votes on this machine"}
        answer, held = httpx2.post(f"{url}/v1/publish", json=ask, timeout=120.0), ""
        if answer.status_code == 409:
            held = str(answer.json().get("detail", "for no reason given"))
            answer = httpx2.post(f"{url}/v1/publish", json={**ask, "override": True}, timeout=120.0)
        if answer.status_code != 200:
            raise MapvoteError(f"{url}: publishing failed ({answer.status_code}); see {folder / 'server.log'}")
        with MapClient(url, home=folder / "reader") as client:
            updated = client.fetch()
            return PublishedRound(updated, client.version or 0, held)
