"""New points travel as their voxels and where in them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.codec.arrays import compress, pack_plane
from mapvote.codec.points import MOST_OFF_M, pack_points, unpack_points, unpack_sound_points
from mapvote.core.grid import CELL_SIZE
from mapvote.core.types import F32, MapvoteError

EDGE = float(np.nextafter(np.float32(76.8), np.float32(0.0)))
SIDE = st.one_of(st.floats(0.0, EDGE, width=32), st.sampled_from([0.0, EDGE]))
HEIGHT = st.floats(-1e5, 1e5, width=32)


def voxels(points: F32) -> np.ndarray:
    return np.floor(points.astype(np.float64) / CELL_SIZE).astype(np.int64)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(SIDE, SIDE, st.one_of(st.floats(-30.0, 60.0, width=32), HEIGHT)), max_size=40))
def test_a_point_stays_in_its_voxel_and_within_what_rounding_may_move_it_whatever_the_order(
    points: list[tuple[float, float, float]],
) -> None:
    sent = np.array(points, dtype=np.float32).reshape(-1, 3)
    found = unpack_sound_points(pack_points(sent))
    assert found.dtype == np.float32
    assert found.shape == sent.shape
    near = np.abs(sent[:, 2]) < 1e3  # beyond, float32 itself is coarser than the steps
    np.testing.assert_array_equal(voxels(found)[near], voxels(sent)[near])
    np.testing.assert_allclose(found[near], sent[near], rtol=0, atol=MOST_OFF_M + 1e-4)
    np.testing.assert_array_equal(voxels(found)[:, :2], voxels(sent)[:, :2])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_what_was_rounded_once_is_never_moved_again(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sent = rng.uniform((0.0, 0.0, -50.0), (EDGE, EDGE, 150.0), (200, 3)).astype(np.float32)
    once = unpack_points(pack_points(sent))
    assert unpack_points(pack_points(once)).tobytes() == once.tobytes()


def test_points_of_a_street_take_less_than_half_of_what_float32_takes() -> None:
    rng = np.random.default_rng(1)
    cells = np.sort(rng.choice(65536, 3000, replace=False))
    at = np.column_stack([cells % 256, cells // 256, rng.integers(0, 9, 3000)])
    sent = ((at + rng.random((3000, 3))) * CELL_SIZE).astype(np.float32)
    assert 2 * len(pack_points(sent)) < len(pack_plane(sent))


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        (bytes(8), "is no number of points"),
        (bytes(6) + b"\x20" + bytes(2), "outside its tile or not finite"),
        (bytes(4) + b"\x00\x10" + bytes(3), "outside its tile or not finite"),
        (bytes(9 * 65), "more than 64 points in one cell"),
    ],
    ids=["half", "beyond its voxel", "in the sky", "too many in a cell"],
)
def test_what_no_vehicle_wrote_is_refused(raw: bytes, why: str) -> None:
    with pytest.raises(MapvoteError, match=why):
        unpack_points(compress(raw, 1))
