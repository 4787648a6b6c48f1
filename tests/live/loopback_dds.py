"""DDS between processes of this machine alone: no multicast, and a domain for each test."""

from __future__ import annotations

import fcntl
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, TypeVar

T = TypeVar("T")

LOOPBACK = (
    '<Domain id="any"><General><Interfaces><NetworkInterface name="lo"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>"
    '<Peers><Peer address="localhost"/></Peers></Discovery></Domain>'
)


_HELD: list[IO[str]] = []
"""The locks of the domains of this process."""


def own_domain() -> int:
    """A domain that no other test, and no other run on this machine, speaks in: a locked file names it until this
    process ends. ROS 2 allows 0 to 101 everywhere."""
    for domain in range(1, 101):
        file = (Path(tempfile.gettempdir()) / f"mapvote-dds-{os.getuid()}-{domain}.lock").open("w")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
            continue
        _HELD.append(file)
        return domain
    raise RuntimeError("no DDS domain is free")


def until(ask: Callable[[], T], what: str = "nothing came in a minute") -> T:
    """The result of ``ask`` as soon as it is true."""
    end = time.monotonic() + 60.0
    while not (found := ask()):
        assert time.monotonic() < end, what
        time.sleep(0.02)
    return found
