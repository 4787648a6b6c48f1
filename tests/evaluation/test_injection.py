"""Injected objects: the map differs from the street exactly where the objects say, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.core.columns import reference_window
from mapvote.core.grid import Grid, Lattice
from mapvote.core.tiling import map_from_points
from mapvote.core.types import CellState, PointMap
from mapvote.evaluation.injection import APART_M, choose_objects, inject, score_injection

GRID = Grid(Lattice(), 0, 0, 150, 200)


@pytest.fixture(scope="module")
def street() -> PointMap:
    """60 m x 45 m of ground with a long wall on it."""
    x, y = np.meshgrid(np.arange(0.15, 60, 0.3), np.arange(0.15, 45, 0.3))
    wall_x, wall_z = np.meshgrid(np.arange(0.15, 60, 0.3), np.arange(0.45, 4.0, 0.3))
    ground = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    walls = [np.column_stack([wall_x.ravel(), np.full(wall_x.size, at), wall_z.ravel()]) for at in (5.25, 5.55)]
    return map_from_points(np.vstack([ground, *walls]))


def test_objects_change_their_cells_and_nothing_else(street: PointMap) -> None:
    reference = reference_window(street, GRID)
    shown = np.where(reference.counts > 0, 9, 0)
    objects = choose_objects(reference, shown, np.ones(GRID.shape, np.bool_), 3, np.random.default_rng(1))
    assert sorted(o.kind for o in objects) == ["built"] * 3 + ["demolished"] * 3
    middles = np.array([o.middle for o in objects])
    gaps = np.linalg.norm(middles[:, None] - middles[None], axis=2)[np.triu_indices(6, 1)]
    assert (gaps >= APART_M).all()

    other = reference_window(inject(street, reference, objects), GRID)
    built = np.any([o.cells for o in objects if o.kind == "built"], axis=0)
    demolished = np.any([o.cells for o in objects if o.kind == "demolished"], axis=0)
    assert (reference.counts[built] > 0).all()
    assert (other.counts[built] == 0).all()
    assert (reference.counts[demolished] == 0).all()
    assert (other.counts[demolished] >= 3).all()
    rest = ~built & ~demolished
    assert np.array_equal(other.occupied[rest], reference.occupied[rest])

    right = np.full(GRID.shape, CellState.UNCHANGED_EMPTY, np.uint8)
    right[built], right[demolished] = CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY
    scores = score_injection(right, objects, shown)
    assert all(scores[f"{kind}_{what}"] == 1.0 for kind in ("built", "demolished") for what in ("recall", "precision"))
    nothing = score_injection(np.zeros(GRID.shape, np.uint8), objects, shown)
    assert nothing["built_half_found"] == nothing["demolished_recall"] == 0.0


def test_the_same_draw_gives_the_same_objects(street: PointMap) -> None:
    reference = reference_window(street, GRID)
    shown, passed = np.where(reference.counts > 0, 9, 0), np.ones(GRID.shape, np.bool_)
    one, two = (choose_objects(reference, shown, passed, 3, np.random.default_rng(5)) for _ in range(2))
    assert [o.middle for o in one] == [o.middle for o in two]
