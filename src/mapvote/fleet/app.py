"""The server as a FastAPI app on an open store: what its parts are and how long they live."""

from __future__ import annotations

from collections.abc import AsyncIterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import asynccontextmanager

from fastapi import FastAPI

from mapvote.config import Settings
from mapvote.core.types import MapvoteError
from mapvote.fleet import operate, pages, routes
from mapvote.fleet.answers import refuse, unreadable
from mapvote.fleet.batch import Batcher
from mapvote.fleet.guard import Guard
from mapvote.fleet.intake import Intake
from mapvote.fleet.limits import RateLimit
from mapvote.fleet.manifests import Manifests
from mapvote.fleet.publish import Gate
from mapvote.fleet.store import Store
from mapvote.fleet.watch import Metrics, Watch

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

    ``need_keys``: no route answers without a key. ``gate``: see :mod:`mapvote.fleet.publish`; ``executor``: where tiles
    are fused, two threads by default.
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
    for part in (routes, operate, pages):
        app.include_router(part.router)
    app.add_exception_handler(MapvoteError, refuse)
    app.add_exception_handler(400, unreadable)
    app.add_middleware(routes.StraightToVote)
    app.add_middleware(Watch, guard=guard, metrics=metrics)
    return app
