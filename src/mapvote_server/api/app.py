"""The server as a FastAPI app on an open store, for a port or within one process."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import Executor
from contextlib import asynccontextmanager, contextmanager

import httpx2
import structlog
from anyio.from_thread import BlockingPortal, start_blocking_portal
from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError

from mapvote.config import Settings
from mapvote.core.types import MapvoteError
from mapvote_server.api import (
    change_routes,
    cloud_routes,
    desk_routes,
    event_routes,
    ogc_routes,
    operator_routes,
    page_routes,
    vehicle_routes,
)
from mapvote_server.api.event_routes import deliver
from mapvote_server.api.heads import Heads
from mapvote_server.api.openapi import complete_document
from mapvote_server.api.problems import failed, not_allowed, unknown_path, unreadable, unusable
from mapvote_server.api.proxies import Proxies
from mapvote_server.api.security import Guard, Hosts, Watch
from mapvote_server.api.services import Services
from mapvote_server.errors import Unavailable
from mapvote_server.store.publish import Gate
from mapvote_server.store.store import Store

_EVERY_S = 2.0
ROUTES = (
    vehicle_routes,
    operator_routes,
    change_routes,
    cloud_routes,
    desk_routes,
    event_routes,
    page_routes,
    ogc_routes,
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
    (:func:`mapvote_server.api.app.in_process`).
    ``gate`` compares a version with the one before (:mod:`mapvote_server.gate`).
    ``executor``: where tiles are fused, two threads by default.
    """
    parts = Services(store, settings or Settings(), gate, executor, limited=owner is None)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
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
    app.add_exception_handler(RequestValidationError, unusable)
    app.add_exception_handler(404, unknown_path)
    app.add_exception_handler(405, not_allowed)
    app.add_exception_handler(Exception, failed)
    complete_document(app)
    hosts = Hosts(parts.settings.server.hosts)
    guard = Guard(parts, opened=opened, owner=owner)
    app.add_middleware(Heads)
    app.add_middleware(Watch, hosts=hosts, guard=guard, proxies=Proxies(parts.settings.server.proxies), parts=parts)
    return app


async def keep_overview(parts: Services) -> None:
    """Make the overview of each new version, until it is cancelled; no tile is begun once the server stops."""
    drawn = None
    stop = parts.stopping.is_set
    while True:
        try:
            newest = await parts.newest.put(None)
            if newest != drawn:
                drawn = newest
                await parts.rounds.run(parts.clouds.overview, newest, stop)
        except Unavailable:
            pass
        except MapvoteError as error:  # damage beyond a tile: a request for the overview gets this error
            structlog.get_logger("mapvote").warning("overview", version=drawn, error=str(error)[:200])
        await asyncio.sleep(_EVERY_S)


URL = "http://localhost"
"""The base URL of requests: the app refuses other host names."""


@contextmanager
def in_process(
    store: Store,
    settings: Settings | None = None,
    *,
    owner: str,
    gate: Gate | None = None,
    executor: Executor | None = None,
) -> Iterator[httpx2.BaseTransport]:
    """A transport whose requests the API answers within this process, for ``httpx2.Client(base_url=URL)``.

    Every request is that of an operator named ``owner``: who can open the database needs no key. Quotas and rate limits
    of vehicles do not hold. No overview is made ahead and no webhook is sent. The store stays the caller's to close.

    ``gate`` and ``executor`` as in :func:`mapvote_server.api.app.create_app`. An exception in the app that is no
    MapvoteError is raised to the caller. If the block ends by an exception (KeyboardInterrupt too), a publish under way
    is given up before its next tiles.
    """
    app = create_app(store, settings, owner=owner, gate=gate, executor=executor)
    parts: Services = app.state.services
    with start_blocking_portal("asyncio") as portal:
        try:
            yield _Transport(app, portal)
        except BaseException:
            parts.stop_fusing()
            raise
        finally:
            portal.call(parts.close)


class _Transport(httpx2.BaseTransport):
    """:class:`httpx2.ASGITransport`, which is asynchronous, for synchronous callers in any thread."""

    def __init__(self, app: FastAPI, portal: BlockingPortal) -> None:
        self._asgi = httpx2.ASGITransport(app=app)
        self._portal = portal

    def handle_request(self, request: httpx2.Request) -> httpx2.Response:
        return self._portal.call(self._answer, request)

    async def _answer(self, request: httpx2.Request) -> httpx2.Response:
        own_request = httpx2.Request(request.method, request.url, headers=request.headers, content=request.read())
        answer = await self._asgi.handle_async_request(own_request)
        encoded = b"".join([part async for part in answer.aiter_raw()])
        return httpx2.Response(answer.status_code, headers=answer.headers, content=encoded)
