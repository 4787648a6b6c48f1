"""Ballots that wait to be sent: a folder for each server and vehicle, so that none goes where it does not belong."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

from mapvote.formats.atomic import whole_file

WAITING, REFUSED = ".ballot", ".refused"


def server_folder(home: Path, url: str) -> Path:
    """Where what belongs to one server lies: its name to read, and a hash of its address."""
    name = re.sub(r"[^A-Za-z0-9.]+", "_", url.partition("://")[2].strip("/"))[:60]
    return home / "servers" / f"{name}-{hashlib.sha256(url.rstrip('/').encode()).hexdigest()[:8]}"


class Spool:
    """What waits for one server. Files are their owner's alone, and appear whole."""

    def __init__(self, home: Path, url: str) -> None:
        self._folder = server_folder(home, url) / "spool"

    def put(self, vehicle: str, drive: str, data: bytes) -> Path:
        """Keep a ballot until :meth:`sent`; one of the same drive is replaced."""
        waiting = self._folder / vehicle / f"{drive}{WAITING}"
        with whole_file(waiting, private=True) as part:
            part.write_bytes(data)
        return waiting

    def waiting(self, vehicle: str | None = None) -> Iterator[Path]:
        """Ballots that are to be sent, of one vehicle or of all."""
        yield from sorted(self._folder.glob(f"{vehicle or '*'}/*{WAITING}"))

    def sent(self, waiting: Path) -> None:
        """The server has it."""
        waiting.unlink(missing_ok=True)

    def set_aside(self, waiting: Path) -> Path:
        """The server will never take it as it is: keep it, and send it no more."""
        kept = waiting.with_suffix(REFUSED)
        os.replace(waiting, kept)
        return kept
