"""Limits per key: requests per minute, and bytes of ballots that are being received."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field

from starlette.requests import ClientDisconnect

from mapvote.core.types import MapvoteError
from mapvote.server.errors import TooLarge, TooMany, Unavailable


class RateLimit:
    """A token bucket for each name: ``burst`` at once, ``per_minute`` on average. For one thread (the event loop)."""

    def __init__(
        self, per_minute: float, burst: float, what: str = "ballots", clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._what = what
        self._per_s = per_minute / 60.0
        self._burst = float(burst)
        self._clock = clock
        self._buckets: dict[str, tuple[float, float]] = {}

    def check(self, name: str) -> None:
        """TooMany if the bucket of ``name`` is empty; takes nothing."""
        lacking = 1.0 - self._tokens(name, self._clock())
        if lacking > 0.0:
            too_fast = f"{name!r} sends more than {self._per_s * 60:g} {self._what} a minute: try again later"
            raise TooMany(too_fast, lacking / self._per_s)

    def take(self, name: str) -> None:
        """One request of ``name``; TooMany if its bucket is empty."""
        self.check(name)
        now = self._clock()
        self._buckets[name] = (self._tokens(name, now) - 1.0, now)
        if len(self._buckets) > 10_000:  # full buckets carry no information: drop them
            wait = self._burst / self._per_s
            self._buckets = {n: b for n, b in self._buckets.items() if now - b[1] < wait}

    def _tokens(self, name: str, now: float) -> float:
        tokens, then = self._buckets.get(name, (self._burst, now))
        return min(self._burst, tokens + (now - then) * self._per_s)


class Uploads:
    """Ballots that are being received. For one thread (the event loop).

    One has at most ``each`` bytes, all together at most ``together`` in memory. Beyond that the largest is dropped, so
    small ballots never wait for large ones. A vehicle sends at most ``AT_ONCE`` at a time.
    """

    AT_ONCE = 4

    def __init__(self, each: int, together: int) -> None:
        self._each, self._together = each, together
        self._bytes = 0
        self._under_way: dict[_Upload, None] = {}
        self._of: Counter[str] = Counter()

    async def read(self, vehicle: str, stream: AsyncIterator[bytes], declared: str | None) -> bytes:
        """A whole body. TooLarge beyond the limit for one; TooMany if the vehicle sends more than it may at a time;
        Unavailable if this one was dropped; MapvoteError if the client went away."""
        if declared is not None and declared.isdigit() and int(declared) > self._each:
            raise TooLarge(f"the body has {declared[:20]} bytes, the limit is {self._each}: send a shorter drive")
        if self._of[vehicle] >= self.AT_ONCE:
            raise TooMany(f"{vehicle[:64]!r} sends {self.AT_ONCE} ballots already: wait until these are answered")
        upload = _Upload()
        self._of[vehicle] += 1
        self._under_way[upload] = None
        try:
            async for chunk in stream:
                self._take(upload, chunk)
            return b"".join(upload.chunks)
        except ClientDisconnect as error:
            raise MapvoteError("the ballot came only in part: the client went away") from error
        finally:
            self._forget(upload)
            self._of[vehicle] -= 1
            if not self._of[vehicle]:
                del self._of[vehicle]

    def _take(self, upload: _Upload, chunk: bytes) -> None:
        if upload in self._under_way:
            upload.chunks.append(chunk)
            upload.size += len(chunk)
            self._bytes += len(chunk)
            while self._bytes > self._together:
                self._forget(max(self._under_way, key=lambda u: u.size))
        if upload not in self._under_way:
            raise Unavailable("too many large ballots are on their way at once: send this one again")
        if upload.size > self._each:
            raise TooLarge(f"the body is larger than {self._each} bytes: send a shorter drive")

    def _forget(self, upload: _Upload) -> None:
        """Free its memory at once, even if its sender stays connected."""
        if upload in self._under_way:
            del self._under_way[upload]
            self._bytes -= upload.size
            upload.chunks.clear()


@dataclass(eq=False, slots=True)
class _Upload:
    chunks: list[bytes] = field(default_factory=list)
    size: int = 0
