"""The server as a FastAPI app on an open store."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from concurrent.futures import Executor
from contextlib import asynccontextmanager, suppress

import structlog
from anyio import to_thread
from fastapi import FastAPI

from mapvote.config import Settings
from mapvote.core.types import MapvoteError
from mapvote.server.errors import Unavailable
from mapvote.server.http import (
    ballot_route,
    cloud_routes,
    desk_routes,
    event_routes,
    health_routes,
    operator_routes,
    pages,
    store_routes,
    vehicle_routes,
)
from mapvote.server.http.auth import Guard
from mapvote.server.http.health_routes import Probe
from mapvote.server.http.schemas import unreadable
from mapvote.server.http.security import Hosts, Watch
from mapvote.server.http.services import READING, Services, make_services
from mapvote.server.http.webhook import deliver
from mapvote.server.store.round import Gate
from mapvote.server.store.store import Store

_EVERY_S = 2.0
ROUTES = (
    ballot_route,
    vehicle_routes,
    operator_routes,
    store_routes,
    desk_routes,
    cloud_routes,
    event_routes,
    health_routes,
    pages,
)


def create_app(
    store: Store,
    settings: Settings | None = None,
    *,
    opened: bool = False,
    owner: str | None = None,
    gate: Gate | None = None,
    executor: Executor | None = None,
) -> FastAPI:
    """The app on an open store, which stays the caller's to close. It runs once.

    ``opened``: as long as the store holds no key, no request needs one; else no route answers without a key.
    ``owner``: every request is that of an operator of this name, and no quota holds; only within a process
    (:func:`mapvote.server.http.in_process.in_process`).
    ``gate``: see :mod:`mapvote.server.store.publish`; ``executor``: where tiles are fused, two threads by default.
    """
    parts = make_services(store, settings or Settings(), gate, executor, limited=owner is None)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        to_thread.current_default_thread_limiter().total_tokens = READING
        beside = [keep_overview(parts), *([deliver(parts)] if parts.settings.server.webhook_url else [])]
        tasks = [asyncio.create_task(work) for work in beside]
        yield
        parts.stopping.set()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await parts.close()

    app = FastAPI(
        title="mapvote",
        version="1",
        summary="Vehicles vote on what has changed; the map follows.",
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
    )
    app.state.services = parts
    for part in ROUTES:
        # Not include_router: that takes the routes apart again at the first request, under warnings.catch_warnings,
        # which holds for one thread only. These were made when their module was imported.
        app.router.routes.extend(part.router.routes)
    app.add_exception_handler(400, unreadable)
    hosts, guard = Hosts(parts.settings.server.hosts), Guard(store, parts.threads.lookups, opened=opened, owner=owner)
    probe = Probe(parts.check_ready)
    app.add_middleware(Watch, hosts=hosts, guard=guard, metrics=parts.metrics, probe=probe)
    return app


async def keep_overview(parts: Services) -> None:
    """Make the overview of each new version, until it is cancelled; no tile is begun once the server stops."""
    known = None
    while True:
        with suppress(Unavailable):
            newest = await parts.newest.put(None)
            if newest != known:
                known = newest
                await _make(parts, newest)
        await asyncio.sleep(_EVERY_S)


async def _make(parts: Services, version: int) -> None:
    try:
        make, stop = parts.clouds.overview, parts.stopping.is_set
        await to_thread.run_sync(make, version, stop, limiter=parts.threads.fetching)
    except Unavailable:
        raise
    except MapvoteError as error:  # damage beyond a tile: a request for the overview gets this error
        structlog.get_logger("mapvote").warning("overview", version=version, error=str(error)[:200])
