"""Refusals of the API as problem details (RFC 9457), and the one table from errors to status codes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from fastapi import Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.routing import Match, Route

from mapvote.core.answers import answer
from mapvote.core.types import MapvoteError
from mapvote_server.errors import (
    BadRequest,
    Conflict,
    Forbidden,
    Held,
    NotFound,
    NotInFile,
    TooLarge,
    TooMany,
    TooSlow,
    Unauthorised,
    Unavailable,
)

STATUS: Mapping[type[MapvoteError], int] = {
    BadRequest: 400,
    Unauthorised: 401,
    Forbidden: 403,
    NotFound: 404,
    Conflict: 409,
    TooLarge: 413,
    NotInFile: 416,
    MapvoteError: 422,
    TooSlow: 422,
    TooMany: 429,
    Unavailable: 503,
}
"""An entry also holds for the subclasses of its class."""
PROBLEM_JSON = "application/problem+json"


@answer
@dataclass(frozen=True, slots=True)
class Problem:
    """An error, and how to mend it (RFC 9457)."""

    type: str
    """about:blank, or the address of a description of this kind of problem"""
    title: str
    """the status in words"""
    status: int
    detail: str
    """what is wrong, where, and how to mend it"""
    instance: str
    """the path that was asked for"""
    reasons: list[str] | None = None
    """of a version that the policy holds"""


def problems(*codes: int) -> dict[int | str, dict[str, Any]]:
    """For the OpenAPI document: the refusals that every route knows, and these."""
    content = {PROBLEM_JSON: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    every = sorted({401, 422, 429, 503, *codes})
    return {code: {"description": HTTPStatus(code).phrase, "content": content} for code in every}


def refuse(error: Exception, path: str) -> Response:
    """The answer to a MapvoteError of a request for ``path``: what to do about it, and the reasons of a held
    version."""
    status = next(STATUS[kind] for kind in type(error).__mro__ if kind in STATUS)
    headers = {}
    if status in (429, 503):
        headers["Retry-After"] = str(math.ceil(error.after_s)) if isinstance(error, TooMany) else "1"
    response = problem(status, str(error), path, headers, error.reasons if isinstance(error, Held) else None)
    if status == 401:  # two lines: browsers read one challenge a line, and ask for a password only for Basic
        response.headers.append("WWW-Authenticate", 'Basic realm="mapvote: the key is the password", charset="UTF-8"')
        response.headers.append("WWW-Authenticate", "Bearer")
    return response


def problem(
    status: int, detail: str, path: str, headers: Mapping[str, str] | None = None, reasons: list[str] | None = None
) -> Response:
    """A problem as an answer; members without a value are left out. Its type says that the status says all (RFC 9457,
    4.2.1), or that the policy holds a version for ``reasons``."""
    kind = "about:blank" if reasons is None else "/docs#held"
    content = {"type": kind, "title": HTTPStatus(status).phrase, "status": status, "detail": detail, "instance": path}
    more = {} if reasons is None else {"reasons": reasons}
    return JSONResponse(content | more, status, headers, media_type=PROBLEM_JSON)


async def unreadable(request: Request, error: Exception) -> Response:
    """A body that is not even UTF-8: FastAPI answers 400, but every unusable body is 422 here.

    Asynchronous, as FastAPI would run a plain function in a thread of its own pool.
    """
    return problem(422, "the body is no JSON in UTF-8", request.url.path)


async def unusable(request: Request, error: Exception) -> Response:
    """A parameter or a body that is not what OpenAPI declares: 422 with each place and what is wrong there, as text
    that can be encoded whatever was sent."""
    assert isinstance(error, RequestValidationError)
    places = "; ".join(f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors())
    return problem(422, places[:1000].encode(errors="replace").decode(), request.url.path)


async def unknown_path(request: Request, error: Exception) -> Response:
    """404 for a path that no route has."""
    return problem(404, "there is no such path: /docs lists all", request.url.path)


async def not_allowed(request: Request, error: Exception) -> Response:
    """405, with every method that the path has: its routes are apart, and each knows its own methods only."""
    methods: set[str] = set()
    for route in request.app.routes:
        if isinstance(route, Route) and route.matches(request.scope)[0] is not Match.NONE:
            methods |= route.methods or set()
    if "GET" in methods:  # mapvote_server.api.heads
        methods.add("HEAD")
    allow = ", ".join(sorted(methods))
    return problem(405, f"this path takes {allow}", request.url.path, {"Allow": allow})


async def failed(request: Request, error: Exception) -> Response:
    """500: an error of the server itself, which the log has."""
    return problem(500, "the server failed; its log says where", request.url.path)
