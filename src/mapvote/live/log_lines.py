"""Log lines that repeat: one of a kind is logged the 1st, 2nd, 4th, 8th ... time, with its number."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable


class Repeated:
    """Passes on some lines of each kind, so that a fault at 10 Hz does not fill a disk."""

    def __init__(self, say: Callable[[str], object]) -> None:
        self._say = say
        self._counts: Counter[str] = Counter()

    def __call__(self, kind: str, text: str) -> None:
        """``kind`` groups lines whose texts differ, as by a time or a name."""
        self._counts[kind] += 1
        count = self._counts[kind]
        if count & (count - 1) == 0:
            self._say(text if count == 1 else f"{text} ({count} of this kind so far)")
