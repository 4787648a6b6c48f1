"""The parts of one running app, which its routes use."""

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
"""Threads for what operators read. Python computes in one thread at a time: more would only compete with the threads
that answer vehicles."""
_BATCH = 64
"""Ballots written in one transaction at most."""
_BURST = 0.1
"""Share of a minute's ballots that a vehicle may send at once."""
_UPLOADS = 8
"""Largest bodies that fit into the memory for all ballots on their way."""
_READERS = 1024
"""Requests answered by one query of the newest version."""


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
    """What takes seconds, as it fuses tiles or reads the whole store: publish, desk, check. No other request waits."""


@dataclass(frozen=True, slots=True)
class Services:
    """The parts that live as long as the app; :func:`services` gives them to a route."""

    store: Store
    settings: Settings
    gate: Gate
    """Compares a version with the one before, before it is published."""
    fusing: Executor
    """Where tiles are fused."""
    threads: Threads
    intake: Intake
    writer: Batcher[Incoming, Receipt]
    """Writes ballots, many in one transaction."""
    newest: Batcher[None, int]
    """The number of the newest version, read once for all requests that wait for it."""
    manifests: Manifests
    publishing: Publishing
    """Rounds under way."""
    clouds: Clouds
    """Levels of detail for the page."""
    feed: Feed
    """Events, for all listeners."""
    metrics: Metrics
    limit: RateLimit
    uploads: Uploads
    stopping: Event = field(default_factory=Event)
    """Set once the server stops."""

    async def check_ready(self) -> int:
        """The newest version, of a database that takes a writer now; Unavailable if it does not, or if the server is
        stopping."""
        if self.stopping.is_set():
            raise Unavailable("the server is stopping")
        return await self.look_up(_newest_if_writable)

    async def look_up(self, ask: Callable[[Store], Answer]) -> Answer:
        """The result of a short question to the store, in the threads for lookups."""
        return await asyncio.get_running_loop().run_in_executor(self.threads.lookups, ask, self.store)

    def stop_fusing(self) -> None:
        """Drop what waits to be fused; a publish under way then ends as :class:`Unavailable`."""
        self.stopping.set()
        self.threads.fuse.shutdown(wait=False, cancel_futures=True)

    async def close(self) -> None:
        """Wait until every accepted ballot is written."""
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
    """The parts of the app of a request."""
    found: Services = request.app.state.services
    return found
