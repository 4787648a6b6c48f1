"""Both yardsticks on a street one can draw: a wall that fell, a wall behind it that stood, a box that is new."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.grid import Grid, Lattice
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.reference import reference_window
from mapvote.core.types import CellState
from mapvote_lab.evaluation.baselines import EvidenceMap, NearestNeighbour, combine, dempster
from mapvote_lab.evaluation.scores import map_obstacles

GRID = Grid(Lattice(), 0, 0, 60, 100)
ORIGIN = np.array([15.0, 2.0, 1.9])
FALLEN, STOOD, BUILT = 9.75, 15.75, 6.75  # y of three walls, in the middle of cell rows 32, 52 and 22


def wall(y: float, x0: float, x1: float) -> np.ndarray:
    x, z = np.meshgrid(np.arange(x0 + 0.05, x1, 0.1), np.arange(0.35, 4.0, 0.1))
    return np.column_stack([x.ravel(), np.full(x.size, y), z.ravel()])


def ground() -> np.ndarray:
    x, y = np.meshgrid(np.arange(0.15, 30, 0.3), np.arange(0.15, 18, 0.3))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


@pytest.fixture(scope="module")
def old_map() -> PointMap:
    return map_from_points(np.vstack([ground(), wall(FALLEN, 14, 20), wall(STOOD, 8, 24)]))


def today() -> tuple[np.ndarray, np.ndarray]:
    """A scan of the new world from ORIGIN, and its points above ground."""
    new, stood = wall(BUILT, 8, 14), wall(STOOD, 8, 24)
    behind_new = (stood[:, 0] - ORIGIN[0]) / (STOOD - ORIGIN[1]) * (BUILT - ORIGIN[1]) + ORIGIN[0] < 14
    points = np.vstack([ground(), new, stood[~behind_new]])
    return points, points[:, 2] > 0.3


def columns(x0: float, x1: float) -> slice:
    return slice(round(x0 / 0.3) + 1, round(x1 / 0.3) - 1)


def test_nearest_neighbour_finds_the_fallen_and_the_new(old_map: PointMap) -> None:
    points, obstacle = today()
    detector = NearestNeighbour(map_obstacles(old_map), GRID)
    for _ in range(20):
        detector.push(points, ORIGIN, obstacle, np.zeros(len(points), np.bool_))
    states = detector.states()
    assert (states[32, columns(14, 20)] == CellState.CHANGED_EMPTY).all()
    assert (states[22, columns(8, 14)] == CellState.CHANGED_OCCUPIED).all()
    assert (states[52, columns(14, 23)] == CellState.UNCHANGED_OCCUPIED).all()
    # blind to visibility: what the new wall hides is taken for gone
    assert (states[52, columns(8, 11)] == CellState.CHANGED_EMPTY).all()
    assert 0 < detector.memory_bytes < 10e6


@pytest.mark.slow
def test_evidence_finds_them_too_and_says_nothing_about_what_is_hidden(old_map: PointMap) -> None:
    points, obstacle = today()
    reference = reference_window(old_map, GRID)
    vehicles = [EvidenceMap(reference) for _ in range(2)]
    for vehicle in vehicles:
        for _ in range(3):
            vehicle.push(points, ORIGIN, obstacle, np.zeros(len(points), np.bool_))
        assert vehicle.memory_bytes == 60 * 100 * 64 * 8
    states = combine(vehicles, reference)
    assert (states[32, columns(14, 20)] == CellState.CHANGED_EMPTY).all()
    assert (states[22, columns(8, 14)] == CellState.CHANGED_OCCUPIED).all()
    assert (states[52, columns(14, 23)] == CellState.UNCHANGED_OCCUPIED).all()
    assert (states[52, columns(8, 11)] == CellState.UNDETERMINED).all()


masses = st.tuples(st.floats(0, 1), st.floats(0, 1)).map(lambda m: (0.99 * m[0], 0.99 * (1 - m[0]) * m[1]))


@given(masses, masses)
def test_dempsters_rule_commutes_and_gives_masses(a: tuple[float, float], b: tuple[float, float]) -> None:
    o, f = dempster(*a, *b)
    assert (o, f) == pytest.approx(dempster(*b, *a), abs=1e-12)
    assert o >= 0
    assert f >= 0
    assert o + f <= 0.99 + 1e-12


@given(masses)
def test_knowing_nothing_changes_nothing(a: tuple[float, float]) -> None:
    assert dempster(*a, 0.0, 0.0) == pytest.approx(a, abs=1e-12)


def test_dempsters_textbook_example() -> None:
    # m1(O) = .6, m2(F) = .5: conflict .3; (.6 x .5, .4 x .5, .4 x .5) / .7 (Shafer 1976, ch. 3)
    assert dempster(0.6, 0.0, 0.0, 0.5) == pytest.approx((0.3 / 0.7, 0.2 / 0.7))
