"""What one key may ask for: requests per minute, and bytes in a body."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable

from mapvote.server.errors import TooLarge, TooMany


class RateLimit:
    """A token bucket for each name: ``burst`` at once, ``per_minute`` on average. For one thread (the event loop)."""

    def __init__(self, per_minute: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s = per_minute / 60.0
        self._burst = float(burst)
        self._clock = clock
        self._buckets: dict[str, tuple[float, float]] = {}

    def take(self, name: str) -> None:
        """One request of ``name``; TooMany if its bucket is empty."""
        now = self._clock()
        tokens, then = self._buckets.get(name, (self._burst, now))
        tokens = min(self._burst, tokens + (now - then) * self._per_s)
        if tokens < 1.0:
            self._buckets[name] = (tokens, now)
            raise TooMany(f"{name!r} sends more than {self._per_s * 60:g} ballots a minute: try again later")
        self._buckets[name] = (tokens - 1.0, now)
        if len(self._buckets) > 10_000:  # full buckets say nothing: forget them
            wait = self._burst / self._per_s
            self._buckets = {n: b for n, b in self._buckets.items() if now - b[1] < wait}


async def read_body(stream: AsyncIterator[bytes], declared: str | None, limit: int) -> bytes:
    """The whole body, never more than ``limit`` bytes of it in memory; TooLarge beyond."""
    if declared is not None and declared.isdigit() and int(declared) > limit:
        raise TooLarge(f"the body has {declared} bytes, the limit is {limit}: send a shorter drive")
    chunks, size = [], 0
    async for chunk in stream:
        size += len(chunk)
        if size > limit:
            raise TooLarge(f"the body is larger than {limit} bytes: send a shorter drive")
        chunks.append(chunk)
    return b"".join(chunks)
