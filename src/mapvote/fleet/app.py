"""The server as a FastAPI app: keys, limits, one error table, and the routes of :mod:`mapvote.fleet.routes`."""

from __future__ import annotations

import base64
import binascii
import time
from collections.abc import AsyncIterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import asynccontextmanager
from functools import partial

import structlog
from fastapi import FastAPI, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mapvote.config import Settings
from mapvote.core.types import MapvoteError
from mapvote.fleet import keys
from mapvote.fleet.batch import Batcher
from mapvote.fleet.errors import Conflict, Forbidden, Held, NotFound, TooLarge, TooMany, Unauthorised, Unavailable
from mapvote.fleet.intake import accept
from mapvote.fleet.limits import RateLimit
from mapvote.fleet.publish import Gate
from mapvote.fleet.store import Store

STATUS: Mapping[type[MapvoteError], int] = {
    Unauthorised: 401,
    Forbidden: 403,
    NotFound: 404,
    Conflict: 409,
    TooLarge: 413,
    MapvoteError: 422,
    TooMany: 429,
    Unavailable: 503,
}
"""The one error table: a class stands for its subclasses too."""
KEY_LIFE_S = 1.0
"""A key is looked up again after so long: a revoked one works no longer than this."""
log = structlog.get_logger("mapvote")


class Metrics:
    """What /metrics tells."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        counter, histogram = partial(Counter, registry=self.registry), partial(Histogram, registry=self.registry)
        self.requests = counter("mapvote_requests", "Requests answered", ["method", "status"])
        self.ballots = counter("mapvote_ballots", "Ballots acknowledged", ["result"])
        self.seconds = histogram("mapvote_request_seconds", "Time to answer", ["method"])
        self.publish_seconds = histogram("mapvote_publish_seconds", "Time to publish", buckets=(0.1, 1, 10, 60, 600))
        self.version = Gauge("mapvote_version", "Newest version", registry=self.registry)

    def text(self) -> bytes:
        """Prometheus' text format."""
        return generate_latest(self.registry)


class Guard:
    """Whose request it is. Keys come as ``Authorization: Bearer KEY``, or Basic with the key as password (browsers)."""

    def __init__(self, store: Store, required: bool) -> None:
        self._store = store
        self._required = required
        self._known: dict[str, tuple[float, keys.Key]] = {}

    async def who(self, authorization: str | None) -> keys.Key | None:
        """The key of a request; None if none is needed. Unauthorised if it is missing, unknown or revoked."""
        if not self._required:
            return None
        secret = _secret_of(authorization)
        if secret is None:
            raise Unauthorised("this server needs a key: send it as `Authorization: Bearer KEY`")
        digest, now = keys.hash_of(secret), time.monotonic()
        known = self._known.get(digest)
        if known is None or now - known[0] > KEY_LIFE_S:
            known = now, await run_in_threadpool(keys.check, self._store, secret)
            if len(self._known) > 10_000:
                self._known.clear()
            self._known[digest] = known
        return known[1]


class Watch:
    """Around every request: whose it is, how long it took, one line of log. No key, header or query is ever logged."""

    def __init__(self, app: ASGIApp, guard: Guard, metrics: Metrics) -> None:
        self._app = app
        self._guard = guard
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start, status, key = time.perf_counter(), 500, None
        request = Request(scope)

        async def watched(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            key = request.state.key = await self._guard.who(request.headers.get("authorization"))
            await self._app(scope, receive, watched)
        except MapvoteError as error:
            await _refuse(request, error)(scope, receive, watched)
        finally:
            seconds = time.perf_counter() - start
            self._metrics.requests.labels(request.method, status).inc()
            self._metrics.seconds.labels(request.method).observe(seconds)
            level = log.warning if status >= 500 else log.info
            fields = {"method": request.method, "path": request.url.path, "status": status}
            level("request", **fields, key=key.name if key else "-", ms=round(seconds * 1e3, 1))


def create_app(
    store: Store,
    settings: Settings | None = None,
    *,
    need_keys: bool = True,
    gate: Gate | None = None,
    executor: Executor | None = None,
) -> FastAPI:
    """The app on an open store, which stays the caller's to close.

    ``need_keys``: no route answers without a key. ``gate``: see :mod:`mapvote.fleet.publish`; ``executor``: where tiles
    are fused, two threads by default.
    """
    from mapvote.fleet.routes import router

    settings = settings or Settings()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        own = ThreadPoolExecutor(2, "fuse") if executor is None else None
        app.state.executor = executor or own
        app.state.batcher = Batcher(partial(accept, store), settings.server.batch)
        yield
        await app.state.batcher.close()
        if own is not None:
            own.shutdown(cancel_futures=True)

    app = FastAPI(
        title="mapvote",
        version="1",
        summary="Vehicles vote on what has changed; the map follows.",
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
    )
    app.state.store, app.state.settings, app.state.gate = store, settings, gate
    app.state.metrics = metrics = Metrics()
    app.state.limit = RateLimit(settings.server.ballots_per_minute, settings.server.burst)
    guard = Guard(store, need_keys)
    app.include_router(router)
    app.add_exception_handler(MapvoteError, _refuse)
    app.add_exception_handler(400, _unreadable)
    app.add_middleware(Watch, guard=guard, metrics=metrics)
    return app


def _refuse(request: Request, error: Exception) -> Response:
    """The answer to a MapvoteError: {"detail": what to do about it}, and the reasons of a held version."""
    status = next(STATUS[kind] for kind in type(error).__mro__ if kind in STATUS)
    content: dict[str, object] = {"detail": str(error)}
    headers = {}
    if isinstance(error, Held):
        content["reasons"] = error.reasons
    if status in (429, 503):
        headers["Retry-After"] = "1"
    response = JSONResponse(content, status, headers)
    if status == 401:  # two lines: browsers read one challenge a line, and ask for a password only for Basic
        response.headers.append("WWW-Authenticate", 'Basic realm="mapvote: the key is the password", charset="UTF-8"')
        response.headers.append("WWW-Authenticate", "Bearer")
    return response


def _unreadable(request: Request, error: Exception) -> Response:
    """A body that is no JSON at all, not even text: FastAPI answers 400, but everything unusable is 422 here."""
    return _refuse(request, MapvoteError("the body is no JSON in UTF-8"))


def _secret_of(authorization: str | None) -> str | None:
    scheme, _, value = (authorization or "").partition(" ")
    if scheme.lower() == "bearer" and value.strip():
        return value.strip()
    if scheme.lower() == "basic":
        try:
            return base64.b64decode(value, validate=True).decode().partition(":")[2] or None
        except (binascii.Error, UnicodeDecodeError):
            return None
    return None
