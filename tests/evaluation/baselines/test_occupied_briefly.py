"""[9] read literally: a cell occupied for less than a time is moving."""

from __future__ import annotations

import numpy as np

from mapvote.core.types import F64
from mapvote_lab.evaluation.baselines.baselines import OccupiedBriefly

ORIGIN = np.zeros(3)


def masks(places: list[F64], brief_s: float = 1.0) -> list[list[bool]]:
    """What is called moving of each scan of a 10 Hz stream; ``places`` (n, 3) points a scan, all obstacles."""
    movers, said = OccupiedBriefly(brief_s), []
    for i, points in enumerate(places):
        [mask] = movers.push(points, ORIGIN, np.ones(len(points), dtype=np.bool_), i * 100_000_000)
        said.append(mask.tolist())
    assert movers.flush() == []
    return said


def test_what_passes_a_cell_moves_and_what_stays_stands_after_a_second() -> None:
    wall = np.array([5.1, 5.1, 1.0])
    said = masks([np.array([wall, [0.1 + i, 0.1, 1.0]]) for i in range(15)])
    assert all(car for _, car in said)
    assert [stands for stands, _ in said] == [True] * 10 + [False] * 5


def test_its_weakness_is_that_what_has_just_come_into_view_moves() -> None:
    said = masks([np.array([[5.1, 5.1, 1.0]])] * 3 + [np.array([[5.1, 5.1, 1.0], [9.1, 9.1, 1.0]])] * 2, brief_s=0.2)
    assert said[3] == [False, True]


def test_a_cell_that_was_not_hit_for_a_while_begins_anew() -> None:
    wall, nothing = np.array([[5.1, 5.1, 1.0]]), np.zeros((0, 3))
    assert masks([wall, wall, wall, nothing, wall], brief_s=0.2)[-1] == [False], "one scan may miss it"
    assert masks([wall, wall, wall, nothing, nothing, nothing, wall], brief_s=0.2)[-1] == [True]


def test_ground_is_never_moving() -> None:
    [mask] = OccupiedBriefly().push(np.zeros((2, 3)), ORIGIN, np.array([False, True]), 0)
    assert mask.tolist() == [False, True]
