"""The manifest of a version: which planes its tiles consist of. A server sends it, and a client keeps it as it came."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Protocol

import msgspec

DIGESTS = 1 << 256
"""Sums of hashes are taken modulo this."""


class Hashes(Protocol):
    """SHA-256 of the planes of one tile; None for a plane that it has not."""

    @property
    def points(self) -> str: ...
    @property
    def ground(self) -> str: ...
    @property
    def free(self) -> str | None: ...
    @property
    def fields(self) -> str | None:
        """Of what the points carry besides their place."""


class PlaneHashes(msgspec.Struct, frozen=True, omit_defaults=True):
    """One tile of a manifest, see :class:`Hashes`."""

    points: str
    ground: str
    free: str | None
    fields: str | None = None

    def all(self) -> list[str]:
        """Those of the planes that there are."""
        return [digest for digest in (self.points, self.ground, self.free, self.fields) if digest is not None]


class Corner(msgspec.Struct, frozen=True):
    """Where the lattice of cells begins, map metres."""

    x0: float
    y0: float


class Manifest(msgspec.Struct, omit_defaults=True):
    """One version of a map, or what changed of it since another; tiles by "row,col"."""

    map_id: str
    version: int
    lattice: Corner
    georeference: dict[str, str]
    tiles: dict[str, PlaneHashes]
    digest: str
    """Of all tiles of the version, also where only some are listed: 64 hexadecimal digits of :func:`digests_of`."""
    removed: list[str]
    """Tiles that the other version has and this one has not."""
    fields_digest: str = ""
    """Of the fields of their points; "" where there are none."""

    def is_whole(self) -> bool:
        """Whether these are all tiles of the version, and as the server has them."""
        return (self.digest, self.fields_digest) == shown(*digests_of(self.tiles.items()))

    def tag(self, since: int | None = None) -> str:
        """The ETag of the manifest, or of what changed ``since`` a version: of its number and what it consists of. A
        server that was set up anew has the numbers of the old one, and another map."""
        told = f"{self.digest[:16]}-{self.fields_digest[:16]}"
        return f'"{self.version}-{told}"' if since is None else f'"{self.version}-{since}-{told}"'

    def followed_by(self, since: Manifest) -> Manifest:
        """The newer manifest: this one with the changes in ``since``."""
        tiles = {key: hashes for key, hashes in self.tiles.items() if key not in since.removed} | since.tiles
        return msgspec.structs.replace(since, tiles=tiles, removed=[])


def digests_of(tiles: Iterable[tuple[str, Hashes]]) -> tuple[int, int]:
    """Of tiles by "row,col", and of the fields of those that have any: the sum, modulo :data:`DIGESTS`, of a SHA-256
    for each tile, of its key and its planes' hashes, "-" for none.

    Who keeps a manifest up to date by what changed can tell whether it still is the server's; so can the server, at
    little cost: sums of what changed can be added and taken away.
    """
    whole = fields = 0
    for key, h in tiles:
        whole += _sum(key, h.points, h.ground, h.free)
        fields += 0 if h.fields is None else _sum(key, h.fields)
    return whole % DIGESTS, fields % DIGESTS


def shown(tiles: int, fields: int) -> tuple[str, str]:
    """:func:`digests_of` as manifests have them; "" where no tile has fields."""
    return f"{tiles:064x}", f"{fields:064x}" if fields else ""


def _sum(key: str, *planes: str | None) -> int:
    line = " ".join([key.replace(",", " "), *(plane or "-" for plane in planes)])
    return int.from_bytes(hashlib.sha256(line.encode()).digest())
