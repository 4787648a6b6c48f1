"""Rounds in turn speak of the first map. (The rounds themselves: test_matrix.)"""

from __future__ import annotations

import numpy as np

from mapvote.core.types import CellState
from mapvote_lab.evaluation.experiments.imported_map import over_both_rounds

KEPT, FREE = CellState.UNCHANGED_OCCUPIED, CellState.UNCHANGED_EMPTY
BUILT, GONE = CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY


def test_a_change_of_either_round_is_one_unless_the_other_undid_it() -> None:
    first = np.array([FREE, FREE, BUILT, BUILT, GONE, GONE, KEPT], dtype=np.uint8)
    second = np.array([FREE, BUILT, KEPT, GONE, FREE, BUILT, GONE], dtype=np.uint8)
    np.testing.assert_array_equal(over_both_rounds(first, second), [FREE, BUILT, BUILT, FREE, GONE, KEPT, GONE])
