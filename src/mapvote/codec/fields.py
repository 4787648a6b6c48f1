"""Fields of a tile's points <-> bytes: columns of numbers by their names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from mapvote.codec.arrays import raw_plane
from mapvote.core.types import MapvoteError

FIELD_TYPES = ("|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8")

_FIELDS = msgspec.msgpack.Decoder(dict[str, tuple[str, bytes]])


def pack_fields(fields: Mapping[str, NDArray[Any]]) -> bytes:
    """Columns (n,) as a msgpack map of name to (type, little-endian values), in their order: equal fields, equal
    bytes."""
    return msgspec.msgpack.encode({name: (kind_of(c), raw_plane(c, kind_of(c))) for name, c in fields.items()})


def unpack_fields(raw: bytes, n: int, what: str) -> dict[str, NDArray[Any]]:
    """The inverse, of ``n`` points; MapvoteError, by the name of ``what``, if it is damaged or not of so many."""
    fields = {}
    for name, (kind, values) in _decoded(raw, what).items():
        check_kind(kind, f"{what}: {name}")
        if len(values) != n * np.dtype(kind).itemsize:
            raise MapvoteError(f"{what}: {name} has {len(values)} bytes, but there are {n} points; fetch it again")
        fields[name] = np.frombuffer(values, dtype=kind)
    return fields


def field_names(raw: bytes, what: str) -> list[str]:
    """Of packed fields; MapvoteError if the bytes are no such fields."""
    return list(_decoded(raw, what))


def _decoded(raw: bytes, what: str) -> dict[str, tuple[str, bytes]]:
    try:
        return _FIELDS.decode(raw)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MapvoteError(f"{what}: no fields of points ({error}); fetch it again") from error


def kind_of(column: NDArray[Any]) -> str:
    """The type of a column's values as it is written: "<f4", "|u1"."""
    return column.dtype.newbyteorder("<").str


def check_kind(kind: str, what: str) -> None:
    """MapvoteError for what is no type of a field."""
    if kind not in FIELD_TYPES:
        raise MapvoteError(f"{what}: of type {kind[:20]!r}, which no field has; fetch it again")
