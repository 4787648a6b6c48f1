"""OGC API - Features: the collections of :mod:`mapvote_server.questions.features` for QGIS, ArcGIS, GDAL, OWSLib.

Classes met: core, GeoJSON, HTML and OpenAPI 3.0 of Part 1; coordinate reference systems of Part 2. A wrong or an
unknown parameter is 400, as Part 1 has it.
"""

from __future__ import annotations

import html
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode

import msgspec
from fastapi import APIRouter, Request, Response

from mapvote.core.times import utc
from mapvote_server.api.lanes import on
from mapvote_server.api.problems import PROBLEM_JSON
from mapvote_server.api.schemas import LEAST, MOST
from mapvote_server.api.services import Known, Parts, Services
from mapvote_server.errors import BadRequest, Forbidden, NotFound
from mapvote_server.questions.desk import desk
from mapvote_server.questions.features import (
    COLLECTIONS,
    CRS84,
    Collection,
    Features,
    OnEarth,
    Source,
    Whole,
    during,
    extent,
    placed,
    within,
)
from mapvote_server.store.store import Store
from mapvote_server.work import count_rows

CONFORMANCE = [
    *(
        f"http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/{name}"
        for name in ("core", "geojson", "html", "oas30")
    ),
    "http://www.opengis.net/spec/ogcapi-features-2/1.0/conf/crs",
]
_JSON, _GEOJSON, _HTML = "application/json", "application/geo+json", "text/html"
_USUAL_PAGE, _LARGEST_PAGE = 100, 10_000
"""Features of a page if no limit is stated; at most."""
_ITEMS = ("bbox", "bbox-crs", "crs", "datetime", "limit", "offset")
router = APIRouter(include_in_schema=False)


@router.get("/ogc")
async def landing(request: Request) -> Response:
    """The first page: where the rest is."""
    _check(request)
    links = [
        _link(request, "", "self", _JSON, "this page"),
        _link(request, "/api", "service-desc", "application/vnd.oai.openapi+json;version=3.0", "the API"),
        _link(request, "/api.html", "service-doc", _HTML, "the API for people"),
        _link(request, "/conformance", "conformance", _JSON, "what this server conforms to"),
        _link(request, "/collections", "data", _JSON, "the collections"),
    ]
    about = {"title": "mapvote", "description": "A point-cloud map, and what has changed in it", "links": links}
    return _answer(request, about)


@router.get("/ogc/conformance")
async def conformance(request: Request) -> Response:
    """The classes that are met."""
    _check(request)
    return _answer(request, {"conformsTo": CONFORMANCE})


@router.get("/ogc/api")
async def definition(request: Request) -> Response:
    """The API by OpenAPI 3.0."""
    _check(request)
    return Response(msgspec.json.encode(_openapi(request)), media_type="application/vnd.oai.openapi+json;version=3.0")


@router.get("/ogc/api.html")
async def documentation(request: Request) -> Response:
    """The API for people."""
    return _page("API", _openapi(request)["paths"])


@router.get("/ogc/collections")
@on("questions")
def collections(request: Request, parts: Parts, with_names: Known) -> Response:
    """All that the key may see."""
    _check(request)
    place = OnEarth.of(parts.store)
    shown = [name for name, kind in COLLECTIONS.items() if with_names or not kind.for_reviewers]
    listed = [_described(request, name, COLLECTIONS[name], place) for name in shown]
    links = [_link(request, "/collections", "self", _JSON, "the collections")]
    return _answer(request, {"links": links, "collections": listed, "crs": place.systems})


@router.get("/ogc/collections/{name}")
async def collection(request: Request, parts: Parts, with_names: Known, name: str) -> Response:
    """One of them, with its extent."""
    pending = await _pending(parts, _named(name, with_names))
    return await parts.questions.run(_collection, request, parts.store, with_names, name, pending)


def _collection(request: Request, store: Store, with_names: bool, name: str, pending: Features | None) -> Response:
    _check(request)
    kind = COLLECTIONS[name]
    place = OnEarth.of(store)
    box = extent(_features(store, kind, with_names, request, pending), place)
    about = _described(request, name, kind, place)
    if box is not None:
        about["extent"] = {"spatial": {"bbox": [box], "crs": CRS84}}
    return _answer(request, about)


@router.get("/ogc/collections/{name}/items")
async def items(request: Request, parts: Parts, with_names: Known, name: str) -> Response:
    """Its features: those that meet ``bbox`` and ``datetime``, ``limit`` of them after ``offset``."""
    pending = await _pending(parts, _named(name, with_names))
    return await parts.questions.run(_items, request, parts.store, with_names, name, pending)


def _items(request: Request, store: Store, with_names: bool, name: str, pending: Features | None) -> Response:
    kind = COLLECTIONS[name]
    place = OnEarth.of(store)
    wanted = _Asked.of(request, kind, place)
    source = _features(store, kind, with_names, request, pending)
    positions: Sequence[int] = range(len(source))
    if wanted.box is not None:
        positions = within(source, wanted.box, place, wanted.box_crs)
    if wanted.datetime:
        positions = during(source, positions, wanted.datetime)
    page = source.made(positions[wanted.offset : wanted.offset + wanted.limit])
    shown = [placed(feature, place, wanted.crs) for feature in page]
    path = f"/collections/{name}/items"
    query = dict(request.query_params)
    links = [
        _link(request, path, "self", _GEOJSON, "this page", query),
        _link(request, path, "alternate", _HTML, "this page for people", query | {"f": "html"}),
        _link(request, f"/collections/{name}", "collection", _JSON, kind.title),
    ]
    after = wanted.offset + len(shown)
    if after < len(positions):
        links.append(_link(request, path, "next", _GEOJSON, "the next page", query | {"offset": str(after)}))
    if wanted.offset > 0:
        before = query | {"offset": str(max(wanted.offset - wanted.limit, 0))}
        links.append(_link(request, path, "prev", _GEOJSON, "the page before", before))
    counts = {"numberMatched": len(positions), "numberReturned": len(shown), "timeStamp": utc(time.time_ns())}
    answer = {"type": "FeatureCollection", "features": shown, "links": links} | counts
    return _answer(request, answer, _GEOJSON, {"Content-Crs": f"<{wanted.crs}>"})


@router.get("/ogc/collections/{name}/items/{feature_id}")
async def item(request: Request, parts: Parts, with_names: Known, name: str, feature_id: str) -> Response:
    """One feature."""
    pending = await _pending(parts, _named(name, with_names))
    return await parts.questions.run(_item, request, parts.store, with_names, name, feature_id, pending)


def _item(
    request: Request, store: Store, with_names: bool, name: str, feature_id: str, pending: Features | None
) -> Response:
    kind = COLLECTIONS[name]
    place = OnEarth.of(store)
    query = _Asked.of(request, kind, place, ("crs",))
    named = _features(store, kind, with_names, request, pending).named(feature_id)
    if not named:
        raise NotFound(f"{name} has no feature {feature_id[:80]!r}")
    path = f"/collections/{name}/items/{feature_id}"
    links = [
        _link(request, path, "self", _GEOJSON, "this feature"),
        _link(request, path, "alternate", _HTML, "this feature for people", {"f": "html"}),
        _link(request, f"/collections/{name}", "collection", _JSON, kind.title),
    ]
    shown = placed(named[0], place, query.crs) | {"links": links}
    return _answer(request, shown, _GEOJSON, {"Content-Crs": f"<{query.crs}>"})


@dataclass(frozen=True, slots=True)
class _Asked:
    """The parameters of a page of features."""

    limit: int
    offset: int
    crs: str
    box: list[float] | None
    box_crs: str
    datetime: str

    @classmethod
    def of(cls, request: Request, kind: Collection, place: OnEarth, names: Sequence[str] = _ITEMS) -> _Asked:
        """BadRequest for a parameter that is unknown or wrong."""
        _check(request, [*names, *(("from", "to") if kind.of_versions else ())])
        query = request.query_params
        for name in ("crs", "bbox-crs"):
            if query.get(name, CRS84) not in place.systems:
                raise BadRequest(f"{name}: {query[name][:80]!r} is none of {', '.join(place.systems)}")
        try:
            box = [float(v) for v in query["bbox"].split(",")] if "bbox" in query else None
        except ValueError as error:
            raise BadRequest("bbox needs numbers separated by commas") from error
        limit = min(_integer(query, "limit", _USUAL_PAGE, 1), _LARGEST_PAGE)
        offset = _integer(query, "offset", 0, 0)
        crs = query.get("crs", CRS84)
        box_crs = query.get("bbox-crs", CRS84)
        return cls(limit, offset, crs, box, box_crs, query.get("datetime", ""))


def _integer(query: Mapping[str, str], name: str, usual: int, least: int) -> int:
    text = query.get(name, str(usual))
    if not text.isascii() or not text.isdigit() or not least <= int(text[:12]) <= MOST:
        raise BadRequest(f"{name}: {text[:40]!r} is no number from {least} on")
    return int(text)


def _check(request: Request, names: Sequence[str] = ()) -> None:
    unknown = [name for name in request.query_params if name not in (*names, "f")]
    if unknown:
        raise BadRequest(f"unknown parameter {unknown[0][:40]!r}; known are {', '.join([*names, 'f'])}")
    if request.query_params.get("f", "json") not in ("json", "html"):
        raise BadRequest("f is json or html")


def _named(name: str, with_names: bool) -> Collection:
    kind = COLLECTIONS.get(name)
    if kind is None:
        raise NotFound(f"no collection {name[:80]!r}; there are {', '.join(COLLECTIONS)}")
    if kind.for_reviewers and not with_names:
        raise Forbidden(f"only a reviewer or operator can see {name}")
    return kind


async def _pending(parts: Services, kind: Collection) -> Features | None:
    """The features of the desk, whose work has a lane of its own; None for every other collection."""
    if kind.features is not None:
        return None
    desk_now = await parts.rounds.run(desk, parts.store, parts.fusing, parts.gate)
    pending: Features = msgspec.to_builtins(desk_now.answer.pending.features)
    return pending


def _features(store: Store, kind: Collection, with_names: bool, request: Request, pending: Features | None) -> Source:
    """All features of a collection, in map metres; of the desk those ``pending``."""
    if kind.features is None:
        return Whole(pending or [])
    newest = store.current() if kind.of_versions else 1
    new = _integer(request.query_params, "to", newest, LEAST)
    old = _integer(request.query_params, "from", max(new - 1, LEAST), LEAST)
    return kind.features(store, with_names, old, new)


def _described(request: Request, name: str, kind: Collection, place: OnEarth) -> dict[str, Any]:
    path = f"/collections/{name}"
    return {
        "id": name,
        "title": kind.title,
        "description": kind.description,
        "itemType": "feature",
        "crs": place.systems,
        "storageCrs": place.systems[-1],
        "links": [
            _link(request, path, "self", _JSON, kind.title),
            _link(request, f"{path}/items", "items", _GEOJSON, "its features"),
            _link(request, f"{path}/items", "items", _HTML, "its features for people", {"f": "html"}),
        ],
    }


def _link(
    request: Request, path: str, rel: str, kind: str, title: str, query: Mapping[str, str] | None = None
) -> dict[str, str]:
    href = f"{str(request.base_url).rstrip('/')}/ogc{path}" + (f"?{urlencode(query)}" if query else "")
    return {"href": href, "rel": rel, "type": kind, "title": title}


def _answer(
    request: Request, content: dict[str, Any], kind: str = _JSON, headers: Mapping[str, str] | None = None
) -> Response:
    """JSON, or a page if the client asks for one by ``f`` or wants HTML above all."""
    first = request.headers.get("accept", "").partition(",")[0].partition(";")[0].strip()
    wanted = request.query_params.get("f") or ("html" if first == _HTML else "json")
    count_rows(1 + len(content.get("features", ())))
    if wanted == "html":
        return _page(str(content.get("title", request.url.path)), content)
    return Response(msgspec.json.encode(content), media_type=kind, headers=dict(headers or {}))


def _page(title: str, content: Mapping[str, Any]) -> Response:
    """Any answer as a page: members as a table, links to follow."""
    text = (
        f"<!doctype html><html lang=en><head><meta charset=utf-8><title>{html.escape(title)}</title>"
        f'<link rel=stylesheet href="/viewer/pages.css"></head><body class=plain><h1>{html.escape(title)}</h1>'
        f"{_as_html(content)}</body></html>"
    )
    return Response(text, media_type=_HTML)


def _as_html(value: Any) -> str:
    if isinstance(value, Mapping):
        if "href" in value:
            return f'<a href="{html.escape(value["href"])}">{html.escape(value.get("title", value["href"]))}</a>'
        rows = (
            f"<tr><th>{html.escape(str(name))}<td>{_as_html(one)}" for name, one in value.items() if name != "geometry"
        )
        return f"<table>{''.join(rows)}</table>"
    if isinstance(value, list):
        return "".join(f"<div>{_as_html(one)}</div>" for one in value)
    return html.escape(str(value))


def _openapi(request: Request) -> dict[str, Any]:
    """OpenAPI 3.0 of the paths above."""
    text = {"type": "string"}
    parameters = {
        "bbox": {"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 6},
        "bbox-crs": text | {"format": "uri"},
        "crs": text | {"format": "uri"},
        "datetime": text,
        "limit": {"type": "integer", "minimum": 1, "maximum": _LARGEST_PAGE, "default": _USUAL_PAGE},
        "offset": {"type": "integer", "minimum": 0, "default": 0},
    }
    query = [
        {"name": name, "in": "query", "required": False, "schema": schema, "style": "form", "explode": False}
        for name, schema in parameters.items()
    ]
    versions = [{"name": n, "in": "query", "required": False, "schema": {"type": "integer"}} for n in ("from", "to")]
    feature = [{"name": "featureId", "in": "path", "required": True, "schema": text}]

    def get(summary: str, kind: str = _JSON, parameters: Sequence[Mapping[str, Any]] = ()) -> dict[str, Any]:
        answers = {"200": {"description": summary, "content": {kind: {"schema": {"type": "object"}}}}}
        problem = {PROBLEM_JSON: {"schema": {"type": "object"}}}
        bad = {code: {"description": "refused; the body says why", "content": problem} for code in (400, 401, 404)}
        return {"get": {"summary": summary, "parameters": [*parameters], "responses": answers | bad}}

    paths = {
        "/": get("the first page"),
        "/conformance": get("what is met"),
        "/collections": get("the collections"),
    }
    for name, kind in COLLECTIONS.items():
        more = versions if kind.of_versions else []
        paths[f"/collections/{name}"] = get(kind.title)
        paths[f"/collections/{name}/items"] = get(kind.description, _GEOJSON, [*query, *more])
        paths[f"/collections/{name}/items/{{featureId}}"] = get("one feature", _GEOJSON, [*feature, query[2], *more])
    server = {"url": f"{str(request.base_url).rstrip('/')}/ogc"}
    info = {"title": "mapvote: OGC API - Features", "version": "1"}
    return {"openapi": "3.0.3", "info": info, "servers": [server], "paths": paths}
