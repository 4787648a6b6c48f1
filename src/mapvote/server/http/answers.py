"""The JSON answers of every route, as OpenAPI declares them to programs in other languages.

Routes encode their answers themselves (:func:`mapvote.server.http.schemas.as_json`). A test holds every answer to its
model: it has the model's members and no others.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Literal

import msgspec
from pydantic import BaseModel, ConfigDict, Field, create_model

from mapvote.codec.manifest import Manifest, TileHashes
from mapvote.server.http.services import Progress
from mapvote.server.store.integrity import Damage
from mapvote.server.views.change_objects import Kind, Size
from mapvote.server.views.consensus import VehicleStanding


class Answer(BaseModel):
    """Members that a model does not name never come."""

    model_config = ConfigDict(extra="forbid")


class Problem(Answer):
    """An error, and how to mend it."""

    detail: Any
    reasons: list[str] | None = Field(default=None, description="of a version that the policy holds")


def answer_of(kind: type[msgspec.Struct], leave_out: Collection[str] = (), **instead: Any) -> type[Answer]:
    """The model of an answer that the codec defines, with some members of other types."""
    members: dict[str, Any] = {}
    for member in msgspec.structs.fields(kind):
        if member.name not in leave_out:
            default = ... if member.required else member.default
            members[member.name] = instead.get(member.name, member.type), default
    return create_model(kind.__name__, __base__=Answer, __doc__=kind.__doc__, **members)


Planes = answer_of(TileHashes, leave_out=["memory"])
ManifestAnswer = answer_of(Manifest, tiles=dict[str, Planes])  # type: ignore[valid-type]


class VersionEntry(Answer):
    """The origin of a version."""

    number: int
    parent: int | None
    kind: Literal["import", "publish", "rollback", "replay"]
    target: int | None = Field(description="of a rollback or replay: the version it goes back to")
    published_by: str
    reason: str


class DatedVersion(VersionEntry):
    """A version with the policy that it was made by."""

    created: str
    policy: dict[str, Any]


class Versions(Answer):
    """Oldest first."""

    versions: list[DatedVersion]


class Withdrawn(Answer):
    """Number of ballots."""

    withdrawn: int


class Published(Answer):
    """The result of a publish, or of a dry run."""

    version: int
    published: bool
    tiles: list[str]
    points_added: int
    points_deleted: int
    held: list[str]


class Publishes(Answer):
    """Those under way, oldest first."""

    running: list[Progress]


class Cancelled(Answer):
    """Number of publishes."""

    cancelled: int


class RolledBack(Answer):
    """The new version."""

    version: int


class VerdictAnswer(Answer):
    """A reviewer's verdict on a change."""

    seq: int
    verdict: Literal["accepted", "held", "rejected"]
    by: str
    comment: str
    at_ns: int


class VerdictGiven(Answer):
    """The verdict's number in the log."""

    seq: int


class Geometry(Answer):
    """A feature collection of RFC 7946."""

    type: Literal["Point", "LineString", "Polygon", "MultiPolygon"]
    coordinates: list[Any]


class ChangeFacts(Answer):
    """One thing that was built or demolished."""

    kind: Kind
    size: Size
    area_m2: float
    height_m: float
    volume_m3: float = Field(description="of its columns")
    cells: int
    points: int
    votes_min: int
    votes_median: float
    against_median: float
    share_for: float | None
    probability: float | None = Field(description="mean over its cells that each of them changed")
    first_seen: str | None
    last_seen: str | None
    versions: list[int]
    box: list[list[float]]
    near: list[str] = Field(description="ids of large things within 15 m")


class PendingFacts(ChangeFacts):
    """A change on the desk."""

    verdict: VerdictAnswer | None
    waits: str | None = Field(default=None, description="why it is not deleted yet")
    false_deletion: float | None = Field(
        default=None, description="largest probability that something that stands goes"
    )
    drive_by: list[float] | None = Field(default=None, description="x, y where a vehicle should drive by")


class ChangeFeature(Answer):
    """GeoJSON."""

    type: Literal["Feature"]
    id: str
    geometry: Geometry
    properties: ChangeFacts


class PendingFeature(Answer):
    """GeoJSON."""

    type: Literal["Feature"]
    id: str
    geometry: Geometry
    properties: PendingFacts


class _Collection(Answer):
    """GeoJSON; ``frame`` says what its coordinates are."""

    type: Literal["FeatureCollection"]
    frame: str
    map_id: str
    georeference: dict[str, str]
    from_version: int | None
    to_version: int | None


class Changes(_Collection):
    """The differences between two versions."""

    features: list[ChangeFeature]
    damaged: list[str] | None = Field(default=None, description="tiles that cannot be read")


class Pending(_Collection):
    """The changes that a publish would make."""

    features: list[PendingFeature]


class Drawn(Answer):
    """The planes of a tile that the page draws."""

    points: str
    ground: str


class DeskAnswer(Answer):
    """The review desk."""

    version: int
    held: list[str] = Field(description="why the policy would hold the version")
    pending: Pending
    waiting: list[PendingFeature]
    reviewed: list[PendingFeature]
    tiles: dict[str, Drawn | None] = Field(description="as a publish would make them; null: without points")


class PlacedFeature(Answer):
    """GeoJSON."""

    type: Literal["Feature"]
    geometry: Geometry
    properties: dict[str, Any]


class Places(Answer):
    """GeoJSON in map metres."""

    type: Literal["FeatureCollection"]
    frame: str
    features: list[PlacedFeature]


class CoveredTile(Answer):
    """Row and column of a tile, how many vehicles saw it, and when the last did."""

    row: int
    col: int
    vehicles: int
    last_seen: str | None


class Coverage(Answer):
    """Extent of all tiles of the map and of standing ballots."""

    tiles: list[CoveredTile]


class Vehicles(Answer):
    """By name."""

    vehicles: list[VehicleStanding]


class Info(Answer):
    """The content of the store."""

    map_id: str
    version: int
    published_ns: int
    oldest_version: int
    tiles: int
    fields: str
    ballots: int
    vehicles: int
    votes_on_tiles: int
    planes: int
    plane_bytes: int
    quarantined: int


class LoggedVersion(VersionEntry):
    """A version in the log."""

    created_ns: int


class LoggedEvent(Answer):
    """One line of the log."""

    seq: int
    at_ns: int
    kind: str
    actor: str
    detail: str


class Log(Answer):
    """Versions oldest first, events newest first."""

    versions: list[LoggedVersion]
    events: list[LoggedEvent]


class Checked(Answer):
    """The damaged items."""

    damage: list[Damage]


class Restored(Answer):
    """A plane is as it was written; ``restored``: by this request."""

    restored: bool


class KeyEntry(Answer):
    """A key that was issued; never the key itself."""

    name: str
    role: str
    created_ns: int
    revoked_ns: int | None
    expires_ns: int | None
    valid: bool
    ballots: int = Field(description="standing ballots of this name")


class KeysAnswer(Answer):
    """All keys ever issued, oldest first."""

    keys: list[KeyEntry]


class KeyIssued(Answer):
    """The only time that the key is seen."""

    key: str


class KeysRevoked(Answer):
    """Number of keys, and of ballots that count no more."""

    revoked: int
    ballots: int


class Health(Answer):
    """The store can be read."""

    status: Literal["ok"]
    version: int


class Ready(Answer):
    """Ballots are taken in."""

    status: Literal["ready"]
    version: int
    quarantine: list[str]
    quarantined: int
