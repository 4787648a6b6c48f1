"""Manifests as JSON. A version never changes, so each manifest is encoded once."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from mapvote.server.store.store import Store

_KEPT = 16


class Made(NamedTuple):
    """A manifest on its way out."""

    content: bytes
    """JSON."""
    tag: str
    """Its ETag."""


class Manifests:
    """The JSON of the manifests that were requested last; thread-safe."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._made: dict[tuple[int, int | None], Made] = {}

    def newest(self, asked: Sequence[None]) -> list[int]:
        """The newest version's number, for each of a batch of requests by one query."""
        return [self._store.current()] * len(asked)

    def ready(self, number: int, since: int | None) -> Made | None:
        """A manifest that was made before."""
        return self._made.get((number, since))

    def make(self, number: int, since: int | None) -> Made:
        """A version; ``since`` as in :meth:`Store.manifest`. NotFound if there is no such version."""
        with self._lock:  # of many requests for a new version, one makes it
            made = self._made.get((number, since))
            if made is None:
                manifest = self._store.manifest(number, since=since)
                made = Made(msgspec.json.encode(manifest), manifest.tag(since))
                while len(self._made) >= _KEPT:
                    del self._made[next(iter(self._made))]
                self._made[number, since] = made
        return made
