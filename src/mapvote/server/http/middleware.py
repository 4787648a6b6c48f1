"""Around every request: whose it is, how long it took, and one line of log."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable

import structlog
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mapvote.core.types import MapvoteError
from mapvote.server.errors import Unavailable
from mapvote.server.http.auth import Guard
from mapvote.server.http.browsers import Hosts
from mapvote.server.http.metrics import Metrics
from mapvote.server.http.schemas import refuse

_PROBE_S = 1.0
log = structlog.get_logger("mapvote")


def is_ballot(scope: Scope) -> bool:
    """Whether a vehicle votes."""
    return bool(scope["method"] == "PUT" and scope["path"].startswith("/v1/ballots/"))


class Probe:
    """``/livez`` and ``/readyz`` for whoever has no key, by any name of the server: a status, and no content.

    ``ready`` raises Unavailable if no ballot can be taken now. It is asked once a second at most, however many ask.
    """

    PATHS = ("/livez", "/readyz")

    def __init__(self, ready: Callable[[], Awaitable[object]]) -> None:
        self._ready = ready
        self._until, self._status = 0.0, 503

    async def answer(self, path: str) -> Response:
        """200, or 503 where the server is not ready."""
        if path == "/livez":
            return Response(status_code=200)
        now = time.monotonic()
        if now >= self._until:
            self._until = now + _PROBE_S
            try:
                await self._ready()
                self._status = 200
            except Unavailable:
                self._status = 503
        return Response(status_code=self._status)


class Watch:
    """The outermost layer. No key, header or query is ever logged."""

    def __init__(self, app: ASGIApp, hosts: Hosts, guard: Guard, metrics: Metrics, probe: Probe) -> None:
        self._app = app
        self._probe = probe
        self._hosts = hosts
        self._guard = guard
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start, status, key = time.perf_counter(), 500, None

        async def watched(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            self._hosts.check(scope["headers"])
            sent = next((value for name, value in scope["headers"] if name == b"authorization"), None)
            authorization = None if sent is None else sent.decode("latin-1")
            peer = (scope["client"] or ("",))[0]
            whose = await self._guard.who(authorization, peer, ballot=is_ballot(scope))
            key, key_hash = whose or (None, None)
            scope.setdefault("state", {}).update(key=key, key_hash=key_hash)
            await self._app(scope, receive, watched)
        except MapvoteError as error:
            asks = scope["method"] in ("GET", "HEAD") and not any(n == b"authorization" for n, _ in scope["headers"])
            probed = asks and scope["path"] in Probe.PATHS
            answer = await self._probe.answer(scope["path"]) if probed else refuse(error)
            await answer(scope, receive, watched)
        except asyncio.CancelledError:  # the server stops and waits no longer
            await refuse(Unavailable("the server is stopping: ask again once it is back"))(scope, receive, watched)
        finally:
            seconds = time.perf_counter() - start
            method = scope["method"]
            counted = self._metrics.of(method, status)
            counted.requests.inc()
            counted.seconds.observe(seconds)
            tell = log.warning if status >= 500 else log.info
            name = key.name if key else "-"
            tell("request", method=method, path=scope["path"], status=status, key=name, ms=round(seconds * 1e3, 1))
