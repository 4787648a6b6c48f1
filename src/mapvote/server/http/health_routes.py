"""Whether the server is well: probes, health, metrics."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable

from fastapi import APIRouter, Request
from starlette.responses import Response

from mapvote.server.errors import Unavailable
from mapvote.server.http.answers import Health, Ready
from mapvote.server.http.schemas import problems
from mapvote.server.http.services import services
from mapvote.server.store.integrity import set_aside
from mapvote.server.store.store import Store

_PROBE_S = 1.0
_NAMED = 20
"""Damaged things that /readyz names; the log has all."""
router = APIRouter()


def _damaged(store: Store) -> list[str]:
    """The items in quarantine, as "kind name: why"."""
    with store.database.reading() as connection:
        return [f"{kind} {name}: {why}" for (kind, name), why in sorted(set_aside(connection).items())]


class Probe:
    """``/livez`` and ``/readyz`` for requests without a key, by any name of the server: a status without content.

    ``ready`` raises Unavailable if no ballot can be taken now. It is called at most once a second.
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


@router.get("/livez", responses=problems(), response_class=Response, summary="Does the server answer?")
async def live() -> Response:
    """200 without content. Neither this nor `/readyz` needs a key; without a key `/readyz` has no content either."""
    return Response()


@router.get("/healthz", responses=problems(), summary="Can the store be read?")
async def health(request: Request) -> Health:
    """200 with the newest version, 503 if the database does not answer."""
    return Health(status="ok", version=await services(request).newest.put(None))


@router.get("/readyz", responses=problems(), summary="Can ballots be taken in?")
async def ready(request: Request) -> Ready:
    """200 if the database can be written now; 503 with its error if not, or if the server is stopping.

    ``quarantine`` names damaged ballots and planes that were set aside. Everything else goes on.
    """
    parts = services(request)
    version, damaged = await parts.check_ready(), await parts.look_up(_damaged)
    return Ready(status="ready", version=version, quarantine=damaged[:_NAMED], quarantined=len(damaged))


@router.get("/metrics", responses=problems(), response_class=Response, summary="Prometheus metrics")
async def metrics(request: Request) -> Response:
    """Counters, latencies, the newest version."""
    parts = services(request)
    parts.metrics.version.set(await parts.newest.put(None))
    parts.metrics.tell_damaged(await parts.look_up(_damaged))
    return Response(parts.metrics.text(), media_type="text/plain; version=0.0.4; charset=utf-8")
