"""Requests in batches: those that arrive while one batch is processed form the next.

So a hundred ballots cost one fsync, and a hundred keys one query.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Generic, TypeVar

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
