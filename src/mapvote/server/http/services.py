"""The parts of one running app, which its routes use: counters, manifests as JSON, publishes under way."""

from __future__ import annotations

import asyncio
import threading
from collections import Counter as TallyOf
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache, partial
from threading import Event, Lock
from typing import NamedTuple, TypeVar

import msgspec
from fastapi import Request
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from mapvote.config import Settings
from mapvote.server.errors import Conflict, NotFound, Unavailable
from mapvote.server.http.limits import Batcher, RateLimit, Threads, Uploads
from mapvote.server.store.admission import Intake, Quota
from mapvote.server.store.ballots import Incoming, Receipt
from mapvote.server.store.fusion_jobs import Watched
from mapvote.server.store.integrity import KINDS
from mapvote.server.store.queries import current_number
from mapvote.server.store.round import Gate
from mapvote.server.store.store import Store
from mapvote.server.views.events import Feed
from mapvote.server.views.localisation_gate import gate_by
from mapvote.server.views.point_lod import Clouds


class Metrics:
    """All metrics of one server."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        counter, histogram = partial(Counter, registry=self.registry), partial(Histogram, registry=self.registry)
        self.requests = counter("mapvote_requests", "Requests answered", ["method", "status"])
        self.ballots = counter("mapvote_ballots", "Ballots acknowledged", ["result"])
        self.seconds = histogram("mapvote_request_seconds", "Time to answer", ["method"])
        self.publish_seconds = histogram("mapvote_publish_seconds", "Time to publish", buckets=(0.1, 1, 10, 60, 600))
        self.version = Gauge("mapvote_version", "Newest version", registry=self.registry)
        self.quarantined = Gauge("mapvote_quarantined", "Damaged, and set aside", ["kind"], registry=self.registry)
        self.of = lru_cache(maxsize=256)(self._of)

    def tell_damaged(self, found: Sequence[str]) -> None:
        """``found``: "kind name: why"."""
        counts = TallyOf(text.partition(" ")[0] for text in found)
        for kind in KINDS:
            self.quarantined.labels(kind).set(counts[kind])

    def text(self) -> bytes:
        """Prometheus' text format."""
        return generate_latest(self.registry)

    def _of(self, method: str, status: int) -> Counted:
        return Counted(self.requests.labels(method, status), self.seconds.labels(method))


class Counted(NamedTuple):
    """The counters of one kind of request."""

    requests: Counter
    seconds: Histogram


_KEPT = 16


class Made(NamedTuple):
    """A manifest on its way out."""

    content: bytes
    """JSON."""
    tag: str
    """Its ETag."""


class Manifests:
    """The JSON of the manifests that were requested last; thread-safe."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._made: dict[tuple[int, int | None], Made] = {}

    def newest(self, asked: Sequence[None]) -> list[int]:
        """The newest version's number, for each of a batch of requests by one query."""
        return [self._store.current()] * len(asked)

    def ready(self, number: int, since: int | None) -> Made | None:
        """A manifest that was made before."""
        return self._made.get((number, since))

    def make(self, number: int, since: int | None) -> Made:
        """A version; ``since`` as in :meth:`Store.manifest`. NotFound if there is no such version."""
        with self._lock:  # of many requests for a new version, one makes it
            made = self._made.get((number, since))
            if made is None:
                manifest = self._store.manifest(number, since=since)
                made = Made(msgspec.json.encode(manifest), manifest.tag(since))
                while len(self._made) >= _KEPT:
                    del self._made[next(iter(self._made))]
                self._made[number, since] = made
        return made


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


Answer = TypeVar("Answer")
_BATCH = 64
"""Ballots written in one transaction at most."""
_BURST = 0.1
"""Share of a minute's ballots that a vehicle may send at once."""
_UPLOADS = 8
"""Largest bodies that fit into the memory for all ballots on their way."""
_READERS = 1024
"""Requests answered by one query of the newest version."""


@dataclass(frozen=True, slots=True)
class Services:
    """The parts that live as long as the app; :func:`services` gives them to a route."""

    store: Store
    settings: Settings
    gate: Gate
    """Compares a version with the one before, before it is published."""
    fusing: Executor
    """The executor that fuses tiles."""
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
