"""A few of many, evenly spread: scans along a drive."""

from __future__ import annotations

import numpy as np

from mapvote.core.types import I64


def evenly(first: int, last: int, count: int) -> I64:
    """At most ``count`` different whole numbers from ``first`` to ``last``, both among them, in ascending order."""
    return np.unique(np.linspace(first, last, count).astype(np.int64))
