"""One piece of work for a request: how long it may take, and how many rows it answers.

:class:`Work` goes with the work into its thread. Every statement to the database and every loop over tiles calls
:func:`check_time`; answers call :func:`count_rows`. Outside a request both do nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass

from mapvote_server.errors import TooSlow


@dataclass(slots=True)
class Work:
    """One piece of work under way."""

    limit_s: float | None = None
    """Its time limit; None: it has none."""
    clock: Callable[[], float] = time.monotonic
    ends_s: float = float("inf")
    """The time limit on ``clock``, once :meth:`begin` was called."""
    rows: int = 0
    """Rows answered so far."""
    cpu_s: float = 0.0
    """CPU time of its thread, once it has ended."""

    def begin(self) -> None:
        """Start its clock."""
        if self.limit_s is not None:
            self.ends_s = self.clock() + self.limit_s

    @property
    def late(self) -> bool:
        """Whether it has used up its time."""
        return self.clock() > self.ends_s

    def refusal(self) -> TooSlow:
        """The error of work that takes too long."""
        limit = f"this takes longer than {self.limit_s:g} s ([server] question_s)"
        more = "ask again, for most answers go on from what was found, or ask for less, such as fewer versions"
        return TooSlow(f"{limit}: {more}")


current: ContextVar[Work | None] = ContextVar("mapvote_work", default=None)
"""The work of the present thread or task."""


def is_late() -> bool:
    """Whether the present work has used up its time."""
    work = current.get()
    return work is not None and work.late


def check_time() -> None:
    """TooSlow if the present work has used up its time."""
    work = current.get()
    if work is not None and work.late:
        raise work.refusal()


def remaining_s() -> float | None:
    """Seconds that the present work may still take; None without a limit."""
    work = current.get()
    return None if work is None or work.limit_s is None else max(0.001, work.ends_s - work.clock())


def count_rows(rows: int) -> None:
    """Count rows of the present work's answer."""
    work = current.get()
    if work is not None:
        work.rows += rows
