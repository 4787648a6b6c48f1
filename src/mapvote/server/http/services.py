"""What the routes work with: the parts of one running app, each with its type, made once."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from threading import Event
from typing import TypeVar

from anyio import CapacityLimiter
from fastapi import Request

from mapvote.config import Settings
from mapvote.server.errors import Unavailable
from mapvote.server.http.limits import RateLimit, Uploads
from mapvote.server.http.manifests import Manifests
from mapvote.server.http.metrics import Metrics
from mapvote.server.http.publishing import Publishing
from mapvote.server.http.writer import Batcher
from mapvote.server.store.admission import Intake, Quota
from mapvote.server.store.ballots import Incoming, Receipt
from mapvote.server.store.queries import current_number
from mapvote.server.store.round import Gate
from mapvote.server.store.store import Store
from mapvote.server.views.events import Feed
from mapvote.server.views.localisation_gate import gate_by
from mapvote.server.views.point_lod import Clouds

Answer = TypeVar("Answer")
READING = 1
"""Threads for whatever an operator looks at. Python computes in one thread at a time: more would only take turns with
those who answer vehicles."""
_BATCH = 64
"""Ballots written in one transaction at most."""
_BURST = 0.1
"""Share of a minute's ballots that a vehicle may send at once."""
_UPLOADS = 8
"""Largest bodies that fit into the memory for all ballots on their way."""
_READERS = 1024
"""Readers answered by one look at the newest version."""


@dataclass(frozen=True, slots=True)
class Threads:
    """Who waits for whom: each kind of work has threads of its own, so that none can take those of another.

    What is in none of these runs in FastAPI's own pool, :data:`READING` threads: whatever an operator looks at.
    """

    ballots: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(3, "ballots"))
    lookups: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(2, "lookups"))
    """Keys and the newest version: health, and what comes before every answer."""
    fuse: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(2, "fuse"))
    fetching: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(4))
    """Manifests and tiles."""
    deciding: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(4))
    """What takes seconds, as it fuses tiles or reads the whole store: publish, desk, check. No other request waits."""


@dataclass(frozen=True, slots=True)
class Services:
    """The parts that live as long as the app; a route asks for them by :func:`services`."""

    store: Store
    settings: Settings
    gate: Gate
    """Looks at a version before it is published."""
    fusing: Executor
    """Where tiles are fused."""
    threads: Threads
    intake: Intake
    writer: Batcher[Incoming, Receipt]
    """Writes ballots, many in one transaction."""
    newest: Batcher[None, int]
    """The number of the newest version, read once for all who ask at a time."""
    manifests: Manifests
    publishing: Publishing
    """Rounds under way."""
    clouds: Clouds
    """Levels of detail for the page."""
    feed: Feed
    """Events, for all who listen."""
    metrics: Metrics
    limit: RateLimit
    uploads: Uploads
    stopping: Event = field(default_factory=Event)
    """Set once the server has been told to stop."""

    async def check_ready(self) -> int:
        """The newest version, of a database that takes a writer now; Unavailable if it does not, or if the server is
        stopping."""
        if self.stopping.is_set():
            raise Unavailable("the server is stopping")
        return await self.look_up(_newest_if_writable)

    async def look_up(self, ask: Callable[[Store], Answer]) -> Answer:
        """What a short question to the store gives, asked in the threads for lookups."""
        return await asyncio.get_running_loop().run_in_executor(self.threads.lookups, ask, self.store)

    def stop_fusing(self) -> None:
        """Drop what waits to be fused; a publish under way then ends as :class:`Unavailable`."""
        self.stopping.set()
        self.threads.fuse.shutdown(wait=False, cancel_futures=True)

    async def close(self) -> None:
        """Wait until every ballot that was taken in is written."""
        await self.writer.close()
        for pool in (self.threads.fuse, self.threads.ballots, self.threads.lookups):
            pool.shutdown(cancel_futures=True)


def _newest_if_writable(store: Store) -> int:
    with store.database.writing() as connection:
        return current_number(connection)


def make_services(
    store: Store, settings: Settings, gate: Gate | None, executor: Executor | None, *, limited: bool = True
) -> Services:
    """The parts of an app on an open store; ``executor`` as in :func:`mapvote.server.http.app.create_app`.

    ``limited``: whether the quotas of vehicles hold.
    """
    manifests, threads, most = Manifests(store), Threads(), settings.server
    quota = Quota(most.drives_a_day, most.tiles_a_drive, most.stored_bytes) if limited else None
    intake = Intake(store, quota)
    return Services(
        store=store,
        settings=settings,
        gate=gate or gate_by(settings.ndt),
        fusing=executor or threads.fuse,
        threads=threads,
        intake=intake,
        writer=Batcher(intake.write, _BATCH, threads.ballots),
        newest=Batcher(manifests.newest, _READERS, threads.lookups),
        manifests=manifests,
        publishing=Publishing(),
        clouds=Clouds(store),
        feed=Feed(store),
        metrics=Metrics(),
        limit=RateLimit(most.ballots_per_minute, max(1.0, _BURST * most.ballots_per_minute)),
        uploads=Uploads(most.max_body_bytes, _UPLOADS * most.max_body_bytes),
    )


def services(request: Request) -> Services:
    """The parts of the app that a request came to."""
    found: Services = request.app.state.services
    return found
