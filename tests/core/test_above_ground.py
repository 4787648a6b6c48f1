"""A map without known-free columns: where its ground was measured, an obstacle would have been seen."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.config import Settings, choose_case
from mapvote.core.grid import Grid
from mapvote.core.point_map import map_from_points
from mapvote.core.reference import above_ground_points
from mapvote.core.types import MapvoteError


def test_new_things_are_believed_only_over_ground_that_the_map_measured() -> None:
    x, y = np.meshgrid(np.arange(0.15, 6.0, 0.3), np.arange(0.15, 6.0, 0.3))
    road = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    sign = np.array([[9.15, 3.15, 2.0], [9.15, 3.15, 2.3], [9.45, 3.15, 2.0]])  # nobody measured the ground under it
    point_map = map_from_points(np.vstack([road, sign]))
    words = above_ground_points(point_map, Grid(point_map.lattice, 0, 0, 20, 40))
    assert (words[:, :20] == ~np.uint64(0)).all()
    assert (words[:, 20] != 0).all(), "the cell next to measured ground counts too"
    assert not words[:, 22:28].any()


def test_the_paper_cases_by_number_and_ours_by_name() -> None:
    assert choose_case(Settings(), "surfaces").voting.method == "surfaces"
    second = choose_case(Settings(), "2").voting
    assert (second.method, second.weighted, second.two_stage, second.skip_tall_cells) == ("paper", False, True, False)
    with pytest.raises(MapvoteError, match="choose surfaces or one of 1, 2, 3, 4, 5"):
        choose_case(Settings(), "6")
