"""Times are written as ISO 8601 in UTC, whole seconds."""

from __future__ import annotations

from datetime import UTC, datetime

from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.times import utc


@given(st.integers(0, 253_402_300_799), st.integers(0, 10**9 - 1))
def test_the_second_of_a_stamp_is_read_back(second: int, rest_ns: int) -> None:
    assert datetime.fromisoformat(utc(second * 10**9 + rest_ns)) == datetime.fromtimestamp(second, UTC)


def test_an_unknown_time_stays_unknown_and_no_stamp_is_too_late() -> None:
    assert utc(None) is None
    assert utc((1 << 63) - 1) == "2262-04-11T23:47:16Z"
    assert utc(10**30) == "9999-12-31T23:59:59Z"
