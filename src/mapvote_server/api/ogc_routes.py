"""OGC API - Features: the collections of :mod:`mapvote_server.questions.features` for QGIS, ArcGIS, GDAL, OWSLib.

Classes met: core, GeoJSON, HTML and OpenAPI 3.0 of Part 1; coordinate reference systems of Part 2. A wrong or an
unknown parameter is 400, as Part 1 has it.
"""

from __future__ import annotations

import gzip
import html
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode

import msgspec
from fastapi import APIRouter, Request, Response

from mapvote.core.times import utc
from mapvote_server.api.encodings import prefers_html, takes
from mapvote_server.api.lanes import on
from mapvote_server.api.ogc_document import LARGEST_PAGE, USUAL_PAGE, Media, document_at
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
    extent_of,
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
_ITEMS = ("bbox", "bbox-crs", "crs", "datetime", "limit", "offset")
router = APIRouter(include_in_schema=False)


@router.get("/ogc")
async def landing(request: Request) -> Response:
    """The first page: where the rest is."""
    _check(request)
    links = [
        *_both(request, "", Media.JSON),
        _link(request, "/api", "service-desc", Media.OPENAPI, "the API"),
        _link(request, "/api.html", "service-doc", Media.HTML, "the API for people"),
        _link(request, "/conformance", "conformance", Media.JSON, "what this server conforms to"),
        _link(request, "/collections", "data", Media.JSON, "the collections"),
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
    return Response(msgspec.json.encode(document_at(_address(request))), media_type=Media.OPENAPI)


@router.get("/ogc/api.html")
async def documentation(request: Request) -> Response:
    """The API for people."""
    _check(request)
    return _page(request, "API", document_at(_address(request))["paths"])


@router.get("/ogc/collections")
@on("questions")
def collections(request: Request, parts: Parts, with_names: Known) -> Response:
    """All that the key may see."""
    _check(request)
    place = OnEarth.of(parts.store)
    box = extent_of(parts.store, place)
    shown = [name for name, kind in COLLECTIONS.items() if with_names or not kind.for_reviewers]
    listed = [_described(request, name, place, box) for name in shown]
    links = _both(request, "/collections", Media.JSON)
    return _answer(request, {"links": links, "collections": listed, "crs": place.systems})


@router.get("/ogc/collections/{name}")
@on("questions")
def collection(request: Request, parts: Parts, with_names: Known, name: str) -> Response:
    """One of them, as it is in the list."""
    _check(request)
    _named(name, with_names)
    place = OnEarth.of(parts.store)
    return _answer(request, _described(request, name, place, extent_of(parts.store, place)))


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
    if wanted.datetime is not None:
        positions = during(source, positions, wanted.datetime)
    page = source.made(positions[wanted.offset : wanted.offset + wanted.limit])
    shown = [placed(feature, place, wanted.crs) for feature in page]
    path = f"/collections/{name}/items"
    query = dict(request.query_params)
    links = [
        *_both(request, path, Media.GEOJSON),
        _link(request, f"/collections/{name}", "collection", Media.JSON, kind.title),
    ]
    shown_as = Media.HTML if _as_page(request) else Media.GEOJSON
    after = wanted.offset + len(shown)
    if after < len(positions):
        links.append(_link(request, path, "next", shown_as, "the next page", query | {"offset": str(after)}))
    if wanted.offset > 0:
        before = query | {"offset": str(max(wanted.offset - wanted.limit, 0))}
        links.append(_link(request, path, "prev", shown_as, "the page before", before))
    counts = {"numberMatched": len(positions), "numberReturned": len(shown), "timeStamp": utc(time.time_ns())}
    answer = {"type": "FeatureCollection", "features": shown, "links": links} | counts
    return _answer(request, answer, Media.GEOJSON, {"Content-Crs": f"<{wanted.crs}>"})


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
        *_both(request, path, Media.GEOJSON),
        _link(request, f"/collections/{name}", "collection", Media.JSON, kind.title),
    ]
    shown = placed(named[0], place, query.crs) | {"links": links}
    return _answer(request, shown, Media.GEOJSON, {"Content-Crs": f"<{query.crs}>"})


@dataclass(frozen=True, slots=True)
class _Asked:
    """The parameters of a page of features."""

    limit: int
    offset: int
    crs: str
    box: list[float] | None
    box_crs: str
    datetime: str | None

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
        limit = min(_integer(query, "limit", USUAL_PAGE, 1, math.inf), LARGEST_PAGE)
        offset = _integer(query, "offset", 0, 0)
        crs = query.get("crs", CRS84)
        box_crs = query.get("bbox-crs", CRS84)
        return cls(limit, offset, crs, box, box_crs, query.get("datetime"))


def _integer(query: Mapping[str, str], name: str, usual: int, least: int, most: float = MOST) -> int:
    text = query.get(name, str(usual))
    number = int(text.lstrip("0")[:12] or "0") if text.isascii() and text.isdigit() else -1
    if not least <= number <= most:
        raise BadRequest(f"{name}: {text[:40]!r} is no number from {least} on")
    return number


def _check(request: Request, names: Sequence[str] = ()) -> None:
    unknown = [name for name in request.query_params if name not in (*names, "f")]
    if unknown:
        raise BadRequest(f"unknown parameter {unknown[0][:40]!r}; known are {', '.join([*names, 'f'])}")
    if len(request.query_params.multi_items()) > len(request.query_params):
        raise BadRequest("each parameter can be stated once")
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


def _described(request: Request, name: str, place: OnEarth, box: Sequence[float]) -> dict[str, Any]:
    """A collection; its extent, if its features lie on tiles, is the ``box`` of these."""
    path = f"/collections/{name}"
    kind = COLLECTIONS[name]
    extent = {"extent": {"spatial": {"bbox": [box], "crs": CRS84}}} if kind.on_tiles else {}
    return extent | {
        "id": name,
        "title": kind.title,
        "description": kind.description,
        "itemType": "feature",
        "crs": place.systems,
        "storageCrs": place.systems[-1],
        "links": [
            *_both(request, path, Media.JSON),
            _link(request, f"{path}/items", "items", Media.GEOJSON, "its features"),
            _link(request, f"{path}/items", "items", Media.HTML, "its features for people", {"f": "html"}),
        ],
    }


def _link(
    request: Request, path: str, rel: str, kind: str, title: str, query: Mapping[str, str] | None = None
) -> dict[str, str]:
    href = f"{_address(request)}{path}" + (f"?{urlencode(query)}" if query else "")
    return {"href": href, "rel": rel, "type": kind, "title": title}


def _both(request: Request, path: str, kind: str) -> list[dict[str, str]]:
    """Links to a page as it is and in its other form; ``kind``: the media type of its JSON."""
    is_page = _as_page(request)
    query = dict(request.query_params) if request.url.path.endswith(f"/ogc{path}") else {}
    forms = {"json": (kind, "this page as JSON"), "html": (Media.HTML, "this page for people")}
    other = "json" if is_page else "html"
    return [
        _link(request, path, "self", Media.HTML if is_page else kind, "this page", query),
        _link(request, path, "alternate", *forms[other], query | {"f": other}),
    ]


def _address(request: Request) -> str:
    """The address of the first page, as the client knows this server."""
    return f"{str(request.base_url).rstrip('/')}/ogc"


def _as_page(request: Request) -> bool:
    """Whether the client asks for HTML, by ``f`` or by Accept."""
    form = request.query_params.get("f")
    return prefers_html(request) if form is None else form == "html"


def _answer(
    request: Request, content: dict[str, Any], kind: str = Media.JSON, headers: Mapping[str, str] | None = None
) -> Response:
    """JSON, or a page if the client asks for one."""
    count_rows(1 + len(content.get("features", ())))
    sent = {"Vary": "Accept, Accept-Encoding", **(headers or {})}
    if _as_page(request):
        return _page(request, str(content.get("title", request.url.path)), content, sent)
    data = msgspec.json.encode(content)
    if takes(request, "gzip"):
        sent["Content-Encoding"] = "gzip"
        data = gzip.compress(data, 1)
    return Response(data, media_type=kind, headers=sent)


def _page(
    request: Request, title: str, content: Mapping[str, Any], headers: Mapping[str, str] | None = None
) -> Response:
    """Any answer as a page: members as a table, links to follow."""
    text = (
        f"<!doctype html><html lang=en><head><meta charset=utf-8><title>{html.escape(title)}</title>"
        f'<link rel=stylesheet href="{html.escape(request.base_url.path)}viewer/pages.css"></head>'
        f"<body class=plain><h1>{html.escape(title)}</h1>{_as_html(content)}</body></html>"
    )
    return Response(text, media_type=Media.HTML, headers=dict(headers or {}))


def _as_html(value: Any) -> str:
    if isinstance(value, Mapping):
        if "href" in value:
            return f'<a href="{html.escape(value["href"])}">{html.escape(value.get("title", value["href"]))}</a>'
        if "coordinates" in value:
            corners = msgspec.json.encode(value["coordinates"]).decode()
            return f"<details><summary>{value['type']}</summary>{corners}</details>"
        rows = (f"<tr><th>{html.escape(str(name))}<td>{_as_html(one)}" for name, one in value.items())
        return f"<table>{''.join(rows)}</table>"
    if isinstance(value, list):
        return "".join(f"<div>{_as_html(one)}</div>" for one in value)
    return html.escape(str(value))
