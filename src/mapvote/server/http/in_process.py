"""The HTTP API on an open store within this process: no port, no uvicorn, no key."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

import httpx2
from anyio.from_thread import BlockingPortal, start_blocking_portal
from fastapi import FastAPI

from mapvote.config import Settings
from mapvote.server.http.app import create_app
from mapvote.server.http.services import Services
from mapvote.server.store.round import Gate
from mapvote.server.store.store import Store

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

    ``gate`` and ``executor`` as in :func:`mapvote.server.http.app.create_app`. An exception in the app that is no
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
        self._asgi, self._portal = httpx2.ASGITransport(app=app), portal

    def handle_request(self, request: httpx2.Request) -> httpx2.Response:
        return self._portal.call(self._answer, request)

    async def _answer(self, request: httpx2.Request) -> httpx2.Response:
        asked = httpx2.Request(request.method, request.url, headers=request.headers, content=request.read())
        answer = await self._asgi.handle_async_request(asked)
        encoded = b"".join([part async for part in answer.aiter_raw()])
        return httpx2.Response(answer.status_code, headers=answer.headers, content=encoded)
