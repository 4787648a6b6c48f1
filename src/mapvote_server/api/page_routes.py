"""The operator's page, the data that it draws in 3D, and the API's documentation.

Data: levels of detail, points added and deleted, votes per cell, paths.
"""

from __future__ import annotations

import hashlib
import html
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response

from mapvote.codec.manifest import TileHashes
from mapvote.codec.planes import compress
from mapvote.shapes.geojson import Places, places
from mapvote.shapes.packed_cloud import N_LEVELS
from mapvote_server.api.encodings import takes
from mapvote_server.api.etags import has_already
from mapvote_server.api.lanes import on
from mapvote_server.api.paging import BoxAsked, PartAsked
from mapvote_server.api.problems import problems
from mapvote_server.api.schemas import (
    AS_CSV,
    Digest,
    From,
    TableOrMap,
    To,
    VersionQuery,
    as_json,
    as_table,
    sends_bytes,
)
from mapvote_server.api.services import Parts, Reviewer, name_of
from mapvote_server.errors import NotFound
from mapvote_server.questions.explain import evidence
from mapvote_server.questions.vehicles import MOST_PATHS, paths

_FOR_EVER = "private, max-age=31536000, immutable"
_Index = Annotated[int, Path(ge=-(1 << 22), le=1 << 22)]
_OPEN = b"""<p class="open-server" role="alert">This server is open: every user of this machine can vote, publish and
roll back. Issue a key to close it: <code>mapvote keys STORE issue NAME --role operator</code></p>"""
_DOCS = """<!doctype html><html lang="en"><head><meta charset="utf-8"><title>mapvote API</title>
<link rel="stylesheet" href="viewer/pages.css"></head>
<body class="plain"><h1>mapvote API</h1><p>For machines: <a href=openapi.json>openapi.json</a></p>
<table><tr><th>Method<th>Path<th>What<th>How<th>Answers</tr>ROWS</table>
<h2>Errors</h2><p>Every error is a problem of RFC 9457 (<code>application/problem+json</code>): its <code>detail</code>
says what is wrong and how to mend it. The type <code>about:blank</code> means that the status says all.</p>
<h3 id=held>/docs#held</h3><p>The policy holds a version back, for the <code>reasons</code> of this error. An operator
publishes it in spite of them with <code>override</code>.</p></body></html>"""
_KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
router = APIRouter()


@router.get("/v1/clouds/overview", operation_id="get_overview", summary="A whole version, coarse", **sends_bytes(404))
@on("questions")
def overview(request: Request, parts: Parts, version: VersionQuery | None = None) -> Response:
    """All tiles in as many levels of detail as 150,000 points allow; the layout is in docs/viewer.md."""
    number = parts.store.current() if version is None else version
    return packed(request, parts.clouds.overview(number), "private, no-cache")


@router.get(
    "/v1/clouds/changed",
    operation_id="get_changed_clouds",
    summary="Points added and deleted between two versions",
    **sends_bytes(404),
)
@on("questions")
def changed(request: Request, parts: Parts, old: From, new: To) -> Response:
    """Tile by tile, two clouds each; the layout is in docs/viewer.md."""
    return packed(request, parts.clouds.changed(old, new), _FOR_EVER)


@router.get(
    "/v1/clouds/{points}/{ground}/{level}",
    operation_id="get_cloud_level",
    summary="One level of detail of a tile",
    **sends_bytes(404),
)
@on("questions")
def level_of(
    request: Request,
    parts: Parts,
    points: Digest,
    ground: Digest,
    level: Annotated[int, Path(ge=0, lt=N_LEVELS)],
    fields: Annotated[str | None, Query(pattern=r"^[0-9a-f]{64}$")] = None,
) -> Response:
    """Immutable. Levels add to one another: every point is in exactly one of the six. With the hash of the tile's
    ``fields`` the intensity of each point follows, a byte, if there is one."""
    hashes = TileHashes(points, ground, None, fields=fields)
    return packed(request, parts.clouds.levels(hashes).part(level), _FOR_EVER)


@router.get("/v1/evidence/{row}/{col}", operation_id="get_evidence", summary="Votes cell by cell", **sends_bytes(403))
@on("questions")
def evidence_of(request: Request, parts: Parts, row: _Index, col: _Index, vehicle: str | None = None) -> Response:
    """256 x 256 cells of four bytes: vehicles, days since the last one, probability of a change, most frequent state.

    The votes of one ``vehicle`` are open to reviewers and operators only.
    """
    if vehicle is not None:
        name_of(request, "reviewer", "operator")
    plane = evidence(parts.store, (row, col), vehicle)
    return packed(request, plane.tobytes(), "private, no-cache")


@router.get(
    "/v1/paths",
    operation_id="list_paths",
    response_model=Places,
    responses=problems(403) | AS_CSV,
    summary="Paths of the drives",
)
@on("questions")
def driven(
    request: Request,
    by: Reviewer,
    parts: Parts,
    part: PartAsked,
    box: BoxAsked,
    vehicle: str | None = None,
    format: TableOrMap = "json",
) -> Response:
    """Paths of standing ballots that carry one, the newest drive first, 500 at a time: GeoJSON lines in map metres; as
    ``csv`` without the lines."""
    most = min(part.limit or MOST_PATHS, MOST_PATHS)
    part = replace(part, limit=most)
    lines = paths(parts.store, vehicle, box, first=part.offset, most=most + 1).features
    shown = places(lines[:most])
    answer = as_table([line.properties for line in shown.features]) if format == "csv" else as_json(shown)
    return part.link(request, answer, part.offset + len(lines))


def packed(request: Request, data: bytes, cache: str) -> Response:
    """Bytes, compressed where the client takes it."""
    headers = {"Cache-Control": cache, "Vary": "Accept-Encoding"}
    if takes(request, "zstd"):
        data = compress(data, 1)
        headers["Content-Encoding"] = "zstd"
    return Response(data, media_type="application/octet-stream", headers=headers)


@router.get("/docs", include_in_schema=False)
async def docs(request: Request) -> Response:
    """The API on one page, from its OpenAPI document, without any script or request to elsewhere."""
    rows = []
    for path, methods in request.app.openapi()["paths"].items():
        for method, about in methods.items():
            cells = (
                method.upper(),
                path,
                about["summary"],
                about.get("description", ""),
                ", ".join(about["responses"]),
            )
            rows.append("<tr>" + "".join(f"<td>{html.escape(text)}</td>" for text in cells) + "</tr>")
    return _page(request, _DOCS.replace("ROWS", "".join(rows)).encode())


@router.get("/", include_in_schema=False)
async def index(request: Request) -> Response:
    """The operator's page."""
    return _page(request, _index())


@router.get("/viewer/{name:path}", include_in_schema=False)
async def asset(request: Request, name: str) -> Response:
    """A script or style of the operator's page."""
    served = _assets().get(name)
    if served is None or served.kind == "text/html":
        raise NotFound(f"there is no page {name[:80]!r}")
    headers = {"Cache-Control": "no-cache", "ETag": served.tag, "Vary": "Accept-Encoding"}
    if has_already(request, served.tag):
        return Response(status_code=304, headers=headers)
    if takes(request, "zstd"):
        return Response(served.packed, media_type=served.kind, headers=headers | {"Content-Encoding": "zstd"})
    return Response(served.plain, media_type=served.kind, headers=headers)


@dataclass(frozen=True, slots=True)
class _Asset:
    kind: str
    plain: bytes
    packed: bytes
    tag: str


@cache
def _assets() -> dict[str, _Asset]:
    """Every file of the page by its name; nothing else can be asked for."""
    shapes = resources.files("mapvote.shapes") / "viewer"
    assets = {}
    for home, folder in ((resources.files("mapvote_server") / "web", ""), (shapes, ""), (shapes / "vendor", "vendor/")):
        for file in home.iterdir():
            kind = _KINDS.get("." + file.name.rpartition(".")[2])
            if kind is not None:
                data = file.read_bytes()
                tag = f'"{hashlib.sha256(data).hexdigest()[:20]}"'
                assets[folder + file.name] = _Asset(kind, data, compress(data, 12), tag)
    return assets


@cache
def _index() -> bytes:
    """The operator's page, which asks for all its modules at once: each would be asked for by the one before it."""
    assets = _assets()
    left_out = "app.js", "standalone.js", "bundle.js"  # the page's own, and those of a page in a file of its own
    modules = [name for name in assets if name.endswith(".js") and name not in left_out]
    links = b"".join(
        b'<link rel="modulepreload" href="viewer/%s">' % name.encode()
        for name in sorted(modules, key=lambda name: ("/" not in name, name))
    )
    return assets["index.html"].plain.replace(b"</head>", links + b"</head>", 1)


def _page(request: Request, text: bytes) -> Response:
    """A page, with a warning at its end if the server needs no key."""
    if request.state.key is None:
        text = text.replace(b"</head>", b'<link rel="stylesheet" href="viewer/pages.css"></head>', 1).replace(
            b"</body>", _OPEN + b"</body>", 1
        )
    return Response(text, media_type="text/html", headers={"Cache-Control": "no-cache"})
