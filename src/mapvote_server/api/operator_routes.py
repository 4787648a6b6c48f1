"""Routes of operators: publish, roll back, see why; keys, retention, integrity, health."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Any, Literal

import structlog
from fastapi import APIRouter, Query, Request, Response
from prometheus_client import generate_latest

from mapvote.core.answers import answer
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice
from mapvote.core.record import record
from mapvote.core.types import MapvoteError
from mapvote.shapes.geojson import Bounds, Places, bounds_of, meet, tile_squares
from mapvote_server.api.lanes import on
from mapvote_server.api.paging import BoxAsked, PartAsked
from mapvote_server.api.problems import problems
from mapvote_server.api.schemas import (
    AS_BYTES,
    AS_CSV,
    MOST_SEQ,
    Digest,
    IssueAsk,
    Metres,
    PolicyAsk,
    PublishAsk,
    ReplayAsk,
    RevokeAsk,
    RollbackAsk,
    RotateAsk,
    TableOrMap,
    as_json,
    as_table,
)
from mapvote_server.api.services import Known, Operator, Parts, Progress, Reviewer, Services
from mapvote_server.api.vehicle_routes import Withdrawn
from mapvote_server.errors import Held, Unavailable
from mapvote_server.questions.coverage import Passes, waiting_votes, wanted_passes
from mapvote_server.questions.explain import CellStory, explain_cell
from mapvote_server.questions.freshness import CoveredTile, tiles_seen
from mapvote_server.questions.history import Info, Log, log_of, overview
from mapvote_server.questions.vehicles import (
    Contradiction,
    VehicleStanding,
    contradictions,
    standing_rows,
    vehicle_standings,
)
from mapvote_server.store import keys
from mapvote_server.store.integrity import Damage, check, restore_plane, set_aside
from mapvote_server.store.keys import KeyEntry
from mapvote_server.store.policy import Policy, PolicyChange, without_drive
from mapvote_server.store.publish import Published, preview, publish
from mapvote_server.store.queries import log_event
from mapvote_server.store.retention import Cleared, clear
from mapvote_server.store.rollback import replay, rollback
from mapvote_server.store.store import Store
from mapvote_server.store.votes import withdraw


@record()
@dataclass(frozen=True, slots=True)
class OperatorSizes:
    """Sizes of answers to operators."""

    evidence: int = 50
    """Contradictions of a vehicle that are told, at most."""
    damaged: int = 20
    """Damaged things that /readyz names; the log has all."""


OPERATOR_SIZES = OperatorSizes()
Everybody = Annotated[bool, Query(json_schema_extra={"const": True})]
router = APIRouter()


@router.post("/v1/publish", operation_id="publish", responses=problems(403, 409), summary="Publish the next version")
async def publish_now(by: Operator, parts: Parts, ask: PublishAsk) -> Published:
    """Fuse the standing ballots. 409 with the reasons if the policy holds the version, or another publish was first."""
    return await parts.rounds.run(_publish, parts, ask, by)


@answer
@dataclass(frozen=True, slots=True)
class Publishes:
    """Those under way, oldest first."""

    running: list[Progress]


@router.get(
    "/v1/publish",
    operation_id="list_publishes",
    response_model=Publishes,
    responses=problems(403),
    summary="How far a publish is",
)
async def publishing_now(by: Reviewer, parts: Parts) -> Response:
    """Publishes and dry runs under way: by whom, and how many tiles of how many are fused."""
    return as_json(Publishes(parts.publishing.now()))


@answer
@dataclass(frozen=True, slots=True)
class Cancelled:
    """Number of publishes."""

    cancelled: int


@router.delete(
    "/v1/publish",
    operation_id="cancel_publish",
    response_model=Cancelled,
    responses=problems(403, 404),
    summary="Cancel what is being published",
)
async def cancel_publishing(by: Operator, parts: Parts) -> Response:
    """Every publish under way ends before its next tiles with 409; no part of it is published."""
    return as_json(Cancelled(parts.publishing.cancel(by)))


def _publish(parts: Services, ask: PublishAsk, by: str) -> Published:
    with parts.metrics.publish_seconds.time(), _round(parts, by, ask.dry_run) as executor:
        if ask.dry_run:
            done = preview(parts.store, parent=ask.parent, gate=parts.gate, executor=executor)
        else:
            said: dict[str, Any] = {"reason": ask.reason, "parent": ask.parent, "override": ask.override}
            done = publish(parts.store, by=by, **said, gate=parts.gate, executor=executor)
    for damage in (damage for fused in done.fused for damage in fused.damaged):
        structlog.get_logger("mapvote").error("quarantine", kind=damage.kind, name=damage.name, why=damage.why)
    waits = None if done.tiles else waiting_votes(parts.store)
    return _told(done, "" if waits is None else str(waits))


@contextmanager
def _round(parts: Services, by: str, dry_run: bool) -> Iterator[Executor]:
    """An executor for a round, which can be seen and cancelled. A publish that the policy holds is an event for
    listeners. A stopping server ends the threads that fuse: what they had not begun is cancelled, more is refused."""
    try:
        with parts.publishing.watched(parts.fusing, by, dry_run) as executor:
            yield executor
    except Held as error:
        with parts.store.database.writing() as connection:
            log_event(connection, parts.store.clock(), "held back", by, "; ".join(error.reasons))
        raise
    except (CancelledError, RuntimeError) as error:
        if not parts.stopping.is_set():
            raise
        raise Unavailable("the server is stopping, nothing was published: ask again once it is back") from error


def _told(done: Published, waits: str) -> Published:
    """A result without the tiles that were fused for it."""
    return Published(**{member.name: getattr(done, member.name) for member in fields(Published)} | {"waits": waits})


@answer
@dataclass(frozen=True, slots=True)
class RolledBack:
    """The new version."""

    version: int


@router.post(
    "/v1/rollback",
    operation_id="roll_back",
    response_model=RolledBack,
    responses=problems(403, 404, 409),
    summary="Go back to an older version",
)
async def roll_back(by: Operator, parts: Parts, ask: RollbackAsk) -> Response:
    """A new version with the tiles of the old one; the votes that led away from it count no more."""
    version = await parts.commands.run(rollback, parts.store, ask.to, by=by, reason=ask.reason)
    return as_json(RolledBack(version.number))


@router.get(
    "/v1/cells",
    operation_id="explain_cell",
    response_model=CellStory,
    responses=problems(),
    summary="The votes behind one cell",
)
@on("questions")
def cell(parts: Parts, with_names: Known, x: Metres, y: Metres) -> Response:
    """Each ballot's statement on the cell at (x, y), map metres, whether it counts, and the decision of each
    version."""
    return as_json(explain_cell(parts.store, x, y, with_names=with_names))


@answer
@dataclass(frozen=True, slots=True)
class Coverage:
    """Extent of all tiles of the map and of standing ballots."""

    tiles: list[CoveredTile]


@router.get(
    "/v1/coverage",
    operation_id="list_coverage",
    response_model=Coverage | Places,
    responses=problems() | AS_CSV,
    summary="Freshness of every tile",
)
@on("questions")
def fresh(
    request: Request, parts: Parts, with_names: Known, part: PartAsked, box: BoxAsked, format: TableOrMap = "json"
) -> Response:
    """When a vehicle last passed each tile, and the number of vehicles with standing ballots there."""
    lattice = parts.store.lattice
    tiles = [
        tile for tile in tiles_seen(parts.store, with_names) if box is None or meet(box, _bounds_of(tile, lattice))
    ]
    shown = part.of(tiles)
    rows = [] if format == "json" else [asdict(tile) for tile in shown]
    if format == "json":
        answer = as_json(Coverage(shown))
    else:
        answer = as_table(rows) if format == "csv" else as_json(tile_squares(rows, lattice))
    return part.link(request, answer, len(tiles))


def _bounds_of(tile: CoveredTile, lattice: Lattice) -> Bounds:
    window = lattice.tile((tile.row, tile.col))
    side_m = TILE_CELLS * CELL_SIZE
    return window.x0, window.y0, window.x0 + side_m, window.y0 + side_m


@router.get(
    "/v1/coverage/passes",
    operation_id="list_passes",
    response_model=Passes,
    responses=problems(403),
    summary="Where to drive next",
)
@on("questions")
def passes(request: Request, by: Reviewer, parts: Parts, part: PartAsked, box: BoxAsked) -> Response:
    """Stretches of road on which one more pass would decide cells, as GeoJSON lines in the direction to drive."""
    wanted = wanted_passes(parts.store)
    lines = [line for line in wanted.features if box is None or meet(box, bounds_of(line.geometry))]
    return part.link(request, as_json(replace(wanted, features=part.of(lines))), len(lines))


@answer
@dataclass(frozen=True, slots=True)
class Vehicles:
    """By name."""

    vehicles: list[VehicleStanding]


@router.get(
    "/v1/vehicles",
    operation_id="list_vehicles",
    response_model=Vehicles | Places,
    responses=problems(403) | AS_CSV,
    summary="Vehicles that contradict the others",
)
@on("questions")
def vehicles(
    request: Request, by: Reviewer, parts: Parts, part: PartAsked, box: BoxAsked, format: TableOrMap = "json"
) -> Response:
    """Each vehicle compared with the others before and after it, with the places where it contradicts them."""
    standings = vehicle_standings(parts.store)
    shown = [replace(one, evidence=_within(one.evidence, box)) for one in part.of(standings)]
    if format == "csv":
        answer = as_table(standing_rows(shown))
    elif format == "geojson":
        answer = as_json(contradictions(shown))
    else:
        most = OPERATOR_SIZES.evidence
        answer = as_json(Vehicles([replace(one, evidence=one.evidence[:most]) for one in shown]))
    return part.link(request, answer, len(standings))


def _within(evidence: tuple[Contradiction, ...], box: Bounds | None) -> tuple[Contradiction, ...]:
    """The contradictions in a box."""
    return tuple(one for one in evidence if box is None or meet(box, (one.x, one.y, one.x, one.y)))


@router.get(
    "/v1/policy", operation_id="get_policy", response_model=PolicyChange, responses=problems(), summary="The policy"
)
@on("questions")
def policy(parts: Parts, with_names: Known) -> Response:
    """The policy in force, who set it and why. Only reviewers and operators see the name of its gate drive."""
    return _policy_of(parts, with_names)


def _policy_of(parts: Services, with_names: bool) -> Response:
    newest = parts.store.policy_changes()[-1]
    shown = newest.policy if with_names else Policy.model_validate(without_drive(newest.policy.model_dump()))
    return as_json(replace(newest, policy=shown))


@router.patch(
    "/v1/policy",
    operation_id="change_policy",
    response_model=PolicyChange,
    responses=problems(403),
    summary="Change the policy",
)
@on("commands")
def change_policy(by: Operator, parts: Parts, ask: PolicyAsk) -> Response:
    """In force at once. 422 names the value that is not possible, or the key that does not exist."""
    parts.store.change_policy(ask.values, by=by, reason=ask.reason)
    return _policy_of(parts, with_names=True)


@router.get(
    "/v1/info", operation_id="get_info", response_model=Info, responses=problems(), summary="What is in the store"
)
@on("questions")
def info(parts: Parts) -> Response:
    """The map, its newest version, and how much there is of everything."""
    return as_json(overview(parts.store))


@router.get("/v1/log", operation_id="get_log", response_model=Log, responses=problems(403), summary="What happened")
@on("questions")
def log(
    request: Request,
    by: Reviewer,
    parts: Parts,
    events: Annotated[int, Query(ge=0, le=10_000)] = 0,
    before: Annotated[int | None, Query(ge=1, le=MOST_SEQ, description="only events with smaller numbers")] = None,
) -> Response:
    """Every version, and the last so many events. If there are more, the header Link names the next part."""
    shown = log_of(parts.store, events, before)
    answer = as_json(shown)
    if events and len(shown.events) == events:
        answer.headers["Link"] = f'<?events={events}&before={shown.events[-1].seq}>; rel="next"'
    return answer


@answer
@dataclass(frozen=True, slots=True)
class Checked:
    """The damaged items."""

    damage: list[Damage]


@router.get(
    "/v1/check",
    operation_id="check_store",
    response_model=Checked,
    responses=problems(403),
    summary="Is every byte as written?",
)
async def whole(by: Operator, parts: Parts) -> Response:
    """Reads the whole store and names what is damaged. Nothing is changed."""
    return as_json(Checked(await parts.rounds.run(check, parts.store)))


@router.post(
    "/v1/check",
    operation_id="quarantine_damage",
    response_model=Checked,
    responses=problems(403),
    summary="Set aside what is damaged",
)
async def mend(by: Operator, parts: Parts) -> Response:
    """The answer of GET; damaged items are also quarantined."""
    return as_json(Checked(await parts.rounds.run(check, parts.store, mend=True, by=by)))


@answer
@dataclass(frozen=True, slots=True)
class Restored:
    """A plane is as it was written; ``restored``: by this request."""

    restored: bool


@router.put(
    "/v1/tiles/{digest}",
    operation_id="restore_plane",
    responses=problems(403, 404, 413, 429),
    summary="Put a damaged plane back",
    openapi_extra={"requestBody": {"required": True, "content": AS_BYTES[200]["content"]}},
)
async def restore(by: Operator, parts: Parts, request: Request, digest: Digest) -> Restored:
    """The body is the plane as GET answers it, of another copy of the store. A sound plane stays as it is."""
    raw = await parts.uploads.read(by, request.stream(), request.headers.get("content-length"))
    return Restored(restored=await parts.commands.run(restore_plane, parts.store, digest, raw, by=by))


@router.delete(
    "/v1/ballots",
    operation_id="withdraw_all",
    responses=problems(403, 404),
    summary="Withdraw the ballots of all vehicles",
)
async def begin_anew(by: Operator, parts: Parts, everybody: Everybody) -> Withdrawn:
    """To begin a new round: later versions are as if no standing ballot had been cast. Needs ``everybody=true``."""
    if not everybody:
        raise MapvoteError("name a vehicle in the path, or say everybody=true")
    return Withdrawn(withdrawn=await parts.commands.run(withdraw, parts.store, None, by=by))


@router.post(
    "/v1/replay",
    operation_id="replay",
    responses=problems(403, 404, 409),
    summary="The map as if a vehicle had never voted",
)
async def replay_without(by: Operator, parts: Parts, ask: ReplayAsk) -> Published:
    """Every version again without its votes; the difference to the newest is one new version."""
    return await parts.rounds.run(_replay, parts, ask, by)


def _replay(parts: Services, ask: ReplayAsk, by: str) -> Published:
    with _round(parts, by, ask.dry_run) as executor:
        return replay(parts.store, ask.vehicle, by=by, dry_run=ask.dry_run, executor=executor)


@router.get(
    "/v1/gc",
    operation_id="list_clearable",
    response_model=Cleared,
    responses=problems(403),
    summary="What the policy does not keep",
)
async def clearable(by: Operator, parts: Parts) -> Response:
    """Old versions and ballots that POST would delete."""
    return as_json(await parts.rounds.run(clear, parts.store, dry_run=True))


@router.post(
    "/v1/gc",
    operation_id="clear",
    response_model=Cleared,
    responses=problems(403),
    summary="Delete what it does not keep",
)
async def clear_now(by: Operator, parts: Parts) -> Response:
    """Deletes planes and decisions of old versions, and ballots that can decide nothing more."""
    return as_json(await parts.rounds.run(clear, parts.store, dry_run=False, by=by))


@answer
@dataclass(frozen=True, slots=True)
class KeysAnswer:
    """All keys ever issued, oldest first."""

    keys: list[KeyEntry]


@router.get(
    "/v1/keys", operation_id="list_keys", response_model=KeysAnswer, responses=problems(403), summary="Who holds keys"
)
@on("questions")
def listed_keys(request: Request, by: Operator, parts: Parts, part: PartAsked) -> Response:
    """All keys ever issued, revoked and expired ones too."""
    entries = keys.entries(parts.store)
    return part.link(request, as_json(KeysAnswer(part.of(entries))), len(entries))


@answer
@dataclass(frozen=True, slots=True)
class KeyIssued:
    """The only time that the key is seen."""

    key: str


@router.post(
    "/v1/keys", operation_id="issue_key", response_model=KeyIssued, responses=problems(403, 409), summary="Issue a key"
)
@on("commands")
def issue_key(by: Operator, parts: Parts, ask: IssueAsk) -> Response:
    """The answer is the only place where the key is ever seen: the store keeps its hash."""
    return as_json(KeyIssued(keys.issue(parts.store, ask.name, ask.role, by=by, days=ask.days)))


@router.post(
    "/v1/keys/rotate",
    operation_id="rotate_key",
    response_model=KeyIssued,
    responses=problems(403, 404),
    summary="Replace a key",
)
@on("commands")
def rotate_key(by: Operator, parts: Parts, ask: RotateAsk) -> Response:
    """A new key of the same role and length for who has a valid one."""
    return as_json(KeyIssued(keys.rotate(parts.store, ask.name, by=by, overlap_days=ask.overlap_days)))


@answer
@dataclass(frozen=True, slots=True)
class KeysRevoked:
    """Number of keys, and of ballots that count no more."""

    revoked: int
    ballots: int


@router.post(
    "/v1/keys/revoke", operation_id="revoke_keys", responses=problems(403, 404), summary="Revoke every key of a name"
)
@on("commands")
def revoke_keys(by: Operator, parts: Parts, ask: RevokeAsk) -> KeysRevoked:
    """Its standing ballots count no more, unless ``keep_votes``."""
    revoked, ballots = keys.revoke(parts.store, ask.name, by=by, keep_votes=ask.keep_votes)
    return KeysRevoked(revoked=revoked, ballots=ballots)


def _damaged(store: Store) -> list[str]:
    """The items in quarantine, as "kind name: why"."""
    with store.database.reading() as connection:
        return [f"{kind} {name}: {defect}" for (kind, name), defect in sorted(set_aside(connection).items())]


@router.get(
    "/livez", operation_id="get_livez", responses=problems(), response_class=Response, summary="Does the server answer?"
)
async def live() -> Response:
    """200 without content. Neither this nor `/readyz` needs a key; without a key `/readyz` has no content either."""
    return Response()


@answer
@dataclass(frozen=True, slots=True)
class Health:
    """The store can be read."""

    status: Literal["ok"]
    version: int


@router.get("/healthz", operation_id="get_healthz", responses=problems(), summary="Can the store be read?")
async def health(parts: Parts) -> Health:
    """200 with the newest version, 503 if the database does not answer."""
    return Health(status="ok", version=await parts.newest.put(None))


@answer
@dataclass(frozen=True, slots=True)
class Ready:
    """Ballots are taken in."""

    status: Literal["ready"]
    version: int
    quarantine: list[str]
    quarantined: int


@router.get("/readyz", operation_id="get_readyz", responses=problems(), summary="Can ballots be taken in?")
async def ready(parts: Parts) -> Ready:
    """200 if the database can be written now; 503 with its error if not, or if the server is stopping.

    ``quarantine`` names damaged ballots and planes that were set aside. Everything else goes on.
    """
    version = await parts.check_ready()
    damaged = await parts.look_up(_damaged, parts.store)
    return Ready(
        status="ready", version=version, quarantine=damaged[: OPERATOR_SIZES.damaged], quarantined=len(damaged)
    )


@router.get(
    "/metrics", operation_id="get_metrics", responses=problems(), response_class=Response, summary="Prometheus metrics"
)
async def metrics(parts: Parts) -> Response:
    """Counters, latencies, the newest version."""
    parts.metrics.version.set(await parts.newest.put(None))
    parts.metrics.tell_damaged(await parts.look_up(_damaged, parts.store))
    return Response(generate_latest(parts.metrics.registry), media_type="text/plain; version=0.0.4; charset=utf-8")
