"""Three truths of the same street: what changed, what left points, what a vote could know of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapvote.core.grid import Grid, Lattice
from mapvote.core.types import F64, Reference
from mapvote_lab.evaluation.scoring.cells import UNSCORED
from mapvote_lab.evaluation.scoring.scene_truth import Truth
from mapvote_lab.evaluation.scoring.truths import BANDS, TRUTHS, lowest_surface, sizes_by_height

GRID = Grid(Lattice(), 0, 0, 1, 6)
PROVENANCE = [[0, 1, 1, 2, 2, UNSCORED]]


@pytest.fixture
def truth(tmp_path: Path) -> Truth:
    """Cell 1 had four points in its best scan, cell 2 five; surfaces of them at 1 m and 6 m, of cell 3 at 2 m.
    Vehicles recorded points in cell 1 only, and passed cell 3 only."""
    points = np.array([[0.4, 0.1, 1.0], [0.4, 0.1, 3.0], [0.7, 0.1, 6.0], [1.0, 0.1, 2.0]], np.float32)
    np.savez(tmp_path / "surface.npz", points=points, label=np.array([1, 1, 1, 2], np.uint8))
    cells = np.array(PROVENANCE, np.uint8)
    densest = np.array([[0, 4, 5, 0, 0, 9]], np.uint8)
    passed = np.arange(6)[None] == 3
    return Truth(tmp_path, 0.0, 0.0, cells.copy(), cells, np.zeros_like(cells), densest, densest == 4, passed, ())


@pytest.fixture
def first_map() -> Reference:
    """Flat; it holds a point in cell 3 and none in cell 4."""
    counts = np.array([[0, 0, 0, 1, 0, 0]], np.int32)
    zero = np.zeros(GRID.shape, np.float32)
    words = np.zeros(GRID.shape, np.uint64)
    return Reference(GRID, zero, zero.astype(np.int32), words, counts, zero, zero, None)


def test_what_no_scan_and_no_map_holds_cannot_be_known(truth: Truth, first_map: Reference) -> None:
    known = TRUTHS["could be known"](truth, first_map)
    assert known.tolist() == [[0, UNSCORED, 1, 2, UNSCORED, UNSCORED]]
    assert truth.provenance.tolist() == PROVENANCE, "the truth it is taken from stays as it is"


def test_a_cell_that_no_ray_decided_or_where_the_map_holds_a_point_on_nothing_is_not_scored(
    truth: Truth, first_map: Reference
) -> None:
    states = TRUTHS["known"](truth, first_map)
    assert states.tolist() == [[0, 1, UNSCORED, 2, UNSCORED, UNSCORED]]
    assert TRUTHS["known"](replace(truth, passed=np.zeros_like(truth.passed)), first_map)[0, 3] == UNSCORED
    first_map.counts[0, 0] = 1
    assert TRUTHS["known"](truth, first_map)[0, 0] == UNSCORED, "nothing that stood at the survey is near cell 0"


def test_what_could_be_known_is_never_more_than_what_left_points(truth: Truth, first_map: Reference) -> None:
    known, whole = TRUTHS["could be known"](truth, first_map), TRUTHS["provenance"](truth, first_map)
    assert np.all((known == whole) | (known == UNSCORED))


def test_changed_cells_are_counted_by_the_height_of_their_lowest_surface(truth: Truth, first_map: Reference) -> None:
    sizes = sizes_by_height(truth.strict, truth, first_map)
    assert sizes["changed_occupied"] == dict(zip(BANDS, (1, 0, 1, 0), strict=True))
    assert sizes["changed_empty"] == dict(zip(BANDS, (0, 1, 0, 1), strict=True))
    heights: F64 = lowest_surface(truth.surfaces()[1], GRID, first_map.ground_z)
    assert heights[0, 1] == 1.0
    assert np.isinf(heights[0, 0])
