"""Many planes unpacked in one call: the same bytes as one by one, and nothing that is damaged or too large."""

from __future__ import annotations

import numpy as np
import pytest
from backports import zstd

from mapvote.codec.arrays import unpack_bytes, unpack_frames
from mapvote.core.types import MapvoteError

SIZE = 1000


def unsaid(data: bytes) -> bytes:
    """A frame that does not say how large it is."""
    packer = zstd.ZstdCompressor()
    return packer.compress(data) + packer.flush()


@pytest.mark.parametrize("n", [0, 1, 32, 33, 100])
def test_as_one_by_one(n: int) -> None:
    rng = np.random.default_rng(n)
    planes = [rng.integers(0, 6, SIZE, dtype=np.uint8).tobytes() for _ in range(n)]
    frames = [unsaid(plane) if i % 7 == 3 else zstd.compress(plane, 19) for i, plane in enumerate(planes)]
    found = unpack_frames(frames, SIZE, "plane")
    assert found.shape == (n, SIZE)
    assert [row.tobytes() for row in found] == [unpack_bytes(frame, SIZE, "plane") for frame in frames] == planes


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
        unpack_frames([zstd.compress(bytes(SIZE)), bad], SIZE, "plane")
