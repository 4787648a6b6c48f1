"""Parameters and bodies of requests, and the one table from errors to status codes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import msgspec
from fastapi import Path, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field

from mapvote.core.types import MapvoteError
from mapvote.server.errors import Conflict, Forbidden, Held, NotFound, TooLarge, TooMany, Unauthorised, Unavailable
from mapvote.server.http.answers import Problem
from mapvote.server.views.geojson import as_csv

STATUS: Mapping[type[MapvoteError], int] = {
    Unauthorised: 401,
    Forbidden: 403,
    NotFound: 404,
    Conflict: 409,
    TooLarge: 413,
    MapvoteError: 422,
    TooMany: 429,
    Unavailable: 503,
}
"""An entry also holds for the subclasses of its class."""
LEAST, MOST = -(1 << 31), (1 << 31) - 1
"""Range of a version's number in a database."""
PLAIN = r"^[^\x00-\x1f]*$"
"""No control characters: PostgreSQL stores no NUL."""

Name = Annotated[str, Path(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
Digest = Annotated[str, Path(pattern=r"^[0-9a-f]{64}$")]
Number = Annotated[int, Path(ge=LEAST, le=MOST)]
Table = Literal["json", "csv"]
Places = Literal["json", "geojson", "csv"]
"""Formats of a list; lists of places can be GeoJSON."""
VersionQuery = Annotated[int, Query(ge=LEAST, le=MOST)]
From = Annotated[int, Query(alias="from", ge=LEAST, le=MOST)]
To = Annotated[int, Query(alias="to", ge=LEAST, le=MOST)]
Newest = Annotated[int | None, Query(alias="to", ge=LEAST, le=MOST)]
"""As :data:`To`, the newest version if it is left out."""
MinCells = Annotated[int, Query(ge=1, le=100_000)]


class Ask(BaseModel):
    """A body; members that it does not name are refused."""

    model_config = ConfigDict(extra="forbid")


Reason = Annotated[str, Field(max_length=200, pattern=PLAIN)]


class PublishAsk(Ask):
    """How to publish; an empty object publishes the standing ballots."""

    dry_run: bool = False
    override: bool = Field(default=False, description="publish in spite of the reasons to hold it")
    parent: int | None = Field(default=None, ge=LEAST, le=MOST, description="only if this is still the newest version")
    reason: Reason = ""


class ReplayAsk(Ask):
    """Whose votes to take out of every version."""

    vehicle: str = Field(max_length=64, pattern=PLAIN)
    dry_run: bool = Field(default=True, description="only say what would change; false publishes it")


class PolicyAsk(Ask):
    """Changes of the policy."""

    values: dict[str, str | int | float | bool] = Field(max_length=100, description="by section.key: fuse.min_votes")
    reason: Reason = ""


class IssueAsk(Ask):
    """Whose key, and what it opens."""

    name: str = Field(max_length=200, pattern=PLAIN, description="1-64 of letters, digits, dot, underscore, dash")
    role: str = Field(default="vehicle", max_length=20, description="vehicle, reader, reviewer or operator")
    days: float | None = Field(default=None, description="the key expires after so many days; null: never")


class RotateAsk(Ask):
    """Whose key is replaced."""

    name: str = Field(max_length=200, pattern=PLAIN)
    overlap_days: float = Field(default=1.0, ge=0, le=36_500, description="the old keys work for so many more days")


class RevokeAsk(Ask):
    """Whose keys are revoked."""

    name: str = Field(max_length=200, pattern=PLAIN)
    keep_votes: bool = Field(default=False, description="whether its standing ballots still count")


class RollbackAsk(Ask):
    """The version to go back to."""

    to: int = Field(ge=LEAST, le=MOST)
    reason: Reason = ""


AS_CSV: dict[int | str, dict[str, Any]] = {200: {"content": {"text/csv": {}}}}


def problems(*codes: int) -> dict[int | str, dict[str, Any]]:
    """For the OpenAPI document: the refusals that every route knows, and these."""
    return {code: {"model": Problem} for code in (401, 422, 503, *codes)}


def as_json(content: object) -> Response:
    """An answer, encoded in the calling thread: FastAPI would encode it on the event loop, and a large one would block
    all others."""
    return Response(msgspec.json.encode(content, enc_hook=_plain), media_type="application/json")


def _plain(model: Any) -> Any:
    return model.model_dump(mode="json")


def as_table(rows: Sequence[Mapping[str, Any]]) -> Response:
    """Rows as CSV."""
    return Response(as_csv(rows), media_type="text/csv")


def refuse(error: Exception) -> Response:
    """The answer to a MapvoteError: {"detail": what to do about it}, and the reasons of a held version."""
    status = next(STATUS[kind] for kind in type(error).__mro__ if kind in STATUS)
    content: dict[str, object] = {"detail": str(error)}
    headers = {}
    if isinstance(error, Held):
        content["reasons"] = error.reasons
    if status in (429, 503):
        headers["Retry-After"] = str(math.ceil(error.after_s)) if isinstance(error, TooMany) else "1"
    response = JSONResponse(content, status, headers)
    if status == 401:  # two lines: browsers read one challenge a line, and ask for a password only for Basic
        response.headers.append("WWW-Authenticate", 'Basic realm="mapvote: the key is the password", charset="UTF-8"')
        response.headers.append("WWW-Authenticate", "Bearer")
    return response


async def unreadable(request: Request, error: Exception) -> Response:
    """A body that is not even UTF-8: FastAPI answers 400, but every unusable body is 422 here.

    Asynchronous, as FastAPI would run a plain function in one of the threads of :data:`READING`.
    """
    return refuse(MapvoteError("the body is no JSON in UTF-8"))


async def unusable(request: Request, error: Exception) -> Response:
    """A parameter or a body that is not what OpenAPI declares: 422 with each place and what is wrong there, as text
    that can be encoded whatever was sent."""
    assert isinstance(error, RequestValidationError)
    found = "; ".join(f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors())
    return refuse(MapvoteError(found[:1000].encode(errors="replace").decode()))
