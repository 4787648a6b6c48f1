"""Manifests as JSON. A version never changes, so each manifest is encoded once."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec

from mapvote.codec.ballot import tile_key
from mapvote.codec.tile_file import manifest_tag
from mapvote.server.store.store import Manifest, Store

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
                tag = manifest_tag(number, since, (manifest.digest, manifest.fields_digest))
                made = Made(msgspec.json.encode(_as_json(manifest)), tag)
                while len(self._made) >= _KEPT:
                    del self._made[next(iter(self._made))]
                self._made[number, since] = made
        return made


def _as_json(manifest: Manifest) -> dict[str, Any]:
    tiles = {
        tile_key(index): {"points": h.points, "ground": h.ground, "free": h.free}
        | ({"fields": h.fields} if h.fields is not None else {})
        for index, h in manifest.tiles.items()
    }
    fields = {"fields_digest": manifest.fields_digest} if manifest.fields_digest else {}
    return {
        "map_id": manifest.map_id,
        "version": manifest.version,
        "lattice": {"x0": manifest.lattice.x0, "y0": manifest.lattice.y0},
        "georeference": dict(manifest.georeference),
        "tiles": tiles,
        "digest": manifest.digest,
        "removed": [tile_key(index) for index in manifest.removed],
    } | fields
