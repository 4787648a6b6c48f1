"""Where 5 cm of position decide, `border` does not score; perfect labels lose there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapvote.core.grid import CELL_SIZE
from mapvote_lab.evaluation.scoring.border import BORDER_M, border, ceiling
from mapvote_lab.evaluation.scoring.cells import UNSCORED
from mapvote_lab.evaluation.scoring.scene_truth import Truth

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


@pytest.mark.parametrize(("name", "kind"), [("added", 1), ("removed", 2)])
def test_a_wall_in_the_middle_of_its_cells_is_scored(tmp_path: Path, name: str, kind: int) -> None:
    cells = column_of(kind, 4)
    truth = truth_of(tmp_path, cells, **{name: 4.5 * CELL_SIZE})
    assert np.array_equal(border(truth, cells), cells)
    assert tuple(ceiling(truth, cells).f1)[kind] == 1.0


@pytest.mark.parametrize(("name", "kind"), [("added", 1), ("removed", 2)])
def test_a_wall_two_centimetres_from_the_rim_is_scored_in_neither_cell(tmp_path: Path, name: str, kind: int) -> None:
    cells = column_of(kind, 4)
    truth = truth_of(tmp_path, cells, **{name: 4 * CELL_SIZE + 0.02})
    found = border(truth, cells)
    assert (found[:, [3, 4]] == UNSCORED).all()
    assert (found[:, [0, 1, 2, 5, 6]] == 0).all()


def test_a_change_beside_whose_rim_something_stands_is_not_scored(tmp_path: Path) -> None:
    cells = column_of(2, 4)
    truth = truth_of(tmp_path, cells, removed=4.5 * CELL_SIZE, kept=5 * CELL_SIZE + BORDER_M / 2)
    assert (border(truth, cells)[:, 4] == UNSCORED).all()


def test_what_stands_firmly_stays_scored_beside_a_change(tmp_path: Path) -> None:
    cells = column_of(1, 4)
    truth = truth_of(tmp_path, cells, added=4 * CELL_SIZE + 0.02, kept=3.5 * CELL_SIZE)
    assert (border(truth, cells)[:, 3] == 0).all()


def test_perfect_labels_lose_what_noise_carries_over_the_rim(tmp_path: Path) -> None:
    cells = column_of(1, 4)
    firm = truth_of(tmp_path, cells, added=4.5 * CELL_SIZE)
    (tmp_path / "rim").mkdir()
    rim = truth_of(tmp_path / "rim", cells, added=4 * CELL_SIZE + 0.001)
    assert ceiling(firm, cells).f1.changed_occupied == 1.0
    assert ceiling(rim, cells).f1.changed_occupied < 0.95
