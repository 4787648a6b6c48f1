"""Routes of what was built and demolished between two versions."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, Field

from mapvote.shapes.geojson import Changes, Places, feature_rows
from mapvote_server.api.etags import has_already, tag_of
from mapvote_server.api.lanes import on
from mapvote_server.api.paging import BoxQuery, Part, box_in
from mapvote_server.api.problems import problems
from mapvote_server.api.schemas import (
    AS_CSV,
    AS_YOU_HAVE,
    LEAST,
    MOST,
    as_json,
    as_table,
)
from mapvote_server.api.services import Known, Parts
from mapvote_server.questions.changes import Comparison, changes_between, compare_versions, page_between
from mapvote_server.questions.lanelets import lanelets_near
from mapvote_server.store.store import Store

router = APIRouter()


class Between(BaseModel):
    """Two versions, and which of their differences."""

    old: int = Field(alias="from", ge=LEAST, le=MOST)
    new: int | None = Field(default=None, alias="to", ge=LEAST, le=MOST, description="the newest if left out")
    min_cells: int = Field(default=1, ge=1, le=100_000)


class ChangesAsked(Between):
    """A part of the list of changes."""

    lonlat: bool = Field(default=False, description="in longitude and latitude, if the map is georeferenced")
    format: Literal["geojson", "csv"] = "geojson"
    limit: int = Field(default=1_000, ge=1, le=10_000, description="so many at most, the largest first")
    offset: int = Field(default=0, ge=0, le=MOST, description="after so many")
    bbox: BoxQuery = None


@router.get(
    "/v1/changes",
    operation_id="list_changes",
    response_model=Changes,
    responses=problems(404) | AS_CSV | AS_YOU_HAVE,
    summary="What changed, as GeoJSON in map metres or as CSV",
)
@on("questions")
def changes(request: Request, parts: Parts, with_names: Known, query: Annotated[ChangesAsked, Query()]) -> Response:
    """Things built and demolished between two versions, the largest first; ``to`` is the newest by default.

    If there are more than ``limit``, the header Link names the next part.
    """
    newest = parts.store.current() if query.new is None else query.new
    headers = _headers(compare_versions(parts.store, query.old, newest), with_names, query)
    if has_already(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    part = Part(query.limit, query.offset)
    shown: dict[str, Any] = {
        "lonlat": query.lonlat,
        "with_names": with_names,
        "box": box_in(query.bbox),
        "part": part.rows,
    }
    listed = changes_between(parts.store, query.old, newest, query.min_cells, **shown)
    answer = as_table(feature_rows(listed.features)) if query.format == "csv" else as_json(listed)
    answer.headers.update(headers)
    return part.link(request, answer, listed.numberMatched, to=str(newest))


class LaneletsAsked(Between):
    """Two versions, and the distance from their differences."""

    within: float = Field(default=2.0, ge=0.0, le=100.0, description="metres, seen from above")


@router.post(
    "/v1/changes/lanelets",
    operation_id="list_affected_lanelets",
    response_model=Places,
    responses=problems(404, 413),
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/xml": {"schema": {"type": "string", "format": "binary"}}},
        }
    },
    summary="Parts of a lanelet2 map near changes",
)
async def lanelets(request: Request, parts: Parts, names: Known, choice: Annotated[LaneletsAsked, Query()]) -> Response:
    """The body is a lanelet2 map (OSM). Its lanelets, areas, stop lines and signs near what changed between two
    versions, as GeoJSON in map metres: what an editor has to look at. The map is not kept."""
    key = request.state.key
    sender = "open" if key is None else key.name
    osm = await parts.uploads.read(sender, request.stream(), request.headers.get("content-length"))
    return await parts.questions.run(_lanelets, parts.store, names, choice, osm)


def _lanelets(store: Store, names: bool, choice: LaneletsAsked, osm: bytes) -> Response:
    newest = store.current() if choice.new is None else choice.new
    listed = changes_between(store, choice.old, newest, choice.min_cells, with_names=names)
    return as_json(lanelets_near(listed, osm, choice.within))


@router.get(
    "/v1/changes/page",
    operation_id="get_changes_page",
    response_class=Response,
    responses=problems(404) | AS_YOU_HAVE | {200: {"content": {"text/html": {"schema": {"type": "string"}}}}},
    summary="What changed, as a page that needs no server",
)
@on("questions")
def changes_page(request: Request, parts: Parts, with_names: Known, query: Annotated[Between, Query()]) -> Response:
    """A file to keep or to mail: the clouds of the largest changes, before and after."""
    store = parts.store
    newest = store.current() if query.new is None else query.new
    headers = _headers(compare_versions(store, query.old, newest), with_names, query)
    if has_already(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    page = page_between(
        store, query.old, newest, changes_between(store, query.old, newest, query.min_cells, with_names=with_names)
    )
    headers["Content-Disposition"] = 'attachment; filename="changes.html"'
    return Response(page, media_type="text/html", headers=headers)


def _headers(compared: Comparison, with_names: bool, query: Between) -> dict[str, str]:
    tag = tag_of(compared.digest, with_names, query.model_dump(exclude={"new"}))
    return {"ETag": tag, "Cache-Control": "private, no-cache"}
