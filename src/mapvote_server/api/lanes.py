"""Threads by kind of work, and the budget of each key.

A route names its lane: ``vehicle`` (map, tiles, ballots), ``questions`` (what people read), ``commands`` (short
changes) or ``rounds`` (work that fuses tiles or reads the whole store). Within a lane the keys take turns, so a key
that asks much waits for itself.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Awaitable, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from contextvars import ContextVar, copy_context
from dataclasses import dataclass
from functools import partial, wraps
from typing import Any, Literal, ParamSpec, TypeVar

from mapvote.core.record import record
from mapvote_server import work as work_under_way
from mapvote_server.api.connections import step_aside
from mapvote_server.errors import TooMany
from mapvote_server.work import Work

Answer = TypeVar("Answer")
Given = ParamSpec("Given")

asker: ContextVar[str | None] = ContextVar("mapvote_asker", default=None)
"""The name on the key of the current request; None: no key is needed, and no budget holds."""


@record()
@dataclass(frozen=True, slots=True)
class Queues:
    """Limits of the lanes for one key."""

    waiting: int = 32
    """Requests of one key that wait in a lane with a time limit; more are refused."""
    answer_slack_s: float = 0.5
    """A client is answered this long after the time limit, even if the thread has not noticed it yet."""
    names_kept: int = 10_000
    """Budgets kept before the full ones are dropped."""


QUEUES = Queues()


class Budget:
    """Seconds of CPU and rows that each key may use: token buckets that hold one minute's worth.

    Work is charged after it was done, so a bucket can fall below zero; its key then waits until it is positive again.
    For one thread (the event loop).
    """

    def __init__(
        self, seconds_a_minute: float, rows_a_minute: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._limits = {"seconds of work": seconds_a_minute, "rows": rows_a_minute}
        self._clock = clock
        self._spent: dict[tuple[str, str], tuple[float, float]] = {}
        """A key's use of a limit, and the time of that note."""

    def check(self, name: str) -> None:
        """TooMany, with the time to wait, if a bucket of ``name`` is empty."""
        for unit, per_minute in self._limits.items():
            over = self._used(name, unit) - per_minute
            if over >= 0.0:
                message = f"{name!r} has used more than {per_minute:g} {unit} a minute: ask less often, or for less"
                raise TooMany(message, max(1.0, 60.0 * over / per_minute))

    def spend(self, name: str, seconds: float, rows: int) -> None:
        """Charge work that was done."""
        now_s = self._clock()
        for unit, used in (("seconds of work", seconds), ("rows", rows)):
            self._spent[name, unit] = self._used(name, unit) + used, now_s
        if len(self._spent) > QUEUES.names_kept:
            self._spent = {key: kept for key, kept in self._spent.items() if self._used(*key) > 0.0}

    def _used(self, name: str, unit: str) -> float:
        used, noted = self._spent.get((name, unit), (0.0, 0.0))
        return max(0.0, used - (self._clock() - noted) * self._limits[unit] / 60.0)


class Lane:
    """A few threads for one kind of work. Keys take turns, and one key has at most ``each`` threads at a time.

    ``budget`` is charged with the CPU time and the rows of the work; ``limit_s``: the time limit of one piece of work.
    Lives on one event loop.
    """

    def __init__(
        self, name: str, threads: int, *, each: int, budget: Budget | None = None, limit_s: float | None = None
    ) -> None:
        self._pool = ThreadPoolExecutor(threads, name)
        self._free = threads
        self._each = each
        self._budget = budget
        self._limit_s = limit_s
        self._running: Counter[str | None] = Counter()
        self._waiting: OrderedDict[str | None, deque[asyncio.Future[None]]] = OrderedDict()

    async def run(self, work: Callable[Given, Answer], *given: Given.args, **more: Given.kwargs) -> Answer:
        """The result of ``work``, which runs in a thread once it is this key's turn.

        TooMany if the key has used up its budget, or waits here too often already; TooSlow beyond the time limit.
        """
        name = asker.get()
        self._check(name)
        step_aside()  # the queue of this lane has an order of its own
        await self._turn(name)
        # From here on the thread gives the turn back, also if the client goes away meanwhile.
        under_way = Work(self._limit_s)
        loop = asyncio.get_running_loop()
        try:
            self._check(name)
            context = copy_context()
            context.run(work_under_way.current.set, under_way)
            done = self._pool.submit(context.run, _timed, under_way, partial(work, *given, **more))
        except BaseException:
            self._leave(name)
            raise
        done.add_done_callback(partial(self._done, loop, name, under_way))
        result = asyncio.shield(asyncio.wrap_future(done))
        if self._limit_s is None:
            return await result
        try:
            return await asyncio.wait_for(result, self._limit_s + QUEUES.answer_slack_s)
        except TimeoutError:
            raise under_way.refusal() from None

    def close(self) -> None:
        """Wait for the work under way."""
        self._pool.shutdown(cancel_futures=True)

    def _check(self, name: str | None) -> None:
        if name is not None and self._budget is not None:
            self._budget.check(name)
        limited = self._limit_s is not None and name is not None
        if limited and len(self._waiting.get(name, ())) >= QUEUES.waiting:
            raise TooMany(f"{QUEUES.waiting} requests of {name!r} wait already: wait until these are answered")

    async def _turn(self, name: str | None) -> None:
        """Wait for a free thread and for this key's turn."""
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(name, deque()).append(turn)
        self._next()
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
                self._leave(name)
            raise

    def _next(self) -> None:
        """Give the free threads to those who wait, one for each name in turn."""
        for name in list(self._waiting):
            if self._free == 0:
                return
            if name is not None and self._running[name] >= self._each:
                continue
            queue = self._waiting.pop(name)
            while queue and queue[0].done():  # its client went away
                queue.popleft()
            if queue:
                queue.popleft().set_result(None)
                self._free -= 1
                self._running[name] += 1
            if queue:
                self._waiting[name] = queue  # behind all other names

    def _done(self, loop: asyncio.AbstractEventLoop, name: str | None, under_way: Work, _: Future[Any]) -> None:
        """In the thread: tell the loop."""
        with suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(self._leave, name, under_way.cpu_s, under_way.rows)

    def _leave(self, name: str | None, seconds: float = 0.0, rows: int = 0) -> None:
        self._free += 1
        self._running[name] -= 1
        if not self._running[name]:
            del self._running[name]
        if name is not None and self._budget is not None:
            self._budget.spend(name, seconds, rows)
        self._next()


def _timed(under_way: Work, work: Callable[[], Answer]) -> Answer:
    """The result; the CPU time is noted, also of work that ends by an error."""
    under_way.begin()
    begun_s = time.thread_time()
    try:
        return work()
    finally:
        under_way.cpu_s = time.thread_time() - begun_s


def on(
    lane: Literal["vehicle", "questions", "commands", "rounds"],
) -> Callable[[Callable[Given, Answer]], Callable[Given, Awaitable[Answer]]]:
    """A route whose function runs in a thread of this lane of its ``parts``."""

    def put(route: Callable[Given, Answer]) -> Callable[Given, Awaitable[Answer]]:
        @wraps(route)
        async def run(*given: Given.args, **more: Given.kwargs) -> Answer:
            threads: Lane = getattr(more["parts"], lane)
            return await threads.run(route, *given, **more)

        return run

    return put
