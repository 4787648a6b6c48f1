"""Houses in a row: where one ends and the next begins."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.core.types import F64
from mapvote.server.insight.adjoining import buildings


def walls(x0: float, y0: float, x1: float, y1: float) -> F64:
    """Points of a front (at y1, two cells thick) and two side walls of one cell, in cells."""
    along, deep = np.arange(x0, x1, 0.25), np.arange(y0, y1, 0.25)
    sides = [np.column_stack([np.full(len(deep), x), deep]) for x in (x0, x1)]
    return np.concatenate([*sides, *(np.column_stack([along, np.full(len(along), y1 + d)]) for d in (0.0, 1.0))])


def count(*houses: F64, turn_deg: float = 0.0) -> int:
    """Of the buildings found in houses turned about the origin."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    cells = np.unique(np.floor(np.concatenate(houses) @ np.array([[s, c], [c, -s]])).astype(np.int64), axis=0)
    rows, cols = cells.T
    return int(buildings(rows, cols, np.full(len(rows), 3)).objects.max()) + 1


BRIDGE = np.column_stack([np.arange(53.0, 58.0, 0.25), np.full(20, 30.5)])
"""Over the slot of two houses, as wide as a facade's error."""


@pytest.mark.parametrize("turn_deg", [0.0, 20.0, 45.0, 90.0])
def test_two_houses_whose_fronts_touch_are_two(turn_deg: float) -> None:
    pair = walls(0, 0, 53.5, 30), walls(57.5, 0, 110, 30), BRIDGE
    assert count(*pair, turn_deg=turn_deg) == 2


def test_of_a_row_of_four_each_is_one() -> None:
    row = [walls(58 * k, 0, 58 * k + 54.5, 30) for k in range(4)]
    assert count(*row, *(BRIDGE + np.array([58, 0]) * k for k in range(3))) == 4


@pytest.mark.parametrize("room", [8, 20, 60])
def test_a_house_of_narrow_rooms_is_one(room: int) -> None:
    inner = [np.column_stack([np.full(80, x), np.arange(10.0, 30.0, 0.25)]) for x in range(room, 120, room)]
    assert count(walls(0, 0, 120, 30), *inner) == 1


def test_what_stood_apart_before_is_told_apart_still() -> None:
    assert count(walls(0, 0, 40, 20), walls(60, 0, 100, 20)) == 2
    assert count(walls(0, 0, 40, 20), walls(0, 40, 40, 60)) == 2
