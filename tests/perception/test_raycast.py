"""What a scan saw and passed through, against a brute-force walk along every ray in 3D."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core.grid import CELL_SIZE, Grid, Lattice
from mapvote.core.types import Reference
from mapvote.perception.raycast import CLEARANCE_M, FANS, Sight, cast_rays, find_obstacles

SIDE = 61
"""Cells of the small window: 18.3 m."""


def flat_reference(ground: np.ndarray | None = None) -> Reference:
    """An empty map over a window of its own, with ground at ``ground`` (rows, cols) metres, 0 by default."""
    grid = Grid(Lattice(0.05, -0.1), -30, -30, SIDE, SIDE)
    ground_z = np.zeros(grid.shape, np.float32) if ground is None else ground.astype(np.float32)
    empty = np.zeros(grid.shape, np.uint64)
    none = np.full(grid.shape, np.inf, np.float32)
    base = np.floor(ground_z / CELL_SIZE).astype(np.int32)
    return Reference(grid, ground_z, base, empty, np.zeros(grid.shape, np.int32), none, -none, None)


def brute_passed(points: np.ndarray, origin: np.ndarray, reference: Reference) -> tuple[np.ndarray, np.ndarray]:
    """(surely, possibly) passed words by steps of 2 mm along every ray: voxels entered deeply, and touched at all."""
    grid = reference.grid
    surely = np.zeros(grid.shape, np.uint64)
    possibly = np.zeros(grid.shape, np.uint64)
    for point in points:
        length = float(np.linalg.norm(point - origin))
        for slack, words in ((-0.004, surely), (0.004, possibly)):
            s = np.arange(0.0, length - CLEARANCE_M + slack, 0.002)[:, None]
            on_ray = origin + s * (point - origin) / length
            for nudge in [0.0] if slack < 0 else [-slack, 0.0, slack]:
                for axis in range(3) if nudge else [0]:
                    moved = on_ray.copy()
                    moved[:, axis] += nudge
                    rows, cols, inside = grid.indices_of(moved)
                    r, c = rows[inside], cols[inside]
                    bit = np.floor(moved[inside, 2] / CELL_SIZE).astype(int) - reference.base[r, c]
                    ok = (bit >= 0) & (bit < 63)
                    np.bitwise_or.at(words, (r[ok], c[ok]), np.uint64(1) << bit[ok].astype(np.uint64))
    return surely, possibly


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 12), st.booleans())
def test_passed_words_agree_with_a_brute_force_walk_in_3d(seed: int, n: int, hilly: bool) -> None:
    rng = np.random.default_rng(seed)
    ground = rng.uniform(-1.0, 1.0, (SIDE, SIDE)) if hilly else None
    reference = flat_reference(ground)
    origin = np.array([rng.uniform(-1, 1), rng.uniform(-1, 1), 1.8])
    fans = 128 * rng.choice(FANS // 128, n, replace=False)  # one ray to a fan, of those that mark from the sensor on
    azimuth = (fans + 0.5) * 2 * np.pi / FANS
    reach = rng.uniform(0.8, 15.0, n)
    flat = np.column_stack([np.cos(azimuth), np.sin(azimuth)]) * reach[:, None]
    points = origin + np.column_stack([flat, reach * np.tan(rng.uniform(-0.5, 0.5, n))])
    view = cast_rays(points, origin, np.ones(n, bool), np.zeros(n, bool), reference)
    surely, possibly = brute_passed(points, origin, reference)
    assert not (view.passed & ~possibly).any(), "a voxel was called passed that no ray came near"
    assert not (surely & ~view.passed).any(), "a voxel was missed that a ray went through"


@given(st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_first_hit_sees_up_to_the_nearest_obstacle_and_farthest_return_beyond_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    reference, origin = flat_reference(), np.array([0.0, 0.0, 1.8])
    angle = rng.uniform(0, 2 * np.pi)
    near, far = rng.uniform(1.0, 4.0), rng.uniform(5.0, 8.0)
    direction = np.array([np.cos(angle), np.sin(angle)])
    points = np.array([[*(near * direction), 1.2], [*(far * direction), 2.4]])  # a fence, and a wall seen above it
    view = cast_rays(points, origin, np.array([True, True]), np.zeros(2, bool), reference)
    grid = reference.grid

    def sight(distance: float) -> int:
        rows, cols, _ = grid.indices_of(np.array([distance * direction]))
        return int(view.sight[rows[0], cols[0]])

    assert sight(near) == sight(0.5 * near) == Sight.CLEAR
    assert sight(0.5 * (near + far) + 0.3) == Sight.BEHIND
    assert sight(far + 0.6) == Sight.BEYOND
    assert (view.sight == Sight.NEVER).sum() > 0.9 * view.sight.size


def test_a_moving_object_occludes_but_does_not_occupy() -> None:
    reference, origin = flat_reference(), np.array([0.0, 0.0, 1.8])
    points = np.array([[3.0, 0.0, 1.0], [3.0, 0.001, 1.1], [6.0, 0.0, 0.0]])
    moving = np.array([True, True, False])
    view = cast_rays(points, origin, np.array([True, True, False]), moving, reference)
    assert not view.counts.any()
    assert not view.hit.any()
    rows, cols, _ = reference.grid.indices_of(np.array([[4.5, 0.0], [2.0, 0.0]]))
    assert view.sight[rows[0], cols[0]] == Sight.BEHIND
    assert view.sight[rows[1], cols[1]] == Sight.CLEAR


def test_a_ray_to_the_ground_proves_the_air_above_it_empty() -> None:
    reference, origin = flat_reference(), np.array([0.0, 0.0, 1.8])
    view = cast_rays(np.array([[8.0, 0.0, 0.0]]), origin, np.array([False]), np.array([False]), reference)
    rows, cols, _ = reference.grid.indices_of(np.array([[4.0, 0.0]]))
    assert view.passed[rows[0], cols[0]] == 0b1100  # from 0.91 m down to 0.84 m across the cell: voxels 3 and 2
    assert view.counts.sum() == 0


def test_points_are_obstacles_above_the_margin_and_outside_the_window_nothing() -> None:
    points = np.array([[1.0, 1.0, 0.29], [1.0, 1.0, 0.31], [40.0, 0.0, 3.0]])
    obstacle, cell = find_obstacles(points, flat_reference())
    assert obstacle.tolist() == [False, True, False]
    assert cell[0] == cell[1] >= 0
    assert cell[2] == -1


def test_ranges_on_the_edge_of_a_sorting_step_are_sorted_all_the_same() -> None:
    reach = np.concatenate([np.arange(1, 60) * 0.25 + e for e in (-1e-9, 0.0, 1e-9)])
    points = np.column_stack([reach, np.full(len(reach), 1e-5), np.full(len(reach), 1.8)])
    view = cast_rays(
        points, np.array([0.0, 0.0, 1.8]), np.ones(len(reach), bool), np.zeros(len(reach), bool), flat_reference()
    )
    assert view.counts.sum() > 0
