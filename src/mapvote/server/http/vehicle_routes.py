"""What vehicles ask (DESIGN 5): the map, its tiles, and to vote.

OpenAPI is the contract for vehicles in other languages: every answer is declared at its route, here, in ``operate`` and
in ``pages``.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from backports import zstd
from fastapi import APIRouter, Path, Request, Response
from fastapi.concurrency import run_in_threadpool
from starlette.types import ASGIApp, Receive, Scope, Send

from mapvote.server.http.auth import own
from mapvote.server.http.limits import read_body
from mapvote.server.http.schemas import Name, Number, Stored, VersionQuery, iso, problems
from mapvote.server.store.admission import Intake, Sent
from mapvote.server.store.ballots import Incoming, withdraw

_BYTES: dict[str, Any] = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
_AS_YOU_HAVE: dict[int | str, dict[str, Any]] = {304: {"description": "as you have"}}
_SMALL_BYTES = 1 << 18
"""Ballots up to this size are examined many at once; a larger one would keep them waiting."""
router = APIRouter()


@router.get(
    "/v1/map",
    response_model=dict[str, Any],
    responses=problems(404) | _AS_YOU_HAVE,
    summary="Manifest of the newest version",
)
async def newest(request: Request, since: VersionQuery | None = None) -> Response:
    """Tiles with the hashes of their planes; with ``since``, only what changed after that version."""
    return await _manifest(request, None, since)


@router.get("/v1/map/versions", responses=problems(), summary="All versions")
def versions(request: Request) -> dict[str, Any]:
    """Every version, oldest first, with the policy it was made by."""
    listed = []
    for v in request.app.state.store.versions():
        entry = {name: getattr(v, name) for name in ("number", "parent", "kind", "target", "published_by", "reason")}
        listed.append(entry | {"created": iso(v.created_ns), "policy": v.policy})
    return {"versions": listed}


@router.get(
    "/v1/map/versions/{number}",
    response_model=dict[str, Any],
    responses=problems(404) | _AS_YOU_HAVE,
    summary="Manifest of one version",
)
async def one_version(request: Request, number: Number, since: VersionQuery | None = None) -> Response:
    """As ``/v1/map``, of any version; one that does not exist is 404."""
    return await _manifest(request, number, since)


@router.get(
    "/v1/tiles/{digest}",
    responses=problems(404) | _AS_YOU_HAVE | {200: {"content": {"application/octet-stream": {}}}},
    response_class=Response,
    summary="One plane of a tile",
)
def plane(request: Request, digest: Annotated[str, Path(pattern=r"^[0-9a-f]{64}$")]) -> Response:
    """Raw little-endian values, zstd on the wire where the client takes it. Immutable: the hash is of the values."""
    headers = {
        "ETag": f'"{digest}"',
        "Cache-Control": "private, max-age=31536000, immutable",
        "Vary": "Accept-Encoding",
    }
    data = request.app.state.store.blob(digest)
    if request.headers.get("if-none-match") == f'"{digest}"':
        return Response(status_code=304, headers=headers)
    if "zstd" in request.headers.get("accept-encoding", ""):
        headers["Content-Encoding"] = "zstd"
    else:
        data = zstd.decompress(data)
    return Response(data, media_type="application/octet-stream", headers=headers)


@router.put(
    "/v1/ballots/{vehicle}/{drive}",
    response_model=Stored,
    responses=problems(403, 409, 413, 429) | {201: {"model": Stored}},
    openapi_extra={"requestBody": {"required": True, "content": _BYTES}},
    summary="Vote",
)
async def vote(request: Request, vehicle: Name, drive: Name) -> Response:
    """One ballot. 201: stored; 200: it replaced the same drive's, or stood already. On disk once answered."""
    own(request, vehicle)
    state = request.app.state
    limit = state.settings.server.max_body_bytes
    body = await read_body(request.stream(), request.headers.get("content-length"), limit)
    sent = Sent(body, vehicle, drive, request.state.key_hash)
    incoming = await (state.examiner.put(sent) if len(body) <= _SMALL_BYTES else _apart(state.intake, sent))
    receipt = await state.writer.put(incoming)
    result = "repeated" if receipt.repeated else "created" if receipt.created else "replaced"
    state.metrics.ballots.labels(result).inc()
    answer = msgspec.json.encode({"vehicle": vehicle, "drive": drive, "result": result})
    return Response(answer, 201 if receipt.created else 200, media_type="application/json")


async def _apart(intake: Intake, sent: Sent) -> Incoming:
    (found,) = await run_in_threadpool(intake.look_at, [sent])
    if isinstance(found, Exception):
        raise found
    return found


class StraightToVote:
    """A layer that takes ballots to :func:`vote` itself: FastAPI's way there costs more than all that ``vote`` does."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        parts = scope["path"].split("/") if scope["type"] == "http" and scope["method"] == "PUT" else []
        if parts[:3] != ["", "v1", "ballots"] or len(parts) != 5:
            await self._app(scope, receive, send)
            return
        response = await vote(Request(scope, receive), *parts[3:])
        await response(scope, receive, send)


@router.delete("/v1/ballots/{vehicle}/{drive}", responses=problems(403, 404, 429), summary="Un-vote")
async def unvote(request: Request, vehicle: Name, drive: Name) -> dict[str, int]:
    """Withdraw a ballot: what is published later is as if it had never been cast."""
    by = own(request, vehicle)
    return {"withdrawn": await run_in_threadpool(withdraw, request.app.state.store, vehicle, drive, by=by)}


async def _manifest(request: Request, number: int | None, since: int | None) -> Response:
    state = request.app.state
    number = await state.newest.put(None) if number is None else number
    etag = f'"{number}"' if since is None else f'"{number}-{since}"'
    headers = {"ETag": etag, "Cache-Control": "private, no-cache"}
    content = state.manifests.ready(number, since) or await run_in_threadpool(state.manifests.make, number, since)
    if request.headers.get("if-none-match") == etag:
        return Response(status_code=304, headers=headers)
    return Response(content, media_type="application/json", headers=headers)
