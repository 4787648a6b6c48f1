"""Whether ballots can be taken in: a look at the database on a connection and a thread of its own."""

from __future__ import annotations

import asyncio
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from mapvote.core.record import record
from mapvote_server.errors import Unavailable
from mapvote_server.store.database import Database
from mapvote_server.store.queries import current_number


@record()
@dataclass(frozen=True, slots=True)
class Probing:
    """How the database is probed."""

    wait_s: float = 0.5
    """A writer that gets no turn within this time cannot write now."""
    kept_s: float = 1.0
    """An answer holds for all who ask within this time."""


PROBING = Probing()


class Probe:
    """Tries to write to the store. One look is under way at a time; all who ask meanwhile get its answer.

    It has its own connection and thread: a probe that waits for the database delays nothing else.
    """

    def __init__(self, database: Database, numbers: Probing = PROBING) -> None:
        self._database = Database(database.url, timeout_s=numbers.wait_s)
        self._numbers = numbers
        self._thread = ThreadPoolExecutor(1, "probe")
        self._look: asyncio.Future[int] | None = None
        self._looked_s = float("-inf")

    async def newest(self) -> int:
        """The newest version; Unavailable if nothing can be written now."""
        if self._look is None or (self._look.done() and time.monotonic() - self._looked_s > self._numbers.kept_s):
            self._look = asyncio.get_running_loop().run_in_executor(self._thread, self._try)
            self._look.add_done_callback(self._note)
        return await asyncio.shield(self._look)

    def close(self) -> None:
        """End its thread and its connection."""
        self._thread.shutdown(cancel_futures=True)
        self._database.close()

    def _try(self) -> int:
        try:
            with self._database.writing() as connection:
                return current_number(connection)
        except Unavailable as error:
            raise Unavailable(f"no ballot can be written now: {error}") from error

    def _note(self, look: asyncio.Future[int]) -> None:
        self._looked_s = time.monotonic()
        if not look.cancelled():
            look.exception()  # nobody may have waited for it
