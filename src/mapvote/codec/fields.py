"""Attributes of points <-> bytes: columns of numbers by their names. One form for tiles of a map and for ballots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from mapvote.codec.planes import raw_plane
from mapvote.core.types import MapvoteError

FIELD_TYPES = ("|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8")

_FIELDS = msgspec.msgpack.Decoder(dict[str, tuple[str, bytes]])


def pack_fields(fields: Mapping[str, NDArray[Any]]) -> bytes:
    """Columns (n,) as a msgpack map of name to (type, little-endian values), in their order: equal fields, equal
    bytes."""
    columns = {name: (c.dtype.newbyteorder("<").str, c) for name, c in fields.items()}
    return msgspec.msgpack.encode({name: (kind, raw_plane(c, kind)) for name, (kind, c) in columns.items()})


def unpack_fields(raw: bytes, n: int, part: str) -> dict[str, NDArray[Any]]:
    """The inverse, of ``n`` points; MapvoteError, which names the ``part``, if it is damaged or not of so many."""
    fields = {}
    for name, (kind, values) in decode_fields(raw, part).items():
        if kind not in FIELD_TYPES:
            raise MapvoteError(f"{part}: {name} has the type {kind[:20]!r}, which no field has; fetch or send it again")
        if len(values) != n * np.dtype(kind).itemsize:
            held = f"{name} has {len(values)} bytes, but there are {n} points"
            raise MapvoteError(f"{part}: {held}; fetch or send it again")
        fields[name] = np.frombuffer(values, dtype=kind)
    return fields


def decode_fields(raw: bytes, part: str) -> dict[str, tuple[str, bytes]]:
    """Type and values of each column; MapvoteError, which names the ``part``, if it is damaged."""
    try:
        return _FIELDS.decode(raw)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MapvoteError(f"{part} holds no fields of points ({error}); fetch or send it again") from error
