"""Around every request: whose it is, how long it took, and one line of log."""

from __future__ import annotations

import asyncio
import time

import structlog
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mapvote.core.types import MapvoteError
from mapvote.server.errors import Unavailable
from mapvote.server.http.auth import Guard
from mapvote.server.http.browsers import Hosts
from mapvote.server.http.metrics import Metrics
from mapvote.server.http.schemas import refuse

log = structlog.get_logger("mapvote")


def is_ballot(scope: Scope) -> bool:
    """Whether a vehicle votes."""
    return bool(scope["method"] == "PUT" and scope["path"].startswith("/v1/ballots/"))


class Watch:
    """The outermost layer. No key, header or query is ever logged."""

    def __init__(self, app: ASGIApp, hosts: Hosts, guard: Guard, metrics: Metrics) -> None:
        self._app = app
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
            await refuse(error)(scope, receive, watched)
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
