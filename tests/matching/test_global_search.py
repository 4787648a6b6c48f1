"""The search of the whole map by what stands in a scan: the fast way, against the same rule place by place."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.config import Settings
from mapvote.core.point_map import PointMap, has_open_ground, map_from_points
from mapvote.core.types import F64, U8, U32, MapvoteError, Scan
from mapvote.matching.global_search import (
    MARGIN,
    CoarseMap,
    GlobalSearch,
    GlobalSearchNumbers,
    correlate,
    highest,
    laid_out,
)


def street() -> PointMap:
    """Ground of 100 m by 100 m with a house, a wall and some poles on it; seeded."""
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(0, 100, (60_000, 2)), np.zeros(60_000)])
    house = rng.uniform((20.0, 30.0, 0.0), (34.0, 41.0, 8.0), (4_000, 3))
    wall = rng.uniform((0.0, 70.0, 0.0), (90.0, 70.4, 3.0), (4_000, 3))
    poles = np.repeat(rng.uniform(0, 100, (40, 2)), 60, axis=0)
    poles = np.column_stack([poles, np.tile(np.linspace(0.0, 5.9, 60), 40)])
    return map_from_points(np.concatenate([ground, house, wall, poles]))


@pytest.fixture(scope="module")
def layout() -> CoarseMap:
    return laid_out(street())


def dilated(words: U32) -> U32:
    out = np.zeros_like(words)
    rows, cols = words.shape
    for r in range(rows):
        for c in range(cols):
            near = np.bitwise_or.reduce(words[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2], axis=None)
            out[r, c] = near | near << np.uint32(1) | near >> np.uint32(1)
    return out


def plainly(lay: CoarseMap, wide: U32, xy: F64, bits: U32, yaw: float, hopeless: int, first: int) -> U8:
    """(places,) Olson's correlation, place by place and point by point."""
    c, s = np.cos(yaw), np.sin(yaw)
    dr = np.floor(s * xy[:, 0] + c * xy[:, 1] + 0.5).astype(int)
    dc = np.floor(c * xy[:, 0] - s * xy[:, 1] + 0.5).astype(int)
    out = np.zeros(len(lay.rows), dtype=np.uint8)
    for p, (row, col) in enumerate(zip(lay.rows, lay.cols, strict=True)):
        r, k = row + dr, col + dc
        inside = (r >= 0) & (r < wide.shape[0]) & (k >= 0) & (k < wide.shape[1])
        met = np.zeros(len(xy), dtype=int)
        met[inside] = wide[r[inside], k[inside]] >> bits[inside] & np.uint32(1)
        out[p] = met.sum() if met[:first].sum() > hopeless else 0
    return out


@settings(max_examples=4)
@given(st.integers(0, 2**32 - 1), st.integers(0, 3))
def test_every_place_is_scored_as_if_it_were_asked_alone(layout: CoarseMap, seed: int, hopeless: int) -> None:
    rng = np.random.default_rng(seed)
    xy, bits = rng.uniform(-31.0, 31.0, (90, 2)), rng.integers(0, 4, 90).astype(np.uint32)
    yaws = rng.uniform(0.0, 2.0 * np.pi, 2)
    cols = layout.cols // 2 + MARGIN
    scores = correlate(layout.wide, layout.spans, cols, xy, bits, yaws, hopeless, 48)
    wide = dilated(layout.words)
    for a, yaw in enumerate(yaws):
        np.testing.assert_array_equal(scores[:, a], plainly(layout, wide, xy, bits, float(yaw), hopeless, 48))
    assert scores.any() or hopeless


def test_a_vehicle_can_stand_on_every_second_cell_of_ground_that_nothing_low_stands_on_or_beside(
    layout: CoarseMap,
) -> None:
    places = set(zip(layout.rows.tolist(), layout.cols.tolist(), strict=True))
    low = layout.words & np.uint32(0b11) != 0
    rows, cols = low.shape
    for row in range(0, rows, 2):
        for col in range(0, cols, 2):
            beside = [(row, col), (row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)]
            blocked = any(0 <= r < rows and 0 <= c < cols and low[r, c] for r, c in beside)
            assert ((row, col) in places) == (not blocked and bool(np.isfinite(layout.ground_z[row, col])))
    assert 1_000 < len(places) < 0.25 * low.size


@given(st.lists(st.integers(0, 255), min_size=1, max_size=60), st.integers(1, 80))
def test_the_highest_are_those_of_a_sort_of_all(scores: list[int], most: int) -> None:
    every = np.array(scores, dtype=np.uint8)
    np.testing.assert_array_equal(highest(every, most), np.argsort(every, kind="stable")[::-1][:most])


def test_a_map_too_large_to_search_asks_for_a_prior() -> None:
    with pytest.raises(MapvoteError, match=r"too large to search; give the drive a prior"):
        laid_out(street(), GlobalSearchNumbers(max_cells=1_000))


CAMPUS = Path(__file__).parents[2] / "../shared/data/campus"


@pytest.mark.slow
def test_scans_of_another_pass_are_found_in_the_campus_map_and_none_is_wrong_and_trusted() -> None:
    if not (CAMPUS / "map_cut.npz").is_file():
        pytest.skip("no campus map: ../shared/data/campus is not there")
    campus = map_from_points(np.load(CAMPUS / "map_cut.npz")["points"].astype(np.float64))
    assert not has_open_ground(campus)
    search = GlobalSearch(campus, Settings().ndt, 0.03)
    frames = np.load(CAMPUS / "frames.npz")
    off_m = []
    for name, T in json.loads((CAMPUS / "T_map_frame.json").read_text()).items():
        found = search(Scan(0, frames[name].astype(np.float32)))
        if found is not None:  # heights apart: those of the reference jump by a metre along a level road
            off_m.append(float(np.linalg.norm(found[:2, 3] - np.array(T)[:2, 3])))
    print("off by", np.round(off_m, 2))
    assert (np.array(off_m) < 0.5).sum() >= 8
    assert max(off_m) < 1.0
