"""The routes (DESIGN 5). OpenAPI is the contract for vehicles in other languages: every answer is declared here."""

from __future__ import annotations

import html
from dataclasses import asdict
from datetime import UTC, datetime
from importlib import resources
from typing import Annotated, Any

from backports import zstd
from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, ConfigDict, Field

from mapvote.config import FuseSettings
from mapvote.core.ballot import tile_key
from mapvote.core.types import MapvoteError
from mapvote.fleet.errors import Forbidden, NotFound
from mapvote.fleet.explain import changes_between, coverage, explain_cell, vehicle_standings
from mapvote.fleet.intake import examine, withdraw
from mapvote.fleet.limits import read_body
from mapvote.fleet.publish import publish, rollback
from mapvote.fleet.store import Manifest, Store

_LEAST, _MOST = -(1 << 31), (1 << 31) - 1
"""What a database can compare a version's number with."""
_PLAIN = r"^[^\x00-\x1f]*$"
"""No control characters: PostgreSQL stores no NUL."""


class Problem(BaseModel):
    """What went wrong, and how to mend it."""

    detail: Any
    reasons: list[str] | None = None


class Stored(BaseModel):
    """A ballot is on disk."""

    vehicle: str
    drive: str
    result: str = Field(description="created, replaced, or repeated: the very same ballot stood already")


class PublishAsk(BaseModel):
    """How to publish; an empty object publishes what stands."""

    model_config = ConfigDict(extra="forbid")
    dry_run: bool = False
    override: bool = Field(default=False, description="publish in spite of the reasons to hold it")
    parent: int | None = Field(
        default=None, ge=_LEAST, le=_MOST, description="only if this is still the newest version"
    )
    reason: str = Field(default="", max_length=200, pattern=_PLAIN)
    min_votes: int | None = Field(default=None, ge=1, le=1000, description="instead of the server's setting")


class Published(BaseModel):
    """What a publish did, or would do."""

    version: int
    published: bool
    tiles: list[str]
    points_added: int
    points_deleted: int
    held: list[str]


class RollbackAsk(BaseModel):
    """Which version shall be the map again."""

    model_config = ConfigDict(extra="forbid")
    to: int = Field(ge=_LEAST, le=_MOST)
    reason: str = Field(default="", max_length=200, pattern=_PLAIN)


def _problems(*codes: int) -> dict[int | str, dict[str, Any]]:
    return {code: {"model": Problem} for code in (401, 422, 503, *codes)}


Name = Annotated[str, Path(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
Number = Annotated[int, Path(ge=-(1 << 31), lt=1 << 31)]
VersionQuery = Annotated[int, Query(ge=-(1 << 31), lt=1 << 31)]
_BYTES: dict[str, Any] = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
_DOCS = """<!doctype html><meta charset=utf-8><title>mapvote API</title>
<style>body{font:15px sans-serif;margin:2em}td,th{padding:.4em .8em;text-align:left;border-top:1px solid #ccc}</style>
<h1>mapvote API</h1><p>For machines: <a href=openapi.json>openapi.json</a></p>
<table><tr><th>Method<th>Path<th>What<th>How<th>Answers</tr>ROWS</table>"""
_MOST_EVIDENCE = 50
router = APIRouter()


@router.get("/v1/map", responses=_problems(404), summary="Manifest of the newest version")
def newest(request: Request, since: VersionQuery | None = None) -> dict[str, Any]:
    """Tiles with the hashes of their planes; with ``since``, only what changed after that version."""
    return _manifest(_store(request).manifest(since=since))


@router.get("/v1/map/versions", responses=_problems(), summary="All versions")
def versions(request: Request) -> dict[str, Any]:
    """Every version, oldest first, with the policy it was made by."""
    listed = []
    for v in _store(request).versions():
        entry = {name: getattr(v, name) for name in ("number", "parent", "kind", "target", "published_by", "reason")}
        listed.append(entry | {"created": iso(v.created_ns), "policy": v.policy})
    return {"versions": listed}


@router.get("/v1/map/versions/{number}", responses=_problems(404), summary="Manifest of one version")
def one_version(request: Request, number: Number, since: VersionQuery | None = None) -> dict[str, Any]:
    """As ``/v1/map``, of any version; one that does not exist is 404."""
    return _manifest(_store(request).manifest(number, since=since))


@router.get(
    "/v1/tiles/{digest}",
    responses=_problems(404)
    | {200: {"content": {"application/octet-stream": {}}}, 304: {"description": "as you have"}},
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
    data = _store(request).blob(digest)
    if request.headers.get("if-none-match") == f'"{digest}"':
        return Response(status_code=304, headers=headers)
    if "zstd" in request.headers.get("accept-encoding", ""):
        headers["Content-Encoding"] = "zstd"
    else:
        data = zstd.decompress(data)
    return Response(data, media_type="application/octet-stream", headers=headers)


@router.put(
    "/v1/ballots/{vehicle}/{drive}",
    responses=_problems(403, 409, 413, 429) | {201: {"model": Stored}},
    openapi_extra={"requestBody": {"required": True, "content": _BYTES}},
    summary="Vote",
)
async def vote(request: Request, response: Response, vehicle: Name, drive: Name) -> Stored:
    """One ballot. 201: stored; 200: it replaced the same drive's, or stood already. On disk once answered."""
    _own(request, vehicle)
    state = request.app.state
    limit = state.settings.server.max_body_bytes
    body = await read_body(request.stream(), request.headers.get("content-length"), limit)
    incoming = examine(body) if len(body) < 32_768 else await run_in_threadpool(examine, body)
    if (incoming.ballot.vehicle, incoming.ballot.drive) != (vehicle, drive):
        raise MapvoteError(f"the ballot is of {incoming.ballot.vehicle}/{incoming.ballot.drive}, not {vehicle}/{drive}")
    receipt = await state.batcher.put(incoming)
    result = "repeated" if receipt.repeated else "created" if receipt.created else "replaced"
    state.metrics.ballots.labels(result).inc()
    response.status_code = 201 if receipt.created else 200
    return Stored(vehicle=vehicle, drive=drive, result=result)


@router.delete("/v1/ballots/{vehicle}/{drive}", responses=_problems(403, 404, 429), summary="Un-vote")
async def unvote(request: Request, vehicle: Name, drive: Name) -> dict[str, int]:
    """Withdraw a ballot: what is published later is as if it had never been cast."""
    by = _own(request, vehicle)
    return {"withdrawn": await run_in_threadpool(withdraw, _store(request), vehicle, drive, by=by)}


@router.post("/v1/publish", responses=_problems(403, 409), summary="Publish the next version")
def publish_now(request: Request, ask: PublishAsk) -> Published:
    """Fuse what stands. 409 with the reasons if the policy holds it, or if somebody else published first."""
    by = _operator(request)
    state = request.app.state
    policy: FuseSettings = state.settings.fuse
    if ask.min_votes is not None:
        policy = policy.model_copy(update={"min_votes": ask.min_votes})
    with state.metrics.publish_seconds.time():
        done = publish(
            _store(request),
            policy,
            by=by,
            reason=ask.reason,
            parent=ask.parent,
            dry_run=ask.dry_run,
            override=ask.override,
            gate=state.gate,
            executor=state.executor,
        )
    tiles = [tile_key(tile) for tile in done.tiles]
    return Published(
        version=done.version,
        published=done.published,
        tiles=tiles,
        points_added=done.added,
        points_deleted=done.deleted,
        held=list(done.held),
    )


@router.post("/v1/rollback", responses=_problems(403, 404, 409), summary="Go back to an older version")
def roll_back(request: Request, ask: RollbackAsk) -> dict[str, int]:
    """A new version that is the old one again; the votes that led away from it are barred."""
    by = _operator(request)
    return {"version": rollback(_store(request), ask.to, by=by, reason=ask.reason).number}


@router.get("/v1/changes", responses=_problems(404), summary="What changed, as GeoJSON in map metres")
def changes(
    request: Request,
    old: Annotated[int, Query(alias="from", ge=-(1 << 31), lt=1 << 31)],
    new: Annotated[int | None, Query(alias="to", ge=-(1 << 31), lt=1 << 31)] = None,
    min_cells: Annotated[int, Query(ge=1, le=100_000)] = 1,
) -> dict[str, Any]:
    """Objects built and demolished between two versions; ``to`` is the newest by default."""
    store = _store(request)
    return changes_between(store, old, store.current() if new is None else new, min_cells)


@router.get("/v1/cells", responses=_problems(), summary="The votes behind one cell")
def cell(request: Request, x: float, y: float) -> dict[str, Any]:
    """Who says what about the cell at (x, y), map metres, whether it counts, and what was decided when."""
    story = explain_cell(_store(request), x, y, request.app.state.settings.fuse)
    votes = [
        {
            "vehicle": v.vehicle,
            "drive": v.drive,
            "state": v.state,
            "end": iso(v.end_ns),
            "counts": v.counts,
            "why": v.why,
        }
        for v in story.votes
    ]
    decisions = [{"version": version, "state": state} for version, state in story.decisions]
    return {"row": story.row, "col": story.col, "votes": votes, "decisions": decisions}


@router.get("/v1/coverage", responses=_problems(), summary="Freshness of every tile")
def fresh(request: Request) -> dict[str, Any]:
    """When each tile was last driven past, and by how many vehicles whose ballots stand."""
    tiles = coverage(_store(request))
    return {
        "tiles": [
            {name: t[name] for name in ("row", "col", "vehicles")} | {"last_seen": iso(t["last_seen_ns"])}
            for t in tiles
        ]
    }


@router.get("/v1/vehicles", responses=_problems(403), summary="Who contradicts the others")
def vehicles(request: Request) -> dict[str, Any]:
    """How every vehicle stands to what the others say before and after it, with the places where it differs."""
    _operator(request)
    found = vehicle_standings(_store(request), request.app.state.settings.fuse)
    return {"vehicles": [asdict(s) | {"evidence": [asdict(e) for e in s.evidence[:_MOST_EVIDENCE]]} for s in found]}


@router.get("/healthz", responses=_problems(), summary="Can the store be read?")
def health(request: Request) -> dict[str, Any]:
    """200 with the newest version, 503 if the database does not answer."""
    return {"status": "ok", "version": _store(request).current()}


@router.get("/metrics", responses=_problems(), response_class=Response, summary="Prometheus metrics")
def metrics(request: Request) -> Response:
    """Counters, latencies, the newest version."""
    gathered = request.app.state.metrics
    gathered.version.set(_store(request).current())
    return Response(gathered.text(), media_type="text/plain; version=0.0.4; charset=utf-8")


@router.get("/docs", include_in_schema=False)
def docs(request: Request) -> Response:
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
    return Response(_DOCS.replace("ROWS", "".join(rows)), media_type="text/html")


@router.get("/", include_in_schema=False)
def index() -> Response:
    """The operator's page."""
    return _asset("index.html")


@router.get("/viewer/{name}", include_in_schema=False)
def asset(name: str) -> Response:
    """A script or style of the operator's page."""
    return _asset(name)


def _asset(name: str) -> Response:
    kinds = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
    file = resources.files("mapvote.fleet") / "viewer" / name
    kind = kinds.get("." + name.rpartition(".")[2])
    if kind is None or "/" in name or "\\" in name or not file.is_file():
        raise NotFound(f"there is no page {name[:80]!r}")
    policy = "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; frame-ancestors 'none'"
    headers = {"Content-Security-Policy": policy, "Cache-Control": "no-cache"}
    return Response(file.read_bytes(), media_type=kind, headers=headers)


def iso(stamp_ns: int | None) -> str | None:
    """ISO 8601 in UTC, milliseconds."""
    if stamp_ns is None:
        return None
    whole = datetime.fromtimestamp(min(stamp_ns // 10**9, 253_402_300_799), UTC)
    return whole.strftime("%Y-%m-%dT%H:%M:%S") + f".{stamp_ns // 10**6 % 1000:03d}Z"


def _store(request: Request) -> Store:
    store: Store = request.app.state.store
    return store


def _own(request: Request, vehicle: str) -> str:
    """Who may touch this vehicle's ballots: itself, within its rate, or an operator."""
    key = request.state.key
    if key is None:
        return vehicle
    if key.role != "operator":
        if key.name != vehicle:
            raise Forbidden(f"the key of {key.name!r} cannot touch ballots of {vehicle!r}")
        request.app.state.limit.take(key.name)
    name: str = key.name
    return name


def _operator(request: Request) -> str:
    key = request.state.key
    if key is None:
        return "operator"
    if key.role != "operator":
        raise Forbidden("only an operator can do this")
    name: str = key.name
    return name


def _manifest(manifest: Manifest) -> dict[str, Any]:
    tiles = {
        tile_key(index): {"points": h.points, "ground": h.ground, "free": h.free} for index, h in manifest.tiles.items()
    }
    return {
        "map_id": manifest.map_id,
        "version": manifest.version,
        "lattice": {"x0": manifest.lattice.x0, "y0": manifest.lattice.y0},
        "georeference": dict(manifest.georeference),
        "tiles": tiles,
        "removed": [tile_key(index) for index in manifest.removed],
    }
