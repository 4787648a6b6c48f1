"""Routes of vehicles: the map, its tiles, and ballots.

OpenAPI is the contract for vehicles in other languages: every answer is declared at its route."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from dataclasses import asdict, dataclass
from typing import Any

import msgspec
from fastapi import APIRouter, Request, Response
from fastapi.routing import APIRoute

from mapvote.codec.planes import unpack_bytes
from mapvote.codec.tile_planes import TILE_PLANE_SIZES
from mapvote.core.answers import answer
from mapvote_server.api.encodings import takes
from mapvote_server.api.etags import has_already
from mapvote_server.api.lanes import on
from mapvote_server.api.paging import PartAsked
from mapvote_server.api.problems import problems
from mapvote_server.api.schemas import (
    AS_BYTES,
    AS_CSV,
    AS_YOU_HAVE,
    Digest,
    ManifestAnswer,
    Name,
    Number,
    Table,
    VersionQuery,
    as_json,
    as_table,
)
from mapvote_server.api.services import Known, Parts, own, services
from mapvote_server.questions.history import DatedVersion, dated_versions
from mapvote_server.store.admission import Intake, Receipt
from mapvote_server.store.examination import Examination
from mapvote_server.store.votes import withdraw

router = APIRouter()


@router.get(
    "/v1/map",
    operation_id="get_map",
    response_model=ManifestAnswer,
    responses=problems(404) | AS_YOU_HAVE,
    summary="Manifest of the newest version",
)
async def newest(request: Request, since: VersionQuery | None = None) -> Response:
    """Tiles with the hashes of their planes; with ``since``, only what changed after that version."""
    return await _manifest(request, None, since)


@answer
@dataclass(frozen=True, slots=True)
class Versions:
    """Oldest first."""

    versions: list[DatedVersion]


@router.get(
    "/v1/map/versions",
    operation_id="list_versions",
    response_model=Versions,
    responses=problems() | AS_CSV,
    summary="All versions",
)
@on("questions")
def versions(request: Request, parts: Parts, with_names: Known, part: PartAsked, format: Table = "json") -> Response:
    """Every version, oldest first, with the policy it was made by. Only reviewers and operators see the name of the
    policy's gate drive."""
    listed = dated_versions(parts.store, with_names)
    shown = part.of(listed)
    if format == "csv":
        rows = [{name: value for name, value in asdict(one).items() if name != "policy"} for one in shown]
        return part.link(request, as_table(rows), len(listed))
    return part.link(request, as_json(Versions(shown)), len(listed))


@router.get(
    "/v1/map/versions/{number}",
    operation_id="get_version",
    response_model=ManifestAnswer,
    responses=problems(404) | AS_YOU_HAVE,
    summary="Manifest of one version",
)
async def one_version(request: Request, number: Number, since: VersionQuery | None = None) -> Response:
    """The answer of ``/v1/map`` for any version; one that does not exist is 404."""
    return await _manifest(request, number, since)


@router.get(
    "/v1/tiles/{digest}",
    operation_id="get_plane",
    responses=problems(404) | AS_YOU_HAVE | AS_BYTES,
    response_class=Response,
    summary="One plane of a tile",
)
async def plane(request: Request, digest: Digest) -> Response:
    """Raw little-endian values (of ``fields`` a msgpack map of name to type and values), zstd on the wire where the
    client takes it. Immutable: the hash is of the values."""
    headers = {
        "ETag": f'"{digest}"',
        "Cache-Control": "private, max-age=31536000, immutable",
        "Vary": "Accept-Encoding",
    }
    parts = services(request)
    data = await parts.vehicle.run(parts.store.blob, digest)
    if has_already(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    if takes(request, "zstd"):
        headers["Content-Encoding"] = "zstd"
    else:
        data = unpack_bytes(data, TILE_PLANE_SIZES.plane_bytes, "tile plane")
    return Response(data, media_type="application/octet-stream", headers=headers)


@answer
@dataclass(frozen=True, slots=True)
class Withdrawn:
    """Number of ballots."""

    withdrawn: int


@router.delete(
    "/v1/ballots/{vehicle}/{drive}",
    operation_id="withdraw_ballot",
    responses=problems(403, 404, 429),
    summary="Withdraw a ballot",
)
async def unvote(request: Request, vehicle: Name, drive: Name) -> Withdrawn:
    """Withdraw a ballot: later versions are as if it had never been cast."""
    by = own(request, vehicle)
    parts = services(request)
    return Withdrawn(withdrawn=await parts.commands.run(withdraw, parts.store, vehicle, drive, by=by))


@router.delete(
    "/v1/ballots/{vehicle}",
    operation_id="withdraw_vehicle",
    responses=problems(403, 404, 429),
    summary="Withdraw a vehicle's ballots",
)
async def unvote_all_drives(request: Request, vehicle: Name) -> Withdrawn:
    """Withdraw the ballots of all its drives."""
    by = own(request, vehicle)
    parts = services(request)
    return Withdrawn(withdrawn=await parts.commands.run(withdraw, parts.store, vehicle, by=by))


async def _manifest(request: Request, number: int | None, since: int | None) -> Response:
    parts = services(request)
    number = await parts.newest.put(None) if number is None else number
    made = parts.manifests.ready(number, since)
    if made is None:
        made = await parts.vehicle.run(parts.manifests.make, number, since)
    headers = {"ETag": made.tag, "Cache-Control": "private, no-cache"}
    if has_already(request, made.tag):
        return Response(status_code=304, headers=headers)
    return Response(made.content, media_type="application/json", headers=headers)


class BallotRoute(APIRoute):
    """The route that takes ballots: declared to FastAPI for OpenAPI, but handled without it.

    FastAPI's handling of a request (dependencies, parsed body, response model) takes longer than all that a ballot
    needs, and the ballot's decoder checks it anyway. So the request goes to :func:`vote` as it came.
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler that Starlette calls; see "Custom Request and APIRoute class" in FastAPI's documentation."""

        async def handle(request: Request) -> Response:
            return await vote(request, request.path_params["vehicle"], request.path_params["drive"])

        return handle


_SLICE_S = 0.01
"""A ballot is unpacked for so much CPU time, then other vehicles have their turn. By the clock on the wall, a small
ballot beside large ones would need several turns."""


def _open(intake: Intake, body: bytes, drive: tuple[str, str], key_hash: str | None) -> tuple[Examination, bool]:
    """A ballot that nothing in its envelope forbids, its first slice unpacked, and whether that is all; its refusal is
    raised."""
    examined = Examination(body, drive, key_hash)
    refused = intake.refuse_early(examined)
    if refused is not None:
        raise refused
    return examined, examined.go_on(_SLICE_S)


async def vote(request: Request, vehicle: Name, drive: Name) -> Response:
    """One ballot, on disk before the answer. 201: new; 200: it replaced one of the same drive, or was there already.

    422 if the names in the address are not those in the ballot.
    """
    own(request, vehicle)
    parts = services(request)
    body = await parts.uploads.read(vehicle, request.stream(), request.headers.get("content-length"))
    given = parts.intake, body, (vehicle, drive), request.state.key_hash
    examined, done = await parts.vehicle.run(_open, *given)
    while not done:  # behind the other vehicles that wait
        done = await parts.vehicle.run(examined.go_on, _SLICE_S)
    receipt = await parts.writer.put(examined)
    parts.metrics.ballots.labels(receipt.result).inc()
    created = receipt.result == "created"
    return Response(msgspec.json.encode(receipt), 201 if created else 200, media_type="application/json")


router.add_api_route(
    "/v1/ballots/{vehicle}/{drive}",
    vote,
    methods=["PUT"],
    route_class_override=BallotRoute,
    response_model=Receipt,
    responses=problems(403, 409, 413, 429) | {201: {"model": Receipt}},
    operation_id="put_ballot",
    openapi_extra={"requestBody": {"required": True, "content": AS_BYTES[200]["content"]}},
    summary="Vote",
)
