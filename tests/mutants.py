"""Ballots that no honest vehicle sends: bytes flipped, fields absurd, planes that explode when unpacked."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np

from mapvote.codec.planes import zstd

ABSURD: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    2**31,
    2**63 - 1,
    2**64 - 1,
    -(2**63),
    1e308,
    float("nan"),
    float("inf"),
    "",
    "../../etc/passwd",
    "\x00",
    "ü" * 70_000,
    b"",
    b"\xff" * 64,
    [],
    {},
    [[[[[]]]]],
    {"a": {"b": {"c": 1}}},
)
"""Values that replace any field."""


def bomb(size: int = 1 << 30) -> bytes:
    """A zstd frame of some 100 kB that unpacks to ``size`` zero bytes."""
    return zstd.compress(bytes(1 << 20), 1) if size <= 1 << 20 else _long_frame(size)


def _long_frame(size: int) -> bytes:
    compressor = zstd.ZstdCompressor(level=1)
    chunk = bytes(1 << 20)
    return b"".join([compressor.compress(chunk) for _ in range(size >> 20)]) + compressor.flush()


def mutants(honest: bytes, n: int, seed: int = 1) -> Iterator[bytes]:
    """``n`` damaged versions of a ballot's bytes, the same for the same seed."""
    rng = random.Random(seed)
    kinds: tuple[Callable[[bytes, random.Random], bytes], ...] = (_flip, _cut, _field, _field, _plane, _plane, _double)
    for i in range(n):
        yield kinds[i % len(kinds)](honest, rng)


def _flip(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        out[rng.randrange(len(out))] = rng.randrange(256)
    return bytes(out)


def _cut(data: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(data))
    return data[:start] if rng.random() < 0.5 else data[:start] + data[start + rng.randrange(1, 9) :]


def _double(data: bytes, rng: random.Random) -> bytes:
    return data + data[: rng.randrange(len(data))]


def _field(data: bytes, rng: random.Random) -> bytes:
    """One field, at any depth, missing, absurd or added."""
    ballot = msgspec.msgpack.decode(data)
    place = ballot if rng.random() < 0.6 or not ballot["tiles"] else rng.choice(ballot["tiles"])
    name = rng.choice(sorted(place))
    action = rng.random()
    if action < 0.2:
        del place[name]
    elif action < 0.3:
        place["a plane of the future"] = rng.choice(ABSURD)
    elif action < 0.5 and name == "tile":
        place[name] = [rng.choice((-(2**40), 2**21, 2**63 - 1)), rng.choice((0, 1.5, "0"))]
    elif action < 0.6 and name == "tiles":
        place[name] = place[name] * rng.choice((2, 5000))
    else:
        place[name] = rng.choice(ABSURD)
    return msgspec.msgpack.encode(ballot)


def _plane(data: bytes, rng: random.Random) -> bytes:
    """One plane of one tile replaced: wrong size, wrong content, a bomb, points that are no points."""
    ballot = msgspec.msgpack.decode(data)
    tile = rng.choice(ballot["tiles"])
    name = rng.choice(("states", "tally", "gone", "new_points", "fields", "free"))
    raw = [
        bytes(rng.randrange(1 << 17)),
        np.full(256 * 256, rng.randrange(5, 255), dtype=np.uint8).tobytes(),
        np.full((9, 3), np.nan, dtype=np.float32).tobytes(),
        np.full((9, 3), rng.choice((np.inf, -1e-3, 76.9, 1e30)), dtype=np.float32).tobytes(),
        rng.randbytes(256 * 256),
    ]
    choice = rng.randrange(len(raw) + 2)
    if choice < len(raw):
        tile[name] = zstd.compress(raw[choice], 1)
    elif choice == len(raw):
        tile[name] = rng.randbytes(200)
    else:
        tile[name] = _BOMB
    return msgspec.msgpack.encode(ballot)


_BOMB = _long_frame(64 << 20)
