"""Publishes under way: their progress, and how to cancel them."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Lock

from mapvote.server.errors import Conflict, NotFound
from mapvote.server.store.fusion_jobs import Watched


@dataclass(slots=True)
class Progress:
    """One publish or dry run."""

    by: str
    dry_run: bool
    done: int = 0
    """Tiles fused so far."""
    of: int = 0
    cancelled_by: str | None = None

    def report(self, done: int, of: int) -> None:
        """Note how many tiles are done. Conflict, with the name, once an operator has cancelled the publish."""
        self.done, self.of = done, of
        if self.cancelled_by is not None:
            raise Conflict(f"cancelled by {self.cancelled_by} after {done} of {of} tiles: nothing was published")


@dataclass(frozen=True, slots=True)
class Publishing:
    """All rounds under way in this server; thread-safe."""

    _rounds: list[Progress] = field(default_factory=list)
    _lock: Lock = field(default_factory=Lock)

    @contextmanager
    def watched(self, executor: Executor, by: str, dry_run: bool) -> Iterator[Executor]:
        """An executor for one round, which can be seen and cancelled as long as it lasts."""
        mine = Progress(by, dry_run)
        with self._lock:
            self._rounds.append(mine)
        try:
            yield Watched(executor, mine.report)
        finally:
            with self._lock:
                self._rounds.remove(mine)

    def now(self) -> list[Progress]:
        """The rounds under way, oldest first."""
        with self._lock:
            return list(self._rounds)

    def cancel(self, by: str) -> int:
        """Stop every publish under way before its next tiles; how many. Dry runs go on. NotFound if there is none."""
        stopped = [one for one in self.now() if not one.dry_run]
        if not stopped:
            raise NotFound("nothing is being published")
        for one in stopped:
            one.cancelled_by = by
        return len(stopped)
