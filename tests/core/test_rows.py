"""Rows found among others, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapvote.core.rows import found_among

FEW = st.sampled_from([0.0, -0.0, 1.0, 1.5, float("nan")])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@given(data=st.data(), n=st.integers(0, 30), m=st.integers(0, 30))
def test_rows_are_found_as_their_bytes_are(dtype: type, data: st.DataObject, n: int, m: int) -> None:
    rows, others = (data.draw(arrays(dtype, (k, 3), elements=FEW)) for k in (n, m))
    known = {row.tobytes() for row in others}
    assert found_among(rows, others).tolist() == [row.tobytes() in known for row in rows]


def test_an_edited_cloud_is_told_from_the_one_before() -> None:
    old = np.random.default_rng(1).uniform(0, 76, (20_000, 3)).astype(np.float32)
    new = np.concatenate([old[5000:], old[:300] + np.float32(0.25)])
    assert np.flatnonzero(~found_among(old, new)).tolist() == list(range(5000))
    assert np.flatnonzero(~found_among(new, old)).tolist() == list(range(15_000, 15_300))
