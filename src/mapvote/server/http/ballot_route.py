"""The vehicle's vote: one ASGI route. FastAPI documents it, but reads nothing of its requests.

What FastAPI does for a request (dependencies, a parsed body, a response model) takes longer than everything that a
ballot needs, and a ballot is checked by its own decoder anyway. So :class:`BallotRoute` keeps FastAPI's declaration,
for OpenAPI, and hands the request to :func:`vote` as it came. There is no second way in.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import msgspec
from fastapi import APIRouter, Request, Response
from fastapi.routing import APIRoute

from mapvote.server.http.answers import Stored
from mapvote.server.http.auth import own
from mapvote.server.http.schemas import Name, problems
from mapvote.server.http.services import services
from mapvote.server.store.admission import Sent, sound

_BYTES: dict[str, Any] = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}


class BallotRoute(APIRoute):
    """A route whose requests go straight to :func:`vote`."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """What Starlette calls; see "Custom Request and APIRoute class" in FastAPI's documentation."""

        async def handle(request: Request) -> Response:
            return await vote(request, request.path_params["vehicle"], request.path_params["drive"])

        return handle


router = APIRouter(route_class=BallotRoute)


@router.put(
    "/v1/ballots/{vehicle}/{drive}",
    response_model=Stored,
    responses=problems(403, 409, 413, 429) | {201: {"model": Stored}},
    openapi_extra={"requestBody": {"required": True, "content": _BYTES}},
    summary="Vote",
)
async def vote(request: Request, vehicle: Name, drive: Name) -> Response:
    """One ballot. 201: stored; 200: it replaced the same drive's, or stood already. On disk once answered.

    The names need no check of their own: a ballot whose header does not bear the very same is refused (422).
    """
    own(request, vehicle)
    parts = services(request)
    body = await parts.uploads.read(vehicle, request.stream(), request.headers.get("content-length"))
    sent = Sent(body, vehicle, drive, request.state.key_hash)
    incoming = await asyncio.get_running_loop().run_in_executor(parts.threads.ballots, sound, sent)
    receipt = await parts.writer.put(incoming)
    result = "repeated" if receipt.repeated else "created" if receipt.created else "replaced"
    parts.metrics.ballots.labels(result).inc()
    answer = msgspec.json.encode({"vehicle": vehicle, "drive": drive, "result": result})
    return Response(answer, 201 if receipt.created else 200, media_type="application/json")
