"""The parts of one running app, which its routes use: threads for each kind of work, what a client may send at a time,
counters, manifests as JSON, publishes under way; and what a key permits.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter as TallyOf
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from threading import Event, Lock
from typing import Annotated, Generic, NamedTuple, ParamSpec, TypeVar

import msgspec
from fastapi import Depends, Request
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from starlette.requests import ClientDisconnect

from mapvote.config import Settings
from mapvote.core.record import record
from mapvote.core.types import MapvoteError
from mapvote_server.api.lanes import Budget, Lane
from mapvote_server.api.probe import Probe
from mapvote_server.errors import Conflict, Forbidden, NotFound, TooLarge, TooMany, Unavailable
from mapvote_server.questions.cloud_files import CloudFiles
from mapvote_server.questions.clouds import Clouds
from mapvote_server.questions.history import Feed
from mapvote_server.store import keys
from mapvote_server.store.admission import Intake, Quota, Receipt
from mapvote_server.store.examination import Examination
from mapvote_server.store.fusion_jobs import Watched
from mapvote_server.store.integrity import KINDS
from mapvote_server.store.publish import Gate
from mapvote_server.store.store import Store

Asked = TypeVar("Asked")
Answer = TypeVar("Answer")
Given = ParamSpec("Given")


class RateLimit:
    """A token bucket for each name: ``burst`` at once, ``per_minute`` on average. For one thread (the event loop)."""

    def __init__(
        self, per_minute: float, burst: float, unit: str = "ballots", clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._unit = unit
        self._per_s = per_minute / 60.0
        self._burst = float(burst)
        self._clock = clock
        self._buckets: dict[str, tuple[float, float]] = {}

    def check(self, name: str) -> None:
        """TooMany if the bucket of ``name`` is empty; takes nothing."""
        lacking = 1.0 - self._tokens(name, self._clock())
        if lacking > 0.0:
            too_fast = f"{name!r} sends more than {self._per_s * 60:g} {self._unit} a minute: try again later"
            raise TooMany(too_fast, lacking / self._per_s)

    def take(self, name: str) -> None:
        """One request of ``name``; TooMany if its bucket is empty."""
        self.check(name)
        now_s = self._clock()
        self._buckets[name] = (self._tokens(name, now_s) - 1.0, now_s)
        if len(self._buckets) > 10_000:  # full buckets carry no information: drop them
            wait = self._burst / self._per_s
            self._buckets = {n: b for n, b in self._buckets.items() if now_s - b[1] < wait}

    def _tokens(self, name: str, now_s: float) -> float:
        tokens, then = self._buckets.get(name, (self._burst, now_s))
        return min(self._burst, tokens + (now_s - then) * self._per_s)


_SIZE_MEND = "send a shorter drive, or raise [server] max_body_bytes"


class Uploads:
    """Ballots that are being received. For one thread (the event loop).

    One has at most ``each`` bytes, all together at most ``together`` in memory. Beyond that the largest is dropped, so
    small ballots never wait for large ones. A vehicle sends at most ``AT_ONCE`` at a time.
    """

    AT_ONCE = 4

    def __init__(self, each: int, together: int) -> None:
        self._each = each
        self._together = together
        self._bytes = 0
        self._under_way: dict[_Upload, None] = {}
        self._of: TallyOf[str] = TallyOf()

    async def read(self, vehicle: str, stream: AsyncIterator[bytes], declared: str | None) -> bytes:
        """A whole body. TooLarge beyond the limit for one; TooMany if the vehicle sends more than it may at a time;
        Unavailable if this one was dropped; MapvoteError if the client disconnected."""
        if declared is not None and declared.isdigit() and int(declared) > self._each:
            raise TooLarge(f"the body has {declared[:20]} bytes, the limit is {self._each}: {_SIZE_MEND}")
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
            raise TooLarge(f"the body is larger than {self._each} bytes: {_SIZE_MEND}")

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
            batch = self._waiting[: self._limit]
            self._waiting = self._waiting[self._limit :]
            answers: Sequence[Answer | Exception]
            try:
                answers = await loop.run_in_executor(self._threads, self._work, [item for item, _ in batch])
            except Exception as error:
                answers = [error] * len(batch)
            for (_, future), answer in zip(batch, answers, strict=True):
                if future.cancelled():
                    continue
                if isinstance(answer, Exception):
                    future.set_exception(answer)
                else:
                    future.set_result(answer)


class Metrics:
    """All metrics of one server."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        counter = partial(Counter, registry=self.registry)
        histogram = partial(Histogram, registry=self.registry)
        self.requests = counter("mapvote_requests", "Requests answered", ["method", "status"])
        self.ballots = counter("mapvote_ballots", "Ballots acknowledged", ["result"])
        self.seconds = histogram("mapvote_request_seconds", "Time to answer", ["method"])
        self.publish_seconds = histogram("mapvote_publish_seconds", "Time to publish", buckets=(0.1, 1, 10, 60, 600))
        self.version = Gauge("mapvote_version", "Newest version", registry=self.registry)
        self.quarantined = Gauge("mapvote_quarantined", "Damaged, and set aside", ["kind"], registry=self.registry)

    def tell_damaged(self, damaged: Sequence[str]) -> None:
        """``damaged``: "kind name: why"."""
        counts = TallyOf(text.partition(" ")[0] for text in damaged)
        for kind in KINDS:
            self.quarantined.labels(kind).set(counts[kind])


@record()
@dataclass(frozen=True, slots=True)
class ServiceSizes:
    """Sizes of the queues between requests and the store."""

    kept: int = 16
    """Manifests that are kept."""
    batch: int = 64
    """Ballots written in one transaction at most."""
    burst: float = 0.1
    """Share of a minute's ballots that a vehicle may send at once."""
    uploads: int = 8
    """Largest bodies that fit into the memory for all ballots on their way."""
    keys: int = 256
    """Keys looked up in one query at most."""
    readers: int = 1024
    """Requests answered by one query of the newest version."""


SERVICE_SIZES = ServiceSizes()


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
        self._lock = Lock()
        self._made: dict[tuple[int, int | None], Made] = {}

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
                while len(self._made) >= SERVICE_SIZES.kept:
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
        self.done = done
        self.of = of
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
        progress = Progress(by, dry_run)
        with self._lock:
            self._rounds.append(progress)
        try:
            yield Watched(executor, progress.report)
        finally:
            with self._lock:
                self._rounds.remove(progress)

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


class Services:
    """The parts that live as long as the app, on an open store; :func:`services` gives them to a route.

    Each kind of work has its own threads (:mod:`mapvote_server.api.lanes`), so that none blocks another. ``executor``
    as in :func:`mapvote_server.api.app.create_app`. ``limited``: whether quotas and time limits hold.
    """

    def __init__(
        self, store: Store, settings: Settings, gate: Gate | None, executor: Executor | None, *, limited: bool = True
    ) -> None:
        most = settings.server
        self.store = store
        self.settings = settings
        self.gate = gate
        """Compares a version with the one before, before it is published."""
        self.lookups = ThreadPoolExecutor(2, "lookups")
        """Keys, the newest version, events: short reads before and between answers."""
        self._writing = ThreadPoolExecutor(1, "writer")
        self.budget = Budget(most.work_s_per_minute, most.rows_per_minute)
        self.vehicle = Lane("vehicle", 3, each=1, budget=self.budget)
        """Manifests, tiles and ballots."""
        question_s = most.question_s if limited else None
        self.questions = Lane("questions", 2, each=1, budget=self.budget, limit_s=question_s)
        """Answers that people read."""
        self.files = Lane("files", 1, each=1, budget=self.budget)
        """Files of whole versions: each is made once, however long that takes."""
        self.commands = Lane("commands", 2, each=1)
        """Short changes: keys, policy, votes taken back."""
        self.rounds = Lane("rounds", 4, each=2)
        """Work that fuses tiles, or reads the whole store."""
        self._fuse = ThreadPoolExecutor(1, "fuse")  # two take as long, and a third more CPU: they share the interpreter
        self.fusing = executor or self._fuse
        """The executor that fuses tiles."""
        quota = Quota(most.drives_a_day, most.tiles_a_drive, most.stored_bytes) if limited else None
        self.intake = Intake(store, quota)
        self.writer: Batcher[Examination, Receipt] = Batcher(self.intake.write, SERVICE_SIZES.batch, self._writing)
        """Writes ballots, many in one transaction."""
        self.newest: Batcher[None, int] = Batcher(
            lambda requests: [store.current()] * len(requests), SERVICE_SIZES.readers, self.lookups
        )
        """The number of the newest version, read once for all requests that wait for it."""
        self.known_keys: Batcher[str, keys.Key] = Batcher(partial(keys.check, store), SERVICE_SIZES.keys, self.lookups)
        """Whose keys these are, by their hashes; Unauthorised for those that open nothing."""
        self.right_keys: dict[str, keys.Key] = {}
        """Keys that were right when they came last, by their hashes."""
        self.manifests = Manifests(store)
        self.publishing = Publishing()
        self.clouds = Clouds(store)
        self.cloud_files = CloudFiles(store)
        self.feed = Feed(store)
        self.metrics = Metrics()
        self.limit = RateLimit(most.ballots_per_minute, max(1.0, SERVICE_SIZES.burst * most.ballots_per_minute))
        self.uploads = Uploads(most.max_body_bytes, SERVICE_SIZES.uploads * most.max_body_bytes)
        self._probe = Probe(store.database)
        self.streams: TallyOf[str] = TallyOf()
        """Streams of events under way, by the name on their key."""
        self.stopping = Event()
        """Set once the server stops."""

    async def check_ready(self) -> int:
        """The newest version, of a database that takes a writer now; Unavailable if it does not, or if the server is
        stopping."""
        if self.stopping.is_set():
            raise Unavailable("the server is stopping")
        return await self._probe.newest()

    async def look_up(self, work: Callable[Given, Answer], *given: Given.args, **more: Given.kwargs) -> Answer:
        """The result of a short read of the store, in the threads for lookups."""
        return await asyncio.get_running_loop().run_in_executor(self.lookups, partial(work, *given, **more))

    def stop_fusing(self) -> None:
        """Drop what waits to be fused; a publish under way then ends as :class:`Unavailable`."""
        self.stopping.set()
        self._fuse.shutdown(wait=False, cancel_futures=True)

    async def close(self) -> None:
        """Wait until every accepted ballot is written."""
        await self.writer.close()
        for part in (self.vehicle, self.questions, self.files, self.commands, self.rounds, self._probe):
            part.close()
        for pool in (self._fuse, self._writing, self.lookups):
            pool.shutdown(cancel_futures=True)
        self.cloud_files.close()


def services(request: Request) -> Services:
    """The parts of the app of a request."""
    parts: Services = request.app.state.services
    return parts


async def _parts(request: Request) -> Services:
    return services(request)


def own(request: Request, vehicle: str) -> str:
    """The name on a key that may change this vehicle's ballots: the vehicle within its rate, or an operator. Else
    Forbidden."""
    key: keys.Key | None = request.state.key
    if key is None:
        return vehicle
    if key.role != "operator":
        if key.role != "vehicle" or key.name != vehicle:
            raise Forbidden(f"the key of {key.name!r} cannot touch ballots of {vehicle[:64]!r}")
        services(request).limit.take(key.name)
    return key.name


async def operator(request: Request) -> str:
    """The operator's name; Forbidden for other roles."""
    return name_of(request, "operator")


async def reviewer(request: Request) -> str:
    """The name of a reviewer or an operator; Forbidden for other roles."""
    return name_of(request, "reviewer", "operator")


async def sees_names(request: Request) -> bool:
    """Whether the key permits the names of vehicles and exact times; others get pseudonyms and days."""
    key: keys.Key | None = request.state.key
    return key is None or key.role in ("reviewer", "operator")


def name_of(request: Request, *roles: keys.Role) -> str:
    """The name on a key of one of these roles; Forbidden for others."""
    key: keys.Key | None = request.state.key
    if key is None:
        return "operator"
    if key.role not in roles:
        raise Forbidden(f"only an {roles[-1]} can do this" if len(roles) == 1 else f"only a {' or '.join(roles)} can")
    return key.name


Parts = Annotated[Services, Depends(_parts)]
"""Parameters of routes. Asynchronous, as FastAPI would run a plain function in a thread of its own pool.
Routes that hundreds of vehicles ask at once look for themselves, which takes 50 us less."""
Operator = Annotated[str, Depends(operator)]
Reviewer = Annotated[str, Depends(reviewer)]
Known = Annotated[bool, Depends(sees_names)]
