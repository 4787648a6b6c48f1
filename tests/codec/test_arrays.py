"""A plane unpacked into an array: the same bytes as any other way, and nothing that is damaged or too large."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mapvote.codec.arrays import unpack_bytes, unpack_into, zstd
from mapvote.core.types import MapvoteError

SIZE = 1000


def unsaid(data: bytes) -> bytes:
    """A frame that does not say how large it is."""
    packer = zstd.ZstdCompressor()
    return packer.compress(data) + packer.flush()


@pytest.mark.parametrize("pack", [zstd.compress, unsaid])
def test_what_is_unpacked_into_a_plane_is_what_was_packed(pack: Callable[[bytes], bytes]) -> None:
    data = np.random.default_rng(1).integers(0, 6, SIZE, dtype=np.uint8).tobytes()
    plane = np.empty(SIZE, dtype=np.uint8)
    unpack_into(pack(data), plane, "plane")
    assert plane.tobytes() == unpack_bytes(pack(data), SIZE, "plane") == data


@pytest.mark.parametrize(
    "bad",
    [
        b"",
        b"no frame",
        zstd.compress(bytes(SIZE))[:-2],
        zstd.compress(bytes(SIZE - 1)),
        zstd.compress(bytes(SIZE + 1)),
        zstd.compress(bytes(1 << 24)),
        unsaid(bytes(SIZE - 1)),
        unsaid(bytes(1 << 24)),
    ],
)
def test_a_damaged_frame_or_one_of_another_size_is_refused(bad: bytes) -> None:
    with pytest.raises(MapvoteError, match=r"^plane "):
        unpack_into(bad, np.empty(SIZE, dtype=np.uint8), "plane")
