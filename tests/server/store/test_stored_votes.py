"""What was unpacked is remembered, within bounds."""

from __future__ import annotations

import numpy as np

from hand_made import SHAPE
from mapvote.codec.ballot import Planes
from mapvote.server.store.database import Remembered

BYTES = SHAPE[0] * SHAPE[1]


def said(state: int) -> Planes:
    return Planes(np.full(SHAPE, state, dtype=np.uint8), None, None, None, None, None, None)


def test_what_was_not_asked_for_longest_is_forgotten_first_and_never_more_is_kept_than_may_be() -> None:
    remembered = Remembered(2 * BYTES)
    remembered.put("a", said(0))
    remembered.put("b", said(1))
    assert remembered.get(["a", "c"]).keys() == {"a"}
    remembered.put("c", said(2))
    remembered.put("a", said(0))
    assert remembered.get("abc").keys() == {"a", "c"}
    assert remembered.bytes == 2 * BYTES
    for name in "defg":
        remembered.put(name, said(3))
    assert remembered.get("abcdefg").keys() == {"f", "g"}


def test_a_vote_larger_than_all_that_may_be_kept_is_not_kept() -> None:
    remembered = Remembered(BYTES - 1)
    remembered.put("a", said(0))
    assert remembered.get("a") == {}
    assert remembered.bytes == 0
