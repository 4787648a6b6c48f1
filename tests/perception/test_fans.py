"""Fans of rays against the same rules written out in numpy: which ray is in which fan, and what each of them passes."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.core.geometry import rows_from, turn
from mapvote.core.grid import CELL_SIZE
from mapvote.perception.fans import FANS, FULL_RANGE_M, Rays, follow_rays, gather_rays, mark_passed

CLEARANCE_M = 0.45
SIDE = 151
CORNER = (-22.6, -22.9)
ORIGIN = np.array([0.13, -0.27, 1.83])


def scene(seed: int, n: int = 6000) -> tuple[np.ndarray, np.ndarray]:
    """(points (n, 3), layers of the columns' bits 0): all around, near and far, some of them high up, on a slope."""
    rng = np.random.default_rng(seed)
    azimuth, reach = rng.uniform(0, 2 * np.pi, n), rng.uniform(0.1, 40.0, n)
    up = reach * np.tan(rng.uniform(-0.4, 0.6, n))
    points = ORIGIN + np.column_stack([reach * np.cos(azimuth), reach * np.sin(azimuth), up])
    base = (np.arange(SIDE)[:, None] // 30 + np.arange(SIDE)[None] // 50 - 4 + rng.integers(0, 2, (SIDE, SIDE))).astype(
        np.int32
    )
    return points, base


def plain_rays(points: np.ndarray) -> Rays:
    x, y, z = (points - ORIGIN).astype(np.float32).T
    h, layer, clearance = np.sqrt(x * x + y * y), np.float32(CELL_SIZE), np.float32(CLEARANCE_M)
    azimuth = np.array([turn.py_func(a, b) for a, b in zip(x, y, strict=True)], dtype=np.float32)
    fan = np.minimum((azimuth * np.float32(FANS)).astype(np.int32), FANS - 1)
    return Rays(h, x / h, y / h, z / (layer * h), h - clearance * h / np.sqrt(h * h + z * z), fan)


def marks_from(fan: int) -> float:
    """Every second fan from 25 m on, every fourth from half of it on, and so on, down to a cell."""
    metres = FULL_RANGE_M
    while fan % 2 == 0 and metres > CELL_SIZE:
        metres, fan = metres / 2, fan // 2
    return 0.0 if metres <= CELL_SIZE else metres


def kept(rays: Rays, fan: int) -> np.ndarray:
    """(n,) the rays of a fan that may come to a cell which it marks: a cell is 1.42 sides across."""
    far_enough = rays.stop > np.float32(marks_from(fan) - 1.5 * CELL_SIZE)
    return np.asarray(far_enough & (rays.fan == fan) & (rays.reach >= CELL_SIZE))


def mean_direction(rays: Rays, fan: int) -> np.ndarray:
    """(2,) of the rays that are kept; the fan's middle without any."""
    mine = kept(rays, fan)
    azimuth = (fan + 0.5) * 2.0 * np.pi / FANS
    together = np.array([rays.x[mine].sum(dtype=np.float64), rays.y[mine].sum(dtype=np.float64)])
    return together / np.linalg.norm(together) if mine.any() else np.array([np.cos(azimuth), np.sin(azimuth)])


def crossed(x: float, y: float, dx: float, dy: float, start: float, end: float) -> list[tuple[int, int, float, float]]:
    """(row, col, where entered, where left) of the cells from the one in which ``start`` lies to the one of ``end``."""
    steps = np.arange(-2 * SIDE, 2 * SIDE)
    at = np.sort(np.concatenate([(steps - x) / dx, (steps - y) / dy]) * CELL_SIZE)
    middle = 0.5 * (at[:-1] + at[1:]) / CELL_SIZE
    rows, cols = np.floor(y + dy * middle).astype(int), np.floor(x + dx * middle).astype(int)
    found = []
    for r, c, enter, leave in zip(rows, cols, at[:-1], at[1:], strict=True):
        if leave > start and max(enter, 0.0) < end:
            if not (0 <= r < SIDE and 0 <= c < SIDE):
                break
            found.append((r, c, max(enter, 0.0), leave))
    return found


def plain_passed(rays: Rays, base: np.ndarray) -> np.ndarray:
    """Words of what every ray passes, cell by cell and ray by ray."""
    passed = np.zeros(base.shape, np.uint64)
    layer = int(np.floor(ORIGIN[2] / CELL_SIZE))
    height = np.float32(ORIGIN[2] / CELL_SIZE - layer)
    x, y = (ORIGIN[0] - CORNER[0]) / CELL_SIZE, (ORIGIN[1] - CORNER[1]) / CELL_SIZE
    for fan in range(FANS):
        mine = np.flatnonzero((rays.fan == fan) & (rays.reach >= CELL_SIZE))
        if not len(mine) or rays.stop[mine].max() <= marks_from(fan):
            continue
        dx, dy = mean_direction(rays, fan)
        for r, c, enter, leave in crossed(x, y, dx, dy, marks_from(fan), float(rays.stop[mine].max())):
            for k in mine[rays.stop[mine] > np.float32(enter)]:
                ends = np.float32(enter), min(np.float32(leave), rays.stop[k])
                a, b = (int(np.floor(height + rays.slope[k] * t)) - int(base[r, c]) + layer for t in ends)
                low, high = (min(max(bit, 0), 63) for bit in (min(a, b), max(a, b) + 1))
                passed[r, c] |= np.uint64((1 << high) - (1 << low))
    return passed


@pytest.mark.parametrize("seed", range(2))
def test_rays_are_gathered_by_azimuth_and_only_those_that_reach_where_their_fan_marks(seed: int) -> None:
    points, _ = scene(seed)
    rays, plain = follow_rays(rows_from(points, ORIGIN), CLEARANCE_M), plain_rays(points)
    for found, wanted in zip(rays, plain, strict=True):
        np.testing.assert_array_equal(found, wanted)
    fans = gather_rays(rays)
    for fan in range(0, FANS, 7):
        mine = (plain.fan == fan) & (plain.reach >= CELL_SIZE)
        stops = fans.stop[fans.first[fan] : fans.last[fan]]
        assert set(plain.stop[mine & (plain.stop > marks_from(fan))]) <= set(stops) <= set(plain.stop[mine])
        np.testing.assert_allclose(fans.direction[fan], mean_direction(plain, fan), atol=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_passed_cells_are_those_that_the_rule_gives_for_each_cell_and_ray(seed: int) -> None:
    points, base = scene(seed, 1500)
    passed = np.zeros(base.size, np.uint64)
    mark_passed(gather_rays(follow_rays(rows_from(points, ORIGIN), CLEARANCE_M)), ORIGIN, CORNER, base, passed)
    wanted = plain_passed(plain_rays(points), base)
    np.testing.assert_array_equal(passed.reshape(base.shape), wanted)
    assert (wanted >> np.uint64(40)).any(), "the upper halves of the words are looked at too"


def test_a_ray_proves_from_a_cells_length_on_to_an_edge_but_not_behind_it_and_marks_where_its_fan_does() -> None:
    def passed(reach_m: float, stop_m: float, fan: int, x0: float = 0.05) -> int:
        """How many cells in a row."""
        reach, x, y, slope, stop = (np.array([v], np.float32) for v in (reach_m, 1.0, 0.0, 0.0, stop_m))
        words = np.zeros(100, np.uint64)
        rays = gather_rays(Rays(reach, x, y, slope, stop, np.full(1, fan, np.int32)))
        mark_passed(rays, np.array([x0, 0.15, 0.75]), (0.0, 0.0), np.zeros((1, 100), np.int32), words)
        assert set(words[words != 0].tolist()) <= {0b100}
        return int((words != 0).sum())

    side = float(np.float32(CELL_SIZE))
    assert passed(9.0, 2 * CELL_SIZE, 0, x0=0.0) == 2
    assert (passed(side, side, 0), passed(side - 1e-4, side, 0)) == (2, 0)
    assert (passed(29.0, FULL_RANGE_M, 1), passed(29.0, FULL_RANGE_M + 0.01, 1)) == (0, 1)
