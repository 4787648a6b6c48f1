"""Additions to FastAPI: keys in the OpenAPI document, and every method of a path in the Allow of a 405."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse
from starlette.routing import Match, Route

from mapvote_server.api.key_form import COOKIE

SCHEMES: dict[str, dict[str, Any]] = {
    "bearer": {"type": "http", "scheme": "bearer", "description": "the key"},
    "basic": {"type": "http", "scheme": "basic", "description": "the key as password, with any user name"},
    "cookie": {"type": "apiKey", "in": "cookie", "name": COOKIE, "description": "a browser's, set by its form"},
}
KEYLESS = "/livez", "/readyz"


def describe_keys(app: FastAPI) -> None:
    """State in the app's OpenAPI document how a key is sent, and which paths need none."""
    without_keys = app.openapi

    def described() -> dict[str, Any]:
        document = without_keys()
        document["components"]["securitySchemes"] = SCHEMES
        document["security"] = [{name: []} for name in SCHEMES]
        for path in KEYLESS:
            for operation in document["paths"][path].values():
                operation["security"] = [{}, *document["security"]]
        return document

    app.openapi = described  # type: ignore[method-assign]


async def not_allowed(request: Request, error: Exception) -> Response:
    """405, with every method that the path has: its routes are apart, and each knows its own methods only."""
    methods: set[str] = set()
    for route in request.app.routes:
        if isinstance(route, Route) and route.matches(request.scope)[0] is not Match.NONE:
            methods |= route.methods or set()
    allow = ", ".join(sorted(methods))
    return JSONResponse({"detail": f"this path takes {allow}"}, 405, {"Allow": allow})
