"""Many ballots, one fsync: those that arrive while one transaction is being written go into the next one together."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

from mapvote.core.types import MapvoteError
from mapvote.fleet.intake import Incoming, Receipt

Accept = Callable[[Sequence[Incoming]], Sequence[Receipt | MapvoteError]]


class Batcher:
    """Acknowledges a ballot only once the transaction that holds it is on disk. Lives on one event loop."""

    def __init__(self, accept: Accept, limit: int) -> None:
        self._accept = accept
        self._limit = limit
        self._waiting: list[tuple[Incoming, asyncio.Future[Receipt]]] = []
        self._writer: asyncio.Task[None] | None = None

    async def put(self, incoming: Incoming) -> Receipt:
        """Store one ballot; raises what was wrong with it."""
        future: asyncio.Future[Receipt] = asyncio.get_running_loop().create_future()
        self._waiting.append((incoming, future))
        if self._writer is None or self._writer.done():
            self._writer = asyncio.create_task(self._write())
        return await future

    async def close(self) -> None:
        """Wait until everything that was taken in is written."""
        while self._writer is not None and not self._writer.done():
            await self._writer

    async def _write(self) -> None:
        while self._waiting:
            some, self._waiting = self._waiting[: self._limit], self._waiting[self._limit :]
            try:
                results = await asyncio.to_thread(self._accept, [incoming for incoming, _ in some])
            except Exception as error:  # the whole transaction failed: each sender hears it
                results = [error] * len(some)  # type: ignore[list-item]
            for (_, future), result in zip(some, results, strict=True):
                if future.cancelled():
                    continue
                if isinstance(result, Exception):
                    future.set_exception(result)
                else:
                    future.set_result(result)
