"""Reasons that hold a version back, by hand: shares of a tile, and the size of one connected thing, across tiles
too."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from mapvote.config import FuseSettings
from mapvote.core.grid import CELLS, TILE_CELLS, TileIndex
from mapvote.core.types import I64
from mapvote_server.store.fusion_jobs import Fused
from mapvote_server.store.hold import areas_m2, hold_reasons, lattice_cells

SETTINGS = FuseSettings(max_deleted_share=0.5, max_freed_share=0.25, max_change_m2=0.9)  # 0.9 m2 are ten cells
NOTHING = Fused.nothing((0, 0), ())


def cells(*places: tuple[int, int]) -> I64:
    return np.array([r * TILE_CELLS + c for r, c in places], dtype=np.int64)


def row(length: int, first: int = 0) -> I64:
    return cells(*((7, c) for c in range(first, first + length)))


def fused(index: TileIndex = (0, 0), **what: Any) -> Fused:
    return replace(NOTHING, index=index, **what)


QUARTER = CELLS // 4


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ([], []),
        ([fused(points=100, deleted=50, freed=QUARTER, cells_gone=row(5), cells_new=row(9))], []),  # just allowed
        ([fused((3, -2), points=100, deleted=51)], ["deletes 51% of the points of tile 3,-2, more than 50%"]),
        ([fused(points=0, deleted=0)], []),
        ([fused((1, 1), freed=2 * QUARTER), fused()], ["learns free space in 50% of tile 1,1, more than 25%"]),
        ([fused(freed=QUARTER + 1)], ["learns free space in 25% of tile 0,0, more than 25%"]),
        (
            [fused(cells_gone=np.concatenate([row(3), row(40, first=100), row(4, first=200)]))],
            ["removes one connected thing of 4 m2, more than 1 m2"],  # the largest is told
        ),
    ],
)
def test_a_tile_that_loses_or_learns_more_than_its_share_is_named(changed: list[Fused], told: list[str]) -> None:
    assert hold_reasons(changed, SETTINGS) == told


@pytest.mark.parametrize(("what", "verb"), [("cells_gone", "removes"), ("cells_new", "adds")])
def test_one_connected_thing_may_only_be_so_large(what: str, verb: str) -> None:
    assert hold_reasons([fused((0, 0), **{what: row(10)})], SETTINGS) == []
    (reason,) = hold_reasons([fused((0, 0), **{what: row(12)})], SETTINGS)
    assert reason == f"{verb} one connected thing of 1 m2, more than 1 m2"
    far = np.concatenate([row(6), row(6, first=7)])
    assert hold_reasons([fused((0, 0), **{what: far})], SETTINGS) == [], "two things of six cells, one cell apart"


def test_a_thing_over_two_tiles_is_one_and_its_parts_by_themselves_are_not_too_large() -> None:
    left, right = row(6, first=TILE_CELLS - 6), row(6)
    assert len(hold_reasons([fused((0, 0), cells_new=left), fused((0, 1), cells_new=right)], SETTINGS)) == 1
    assert hold_reasons([fused((0, 0), cells_new=left), fused((1, 1), cells_new=right)], SETTINGS) == []
    assert hold_reasons([fused((0, 0), cells_new=left), fused((0, 1), cells_gone=right)], SETTINGS) == []


def test_every_reason_is_told() -> None:
    bad = fused(points=10, deleted=9, freed=CELLS, cells_gone=row(20), cells_new=row(30))
    assert [reason.split()[0] for reason in hold_reasons([bad], SETTINGS)] == ["deletes", "learns", "removes", "adds"]


def test_flat_cells_of_tiles_are_cells_of_the_lattice() -> None:
    rows, cols = lattice_cells([(fused((2, 3)), cells((0, 0), (5, 255))), (fused((-1, 0)), cells((255, 1)))])
    assert rows.tolist() == [512, 517, -1]
    assert cols.tolist() == [768, 1023, 1]
    nowhere = lattice_cells([])
    assert [len(part) for part in nowhere] == [0, 0]


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.6), st.integers(-TILE_CELLS - 4, -TILE_CELLS))
def test_things_are_the_8_connected_components_wherever_they_lie(seed: int, share: float, shift: int) -> None:
    picture = np.random.default_rng(seed).random((9, 11)) < share
    labels, count = ndimage.label(picture, structure=np.ones((3, 3)))
    expected = sorted(np.bincount(labels.ravel(), minlength=count + 1)[1:] * 0.09)
    rows, cols = (axis.astype(np.int64) for axis in np.nonzero(picture))
    # The corner of four tiles is inside of the picture at some shifts; each tile is a part of its own.
    rows += shift
    cols += TILE_CELLS - 5
    tiles = np.stack([rows // TILE_CELLS, cols // TILE_CELLS])
    parts = [(tiles == one[:, None]).all(axis=0) for one in np.unique(tiles, axis=1).T]
    assert sorted(areas_m2((rows[part], cols[part]) for part in parts)) == pytest.approx(expected)
    assert sorted(areas_m2([(rows, cols)])) == pytest.approx(expected)


def test_of_the_cells_of_a_city_only_those_at_edges_of_tiles_are_kept() -> None:
    rows, cols = (axis.reshape(-1) for axis in np.mgrid[100:140, 100:140])
    parts = [(rows, cols + TILE_CELLS * col) for col in range(200)]
    areas_m2(parts[:1])
    tracemalloc.start()
    assert areas_m2(parts) == pytest.approx(np.full(200, 144.0))
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 0.3 * sum(rows.nbytes + cols.nbytes for rows, cols in parts)
