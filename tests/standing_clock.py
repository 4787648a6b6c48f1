"""A clock that stands until a test moves it on."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Clock:
    """Of a store: nanoseconds since 1970."""

    now: int

    def __call__(self) -> int:
        return self.now
