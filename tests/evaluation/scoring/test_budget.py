"""A budget's tenths of a percent always add up, however many causes share it."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapvote_lab.evaluation.scoring.budget import in_tenths


@given(st.lists(st.integers(0, 100_000), min_size=1, max_size=12))
def test_tenths_add_up_to_100_and_are_off_by_less_than_one(counts: list[int]) -> None:
    tenths = in_tenths(np.array(counts))
    total = sum(counts)
    assert sum(tenths) == (1000 if total else 0)
    for count, share in zip(counts, tenths, strict=True):
        assert abs(share - 1000 * count / max(total, 1)) < 1


def test_thirds_are_not_all_rounded_down() -> None:
    assert in_tenths(np.array([1, 1, 1])) == [334, 333, 333]
