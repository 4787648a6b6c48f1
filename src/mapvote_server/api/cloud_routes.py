"""Routes of whole versions: COPC files by ranges of bytes, and the STAC catalogue that names them."""

from __future__ import annotations

import msgspec
from fastapi import APIRouter, Request, Response

from mapvote_server.api.lanes import on
from mapvote_server.api.problems import problems
from mapvote_server.api.ranges import answer_part
from mapvote_server.api.schemas import AS_YOU_HAVE, Number
from mapvote_server.api.services import Parts
from mapvote_server.errors import NotFound
from mapvote_server.questions.catalogue import catalogue_at, collection_at, item_at
from mapvote_server.questions.cloud_files import CloudFile

router = APIRouter()


@router.get(
    "/v1/map/versions/{number}/cloud.copc.laz",
    operation_id="get_cloud_file",
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
    opened = await parts.questions.run(parts.cloud_files.ready, number)
    if opened is None:
        opened = await parts.files.run(parts.cloud_files.open, number)
    made, file = opened
    return answer_part(request, file, made.size, f'"{made.digest}"', made.media_type)


@router.get(
    "/stac",
    operation_id="get_stac_catalogue",
    responses=problems(),
    response_class=Response,
    summary="All versions as a STAC catalogue",
)
@router.get("/stac/catalog.json", include_in_schema=False)
@on("questions")
def catalogue(request: Request, parts: Parts) -> Response:
    """STAC 1.1: a link to the collection of all versions that are kept; to each, if the map's place on Earth is
    unknown."""
    return Response(msgspec.json.encode(catalogue_at(parts.store, _address(request))), media_type="application/json")


@router.get("/stac/collection.json", include_in_schema=False)
@on("questions")
def collection(request: Request, parts: Parts) -> Response:
    """STAC 1.1: where and when the versions are, and a link to the item of each that is kept."""
    address = _address(request, "collection.json")
    return Response(msgspec.json.encode(collection_at(parts.store, address)), media_type="application/json")


@router.get(
    "/stac/v{number}/v{same}.json",
    operation_id="get_stac_item",
    responses=problems(404),
    response_class=Response,
    summary="A version as a STAC item",
)
@on("questions")
def stac_item_of(request: Request, parts: Parts, number: Number, same: Number) -> Response:
    """The item that `mapvote export STORE FOLDER --stac` writes (extensions pointcloud and projection), with addresses
    of this server: the points as COPC, the changes as GeoJSON, the item that it is derived from."""
    if number != same:
        raise NotFound(f"the item of version {number} is v{number}/v{number}.json")
    item = item_at(parts.store, number, _address(request))
    return Response(msgspec.json.encode(item), media_type="application/geo+json")


def _address(request: Request, name: str = "catalog.json") -> str:
    return f"{str(request.base_url).rstrip('/')}/stac/{name}"
