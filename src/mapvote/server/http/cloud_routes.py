"""Data of the 3D page: levels of detail, points added and deleted, votes per cell, paths."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response

from mapvote.codec.arrays import compress
from mapvote.codec.manifest import TileHashes
from mapvote.server.http.answers import Places as PlacesAnswer
from mapvote.server.http.schemas import AS_CSV, Digest, From, Places, To, VersionQuery, as_json, as_table, problems
from mapvote.server.http.services import reviewer, services
from mapvote.server.views.coverage import paths
from mapvote.server.views.explain import evidence
from mapvote.server.views.point_lod import N_LEVELS

AS_BYTES: dict[int | str, dict[str, Any]] = {200: {"content": {"application/octet-stream": {}}}}
_FOR_EVER = "private, max-age=31536000, immutable"
_Index = Annotated[int, Path(ge=-(1 << 22), le=1 << 22)]
router = APIRouter()


@router.get(
    "/v1/clouds/overview",
    responses=problems(404) | AS_BYTES,
    response_class=Response,
    summary="A whole version, coarse",
)
def overview(request: Request, version: VersionQuery | None = None) -> Response:
    """All tiles in as many levels of detail as 150,000 points allow; the layout is in docs/viewer.md."""
    parts = services(request)
    number = parts.store.current() if version is None else version
    return packed(request, parts.clouds.overview(number), "private, no-cache")


@router.get(
    "/v1/clouds/changed",
    responses=problems(404) | AS_BYTES,
    response_class=Response,
    summary="Points added and deleted between two versions",
)
def changed(request: Request, old: From, new: To) -> Response:
    """Tile by tile, two clouds each; the layout is in docs/viewer.md."""
    return packed(request, services(request).clouds.changed(old, new), _FOR_EVER)


@router.get(
    "/v1/clouds/{points}/{ground}/{level}",
    responses=problems(404) | AS_BYTES,
    response_class=Response,
    summary="One level of detail of a tile",
)
def level_of(
    request: Request,
    points: Digest,
    ground: Digest,
    level: Annotated[int, Path(ge=0, lt=N_LEVELS)],
    fields: Annotated[str | None, Query(pattern=r"^[0-9a-f]{64}$")] = None,
) -> Response:
    """Immutable. Levels add to one another: every point is in exactly one of the six. With the hash of the tile's
    ``fields`` the intensity of each point follows, a byte, if there is one."""
    hashes = TileHashes(points, ground, None, fields=fields)
    return packed(request, services(request).clouds.levels(hashes).part(level), _FOR_EVER)


@router.get(
    "/v1/evidence/{row}/{col}",
    responses=problems(403) | AS_BYTES,
    response_class=Response,
    summary="Votes cell by cell",
)
def evidence_of(request: Request, row: _Index, col: _Index, vehicle: str | None = None) -> Response:
    """256 x 256 cells of four bytes: vehicles, days since the last one, probability of a change, most frequent state.

    Of one ``vehicle`` only for reviewers and operators.
    """
    if vehicle is not None:
        reviewer(request)
    plane = evidence(services(request).store, (row, col), vehicle)
    return packed(request, plane.tobytes(), "private, no-cache")


@router.get("/v1/paths", response_model=PlacesAnswer, responses=problems(403) | AS_CSV, summary="Paths of the drives")
def driven(request: Request, vehicle: str | None = None, format: Places = "json") -> Response:
    """Paths of standing ballots that carry one, the newest drive first, 500 at most: GeoJSON lines in map metres; as
    ``csv`` without the lines."""
    reviewer(request)
    found = paths(services(request).store, vehicle)
    return as_table([feature["properties"] for feature in found["features"]]) if format == "csv" else as_json(found)


def packed(request: Request, data: bytes, cache: str) -> Response:
    """Bytes, compressed where the client takes it."""
    headers = {"Cache-Control": cache, "Vary": "Accept-Encoding"}
    if "zstd" in request.headers.get("accept-encoding", ""):
        data, headers["Content-Encoding"] = compress(data, 1), "zstd"
    return Response(data, media_type="application/octet-stream", headers=headers)
