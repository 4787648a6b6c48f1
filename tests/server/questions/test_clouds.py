"""Levels of detail: each point once, coarse first, and what comes back from the wire lies where it was."""

from __future__ import annotations

from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hand_made import make_map, make_tile, two_walls, wall
from mapvote.config import FuseSettings
from mapvote.core.types import F32
from mapvote.shapes.packed_cloud import N_LEVELS, SIDE_M, SPACINGS_M, Levels, make_levels
from mapvote_server.questions import clouds
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.rollback import rollback
from stores import NewStore, vote_gone

GROUND = np.full((256, 256), 1.0, dtype=np.float32)


def scattered(n: int, seed: int = 1) -> F32:
    return np.random.default_rng(seed).uniform((0, 0, 0), (76.7, 76.7, 12.0), (n, 3)).astype(np.float32)


def unpacked(levels: Levels) -> np.ndarray:
    """(n, 3) metres of all levels, as the page reads them."""
    out = []
    for level in range(N_LEVELS):
        data = levels.part(level)
        n, z0, step = (np.frombuffer(data, dtype, 1, at)[0] for dtype, at in (("<u4", 4), ("<f4", 8), ("<f4", 12)))
        places = np.frombuffer(data, "<u2", offset=16).reshape(n, 4).astype(np.float64)
        out.append(np.column_stack([places[:, :2] * SIDE_M / 65535, places[:, 2] * step + z0]))
    return np.concatenate(out)


@given(st.integers(0, 400), st.integers(0, 5))
def test_every_point_is_in_exactly_one_level_and_where_it_was(n: int, seed: int) -> None:
    points = scattered(n, seed)
    got = unpacked(make_levels(points, GROUND))
    assert len(got) == n
    if n:
        apart = np.abs(got[:, None] - points[None]).max(axis=2)
        assert max(apart.min(axis=0).max(), apart.min(axis=1).max()) < 0.0015


def test_no_two_points_of_the_coarser_levels_share_a_voxel() -> None:
    levels = make_levels(scattered(30_000), GROUND)
    places = levels.packed.astype(np.float64)
    xyz = np.column_stack([places[:, :2] * SIDE_M / 65535, places[:, 2] * levels.z_step_m])
    for level, size in enumerate(SPACINGS_M):
        voxels = np.floor((xyz[: levels.ends[level]] + 1e-3) / size)
        assert len(np.unique(voxels, axis=0)) > 0.97 * len(voxels), "but for what rounding moves over a border"
    assert (np.diff(levels.ends) >= 0).all()


def test_heights_are_told_above_the_ground() -> None:
    levels = make_levels(np.array([[10, 10, 4.5]], dtype=np.float32), GROUND)
    assert levels.packed[0, 3] / 100 - 10 == pytest.approx(3.5)


def test_the_same_tile_has_the_same_levels_on_every_run() -> None:
    first, again = (make_levels(scattered(5000), GROUND) for _ in range(2))
    assert [first.part(i) for i in range(N_LEVELS)] == [again.part(i) for i in range(N_LEVELS)]


@pytest.mark.parametrize("most", [0, 500, 5000, 40_000])
def test_the_coarse_part_alone_is_made_of_the_same_points_as_the_coarse_part_of_all(most: int) -> None:
    points = scattered(30_000)
    whole, coarse = make_levels(points, GROUND), make_levels(points, GROUND, most)
    assert len(coarse.packed) == min(max(most, whole.ends[0]), 30_000)
    assert coarse.ends.tolist() == whole.ends.tolist()
    finest = int(np.searchsorted(whole.ends, len(coarse.packed), side="right")) - 1
    both = [part.packed[: whole.ends[finest], :2].tolist() for part in (whole, coarse)]
    assert sorted(both[0]) == sorted(both[1])


def test_the_overview_of_a_version_makes_only_the_tiles_that_the_last_one_did_not_have(new_store: NewStore) -> None:
    wide = wall([(10, col) for col in range(10, 20)], [0.05, 0.45, 0.75, 1.05])
    street = make_map({(0, 0): two_walls().tiles[0, 0], (0, 1): make_tile(wide, index=(0, 1))})
    store = new_store(street, Policy(fuse=FuseSettings(max_deleted_share=1.0)))
    kept = clouds.Clouds(store)
    with mock.patch.object(clouds, "make_levels", wraps=make_levels) as made:
        first = kept.overview(1)
        alike = made.call_count
        vote_gone(store)
        assert publish(store).published
        second = kept.overview(2)
        assert (alike, made.call_count) == (2, 3)
        rollback(store, 1)
        assert kept.overview(3) == first
        assert made.call_count == 4
    assert [clouds.Clouds(store).overview(number) for number in (1, 2, 3)] == [first, second, first]
