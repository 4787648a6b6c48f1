"""The route that takes ballots: declared to FastAPI for OpenAPI, but handled without it.

FastAPI's handling of a request (dependencies, parsed body, response model) takes longer than all that a ballot needs,
and the ballot's decoder checks it anyway. So :class:`BallotRoute` hands the request to :func:`vote` as it came.
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
    """One ballot, on disk before the answer. 201: new; 200: it replaced one of the same drive, or was there already.

    422 if the names in the address are not those in the ballot.
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
