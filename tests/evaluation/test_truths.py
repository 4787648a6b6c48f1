"""Where 5 cm of position decide, `border` does not score; perfect labels lose there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapvote.core.grid import CELL_SIZE, Grid, Lattice
from mapvote.core.types import Reference
from mapvote_lab.evaluation.truths import TRUTH_READING, TRUTHS, Truth, border, ceiling
from mapvote_lab.simulation.truth import Label

KEPT, ADDED, REMOVED = range(3)


def wall(x: float) -> np.ndarray:
    """A wall along y from 0 to 3 m, 3 m high."""
    y, z = np.meshgrid(np.arange(0.05, 3.0, 0.1), np.arange(0.35, 3.0, 0.1))
    return np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()])


def truth_of(folder: Path, cells: np.ndarray, **walls: float) -> Truth:
    """``cells`` (10, 10) with a surface file of walls, each at its x."""
    samples = {name: wall(x) for name, x in walls.items()}
    labels = {"kept": KEPT, "added": ADDED, "removed": REMOVED}
    (folder / "truth").mkdir()
    np.savez(
        folder / "truth" / "surface.npz",
        points=np.concatenate(list(samples.values())).astype(np.float32),
        label=np.concatenate([np.full(len(points), labels[name], np.uint8) for name, points in samples.items()]),
    )
    return Truth(folder / "truth", 0.0, 0.0, cells, cells, *(np.zeros_like(cells),) * 2, *(cells > 0,) * 2, ())


def column_of(kind: int, column: int) -> np.ndarray:
    cells = np.zeros((10, 10), np.uint8)
    cells[:, column] = kind
    return cells


RIM = 4 * CELL_SIZE + 0.02
MIDDLE = 4.5 * CELL_SIZE


@pytest.mark.parametrize(
    ("kind", "walls", "unscored"),
    [
        (1, {"added": MIDDLE}, []),
        (2, {"removed": MIDDLE}, []),
        (1, {"added": RIM}, [3, 4]),
        (2, {"removed": RIM}, [3, 4]),
        (2, {"removed": MIDDLE, "kept": 5 * CELL_SIZE + TRUTH_READING.border_m / 2}, [4]),
        (1, {"added": RIM, "kept": 3.5 * CELL_SIZE}, [4]),
    ],
    ids=["built", "demolished", "built at a rim", "demolished at a rim", "beside what stands", "what stands firmly"],
)
def test_border_scores_no_cell_whose_rim_decides(
    tmp_path: Path, kind: int, walls: dict[str, float], unscored: list[int]
) -> None:
    cells = column_of(kind, 4)
    found = border(truth_of(tmp_path, cells, **walls), cells)
    assert np.flatnonzero((found == Label.UNSCORED).all(axis=0)).tolist() == unscored
    scored = np.setdiff1d(np.arange(10), unscored)
    np.testing.assert_array_equal(found[:, scored], cells[:, scored])


@pytest.mark.parametrize(("x", "low", "high"), [(MIDDLE, 1.0, 1.0), (4 * CELL_SIZE + 0.001, 0.0, 0.95)])
def test_perfect_labels_lose_what_noise_carries_over_the_rim(tmp_path: Path, x: float, low: float, high: float) -> None:
    cells = column_of(1, 4)
    assert low <= ceiling(truth_of(tmp_path, cells, added=x), cells).f1.changed_occupied <= high


GRID = Grid(Lattice(), 0, 0, 1, 6)
PROVENANCE = [[0, 1, 1, 2, 2, Label.UNSCORED]]


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


def test_a_cell_that_no_scan_and_no_map_holds_cannot_be_known(truth: Truth, first_map: Reference) -> None:
    known = TRUTHS["could be known"](truth, first_map)
    assert known.tolist() == [[0, Label.UNSCORED, 1, 2, Label.UNSCORED, Label.UNSCORED]]
    assert truth.provenance.tolist() == PROVENANCE, "the truth it is taken from stays as it is"


def test_a_cell_that_no_ray_decided_or_where_the_map_holds_a_point_on_nothing_is_not_scored(
    truth: Truth, first_map: Reference
) -> None:
    states = TRUTHS["known"](truth, first_map)
    assert states.tolist() == [[0, 1, Label.UNSCORED, 2, Label.UNSCORED, Label.UNSCORED]]
    assert TRUTHS["known"](replace(truth, passed=np.zeros_like(truth.passed)), first_map)[0, 3] == Label.UNSCORED
    first_map.counts[0, 0] = 1
    assert TRUTHS["known"](truth, first_map)[0, 0] == Label.UNSCORED, "nothing that stood at the survey is near cell 0"
