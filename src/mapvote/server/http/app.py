"""The server as a FastAPI app on an open store: what its parts are and how long they live."""

from __future__ import annotations

from collections.abc import AsyncIterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import asynccontextmanager

from fastapi import FastAPI

from mapvote.config import Settings
from mapvote.core.types import MapvoteError
from mapvote.server.http import operator_routes, pages, vehicle_routes
from mapvote.server.http.auth import Guard
from mapvote.server.http.batching import Batcher
from mapvote.server.http.limits import RateLimit
from mapvote.server.http.manifests import Manifests
from mapvote.server.http.metrics import Metrics, Watch
from mapvote.server.http.schemas import refuse, unreadable
from mapvote.server.store.admission import Intake
from mapvote.server.store.publish import Gate
from mapvote.server.store.store import Store

_READERS = 1024
"""Readers answered by one look at the newest version."""


def create_app(
    store: Store,
    settings: Settings | None = None,
    *,
    need_keys: bool = True,
    gate: Gate | None = None,
    executor: Executor | None = None,
) -> FastAPI:
    """The app on an open store, which stays the caller's to close.

    ``need_keys``: no route answers without a key. ``gate``: see :mod:`mapvote.server.store.publish`; ``executor``:
    where tiles are fused, two threads by default.
    """
    settings = settings or Settings()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        own = ThreadPoolExecutor(2, "fuse")
        app.state.executor = executor or own
        app.state.threads, app.state.stopping = own, False
        app.state.intake = intake = Intake(store, settings.server.settings_hash)
        app.state.examiner = Batcher(intake.look_at, settings.server.batch)
        app.state.writer = Batcher(intake.write, settings.server.batch)
        app.state.newest = Batcher(manifests.newest, _READERS)
        yield
        await app.state.examiner.close()
        await app.state.writer.close()
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
    app.state.manifests = manifests = Manifests(store)
    app.state.metrics = metrics = Metrics()
    app.state.limit = RateLimit(settings.server.ballots_per_minute, settings.server.burst)
    guard = Guard(store, need_keys)
    for part in (vehicle_routes, operator_routes, pages):
        app.include_router(part.router)
    app.add_exception_handler(MapvoteError, refuse)
    app.add_exception_handler(400, unreadable)
    app.add_middleware(vehicle_routes.StraightToVote)
    app.add_middleware(Watch, guard=guard, metrics=metrics)
    return app
