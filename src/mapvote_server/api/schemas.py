"""Requests and answers of the API, as OpenAPI declares them to programs in other languages.

Routes encode their answers themselves (:func:`as_json`). A test holds every answer to its model: it has the model's
members and no others.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields
from typing import Annotated, Any, Literal

import msgspec
from fastapi import Path, Query, Response
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, create_model

from mapvote.codec.manifest import Manifest, TileHashes
from mapvote.shapes.geojson import as_csv
from mapvote_server.api.problems import problems
from mapvote_server.questions.explain import FARTHEST_M
from mapvote_server.store import keys
from mapvote_server.store.policy import Policy, names_in
from mapvote_server.work import count_rows

LEAST, MOST = 1, (1 << 31) - 1
"""Range of a version's number."""
MOST_SEQ = (1 << 53) - 1
"""The largest number of an event: up to here every JSON reader keeps integers exact."""
PLAIN = r"^[^\x00-\x1f]*$"
"""No control characters: PostgreSQL stores no NUL."""

_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
Name = Annotated[str, Path(pattern=_NAME)]
NameOf = Annotated[str, Field(pattern=_NAME, description="1-64 of letters, digits, dot, underscore, dash")]
Digest = Annotated[str, Path(pattern=r"^[0-9a-f]{64}$")]
Number = Annotated[int, Path(ge=LEAST, le=MOST)]
Table = Literal["json", "csv"]
TableOrMap = Literal["json", "geojson", "csv"]
"""Formats of a list; lists of places can be GeoJSON."""
VersionQuery = Annotated[int, Query(ge=LEAST, le=MOST)]
From = Annotated[int, Query(alias="from", ge=LEAST, le=MOST)]
To = Annotated[int, Query(alias="to", ge=LEAST, le=MOST)]
_ON_EARTH = {"exclusiveMinimum": -FARTHEST_M, "exclusiveMaximum": FARTHEST_M}
Metres = Annotated[float, Query(description="in the map's frame", json_schema_extra=_ON_EARTH)]
"""A range that is declared only, as that of days: the store's own refusal says more than FastAPI's."""


def _whole(value: object) -> object:
    return int(value) if isinstance(value, float) and value.is_integer() else value


VersionOfBody = Annotated[int, Field(ge=LEAST, le=MOST), BeforeValidator(_whole)]
"""A version in a body. JSON has numbers only: 1.0 is an integer, too."""
SeqOfBody = Annotated[int, Field(ge=0, le=MOST_SEQ), BeforeValidator(_whole)]
"""As :data:`VersionOfBody`, of an event."""


class Ask(BaseModel):
    """A body; members that it does not name are refused, and so are values of another JSON type."""

    model_config = ConfigDict(extra="forbid", strict=True)


Reason = Annotated[str, Field(max_length=200, pattern=PLAIN)]


class PublishAsk(Ask):
    """How to publish; an empty object publishes the standing ballots."""

    dry_run: bool = False
    override: bool = Field(default=False, description="publish in spite of the reasons to hold it")
    parent: VersionOfBody | None = Field(default=None, description="only if this is still the newest version")
    reason: Reason = ""


class ReplayAsk(Ask):
    """Whose votes to take out of every version."""

    vehicle: NameOf
    dry_run: bool = Field(default=True, description="only say what would change; false publishes it")


class PolicyAsk(Ask):
    """Changes of the policy."""

    values: dict[str, str | int | float | bool] = Field(
        max_length=100,
        description="by section.key: fuse.min_votes",
        json_schema_extra={"propertyNames": {"enum": [*names_in(Policy())]}},
    )
    reason: Reason = ""


class IssueAsk(Ask):
    """Whose key, and what it opens."""

    name: NameOf
    role: keys.Role = "vehicle"
    days: float | None = Field(
        default=None,
        description="the key expires after so many days; null: never",
        json_schema_extra={"exclusiveMinimum": 0, "maximum": keys.MOST_DAYS},
    )


class RotateAsk(Ask):
    """Whose key is replaced."""

    name: NameOf
    overlap_days: float = Field(
        default=1.0, ge=0, le=keys.MOST_DAYS, description="the old keys work for so many more days"
    )


class RevokeAsk(Ask):
    """Whose keys are revoked."""

    name: NameOf
    keep_votes: bool = Field(default=False, description="whether its standing ballots still count")


class RollbackAsk(Ask):
    """The version to go back to."""

    to: VersionOfBody
    reason: Reason = ""


class Answer(BaseModel):
    """Members that a model does not name never come."""

    model_config = ConfigDict(extra="forbid", defer_build=True)


def _answer_of(kind: type[msgspec.Struct], leave_out: Collection[str] = (), **instead: Any) -> type[Answer]:
    """The model of an answer that the codec defines, with some members of other types."""
    members: dict[str, Any] = {}
    for member in msgspec.structs.fields(kind):
        if member.name not in leave_out:
            default = ... if member.required else member.default
            members[member.name] = instead.get(member.name, member.type), default
    return create_model(kind.__name__, __base__=Answer, __doc__=kind.__doc__, **members)


Planes = _answer_of(TileHashes, leave_out=["memory"])
ManifestAnswer = _answer_of(Manifest, tiles=dict[str, Planes])  # type: ignore[valid-type]


AS_CSV: dict[int | str, dict[str, Any]] = {200: {"content": {"text/csv": {}}}}
AS_YOU_HAVE: dict[int | str, dict[str, Any]] = {304: {"description": "as you have"}}
AS_BYTES: dict[int | str, dict[str, Any]] = {
    200: {"content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}}
}


def sends_bytes(*codes: int) -> dict[str, Any]:
    """The arguments of a route that answers bytes, or with these refusals."""
    return {"responses": problems(*codes) | AS_BYTES, "response_class": Response}


def as_json(content: Any) -> Response:
    """An answer, encoded in the calling thread: FastAPI would encode it on the event loop, and a large one would block
    all others. The members of its lists are counted as rows."""
    members = (getattr(content, member.name) for member in fields(content))
    count_rows(1 + sum(len(member) for member in members if isinstance(member, list)))
    return Response(msgspec.json.encode(content, enc_hook=_plain), media_type="application/json")


def _plain(model: Any) -> Any:
    return model.model_dump(mode="json")


def as_table(rows: Sequence[Mapping[str, Any]]) -> Response:
    """Rows as CSV, counted."""
    count_rows(1 + len(rows))
    return Response(as_csv(rows), media_type="text/csv")
