"""The manifest of a version: which planes its tiles consist of, by hash.

A version is one manifest and planes, wherever it is: a server sends them, a client keeps them as they came, a map
folder holds them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Annotated

import msgspec

from mapvote.core.grid import Lattice

DIGESTS = 1 << 256
"""Sums of hashes are taken modulo this."""


PlaneHash = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}\Z")]
"""A SHA-256 in hex. A plane's digest becomes the name of its file, so a decoder takes no other text."""
TileKey = Annotated[str, msgspec.Meta(pattern=r"^-?[0-9]{1,7},-?[0-9]{1,7}\Z")]
"""Row and column of a tile: "row,col"."""


class TileHashes(msgspec.Struct, frozen=True, omit_defaults=True, eq=False):
    """SHA-256 of the planes of one tile; None for a plane that it has not."""

    points: PlaneHash
    """The digest that ballots name as their base."""
    ground: PlaneHash
    free: PlaneHash | None
    memory: PlaneHash | None = None
    """The server's memory of the tile. It is no part of the map: tiles that differ only in it are equal."""
    fields: PlaneHash | None = None
    """Attributes of the points."""

    @classmethod
    def none(cls) -> TileHashes:
        """The hashes of a tile that a version no longer has."""
        return cls("", "", None)

    def shown(self) -> TileHashes:
        """Without the memory, which no server tells."""
        return msgspec.structs.replace(self, memory=None)

    def planes(self) -> dict[str, str]:
        """The planes that there are, by name."""
        named = {name: getattr(self, name) for name in self.__struct_fields__}
        return {name: digest for name, digest in named.items() if digest}

    def _map(self) -> tuple[str | None, ...]:
        return self.points, self.ground, self.free, self.fields

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TileHashes) and self._map() == other._map()

    def __ne__(self, other: object) -> bool:
        """A Struct without msgspec's equality compares by identity here, not by :meth:`__eq__`."""
        return not self == other

    def __hash__(self) -> int:
        return hash(self._map())


class Manifest(msgspec.Struct, omit_defaults=True, kw_only=True):
    """One version of a map, or what changed of it since another; tiles by "row,col"."""

    map_id: str
    version: int
    lattice: Lattice
    georeference: dict[str, str]
    tiles: dict[TileKey, TileHashes]
    digest: str
    """Digest of all tiles of the version, also where only some are listed: 64 hexadecimal digits of
    :func:`digests_of`."""
    removed: list[TileKey]
    """Tiles that the other version has and this one has not."""
    fields_digest: str = ""
    """Digest of the fields of their points; "" where there are none."""

    def is_whole(self) -> bool:
        """Whether these are all tiles of the version, and as the server has them."""
        return (self.digest, self.fields_digest) == shown(*digests_of(self.tiles.items()))

    def tag(self, since: int | None = None) -> str:
        """The ETag of the manifest, or of what changed ``since`` a version: of its number and what it consists of. A
        server that was set up anew has the numbers of the old one, and another map."""
        digests = f"{self.digest[:16]}-{self.fields_digest[:16]}"
        return f'"{self.version}-{digests}"' if since is None else f'"{self.version}-{since}-{digests}"'

    def followed_by(self, since: Manifest) -> Manifest:
        """The newer manifest: this one with the changes in ``since``."""
        tiles = {key: hashes for key, hashes in self.tiles.items() if key not in since.removed} | since.tiles
        return msgspec.structs.replace(since, tiles=tiles, removed=[])


def digests_of(tiles: Iterable[tuple[str, TileHashes]]) -> tuple[int, int]:
    """Two digests: of the tiles by "row,col", and of the fields of the tiles that have any. Each is the sum, modulo
    :data:`DIGESTS`, of one SHA-256 per tile, over its key and its planes' hashes ("-" for none).

    A client that updates its manifest by changes can check it against the server's digest. The server updates the
    digest at little cost: sums of changed tiles are added and subtracted.
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
