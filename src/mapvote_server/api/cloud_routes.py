"""Routes of whole versions for viewers and catalogues: COPC files by ranges of bytes."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from mapvote_server.api.ranges import answer_part
from mapvote_server.api.schemas import AS_YOU_HAVE, Number, problems
from mapvote_server.api.services import Parts, Services
from mapvote_server.questions.cloud_files import CloudFile

router = APIRouter()


@router.get(
    "/v1/map/versions/{number}/cloud.copc.laz",
    responses=problems(404, 416)
    | AS_YOU_HAVE
    | {
        200: {"content": {CloudFile.media_type: {}}},
        206: {"description": "the bytes that Range names", "content": {CloudFile.media_type: {}}},
    },
    response_class=Response,
    summary="A version as COPC, by ranges of bytes",
)
async def cloud(request: Request, parts: Parts, number: Number) -> Response:
    """A file that viewers read a place and a level of detail at a time (Range, RFC 9110). Every point has its class,
    its intensity if the map has one, the version that brought it, and the vehicles that voted for it. The first request
    for a version makes the file."""
    return await _cloud(request, parts, number)


@router.head("/v1/map/versions/{number}/cloud.copc.laz", include_in_schema=False)
async def cloud_head(request: Request, parts: Parts, number: Number) -> Response:
    """Size and tag of the same file."""
    return await _cloud(request, parts, number)


async def _cloud(request: Request, parts: Services, number: int) -> Response:
    opened = await parts.questions.run(parts.cloud_files.ready, number)
    if opened is None:
        opened = await parts.files.run(parts.cloud_files.open, number)
    made, file = opened
    return answer_part(request, file, made.size, f'"{made.digest}"', made.media_type)
