"""What one server takes at a time: requests a minute of a key, bytes of ballots on their way, and threads for each kind
of work. Requests that arrive while one batch is processed form the next, so a hundred ballots cost one fsync.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from anyio import CapacityLimiter
from starlette.requests import ClientDisconnect

from mapvote.core.types import MapvoteError
from mapvote.server.errors import TooLarge, TooMany, Unavailable

READING = 1
"""Threads for what operators read. Python computes in one thread at a time: more would only compete with the threads
that answer vehicles."""


@dataclass(frozen=True, slots=True)
class Threads:
    """Each kind of work has its own threads, so that none blocks another.

    All other work runs in FastAPI's own pool of :data:`READING` threads: what operators read.
    """

    ballots: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(3, "ballots"))
    lookups: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(2, "lookups"))
    """Keys, the newest version, health: short questions before every answer."""
    fuse: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(2, "fuse"))
    fetching: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(4))
    """Manifests and tiles."""
    deciding: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(4))
    """Threads for slow requests, which fuse tiles or read the whole store: publish, desk, check. Others do not wait."""


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


_MEND = "send a shorter drive, or raise [server] max_body_bytes"


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
        Unavailable if this one was dropped; MapvoteError if the client disconnected."""
        if declared is not None and declared.isdigit() and int(declared) > self._each:
            raise TooLarge(f"the body has {declared[:20]} bytes, the limit is {self._each}: {_MEND}")
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
            raise MapvoteError("only a part of the ballot arrived: the client disconnected") from error
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
            raise TooLarge(f"the body is larger than {self._each} bytes: {_MEND}")

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


Asked = TypeVar("Asked")
Answer = TypeVar("Answer")


class Batcher(Generic[Asked, Answer]):
    """Calls ``work`` in one of ``threads``, one batch of at most ``limit`` after another. Lives on one event loop.

    ``work`` gives one answer for each item, in order; an exception among the answers is raised to its caller. If
    ``work`` itself raises, every caller of the batch gets that exception.
    """

    def __init__(
        self,
        work: Callable[[Sequence[Asked]], Sequence[Answer | Exception]],
        limit: int,
        threads: Executor | None = None,
    ) -> None:
        self._work = work
        self._limit = limit
        self._threads = threads
        self._waiting: list[tuple[Asked, asyncio.Future[Answer]]] = []
        self._worker: asyncio.Task[None] | None = None

    async def put(self, item: Asked) -> Answer:
        """The answer to one item, once the batch that holds it is done."""
        future: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting.append((item, future))
        if self._worker is None or self._worker.done():
            self._worker = asyncio.create_task(self._run())
        return await future

    async def close(self) -> None:
        """Wait until every item is done."""
        while self._worker is not None and not self._worker.done():
            await self._worker

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        while self._waiting:
            await asyncio.sleep(0)  # requests of the same moment join
            some, self._waiting = self._waiting[: self._limit], self._waiting[self._limit :]
            answers: Sequence[Answer | Exception]
            try:
                answers = await loop.run_in_executor(self._threads, self._work, [item for item, _ in some])
            except Exception as error:
                answers = [error] * len(some)
            for (_, future), answer in zip(some, answers, strict=True):
                if future.cancelled():
                    continue
                if isinstance(answer, Exception):
                    future.set_exception(answer)
                else:
                    future.set_result(answer)
