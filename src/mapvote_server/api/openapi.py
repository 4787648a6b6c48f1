"""Additions to FastAPI's OpenAPI document: groups of operations, examples, how a key is sent, the one shape
of errors."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any

from fastapi import FastAPI
from pydantic import TypeAdapter

from mapvote_server.api.key_form import COOKIE
from mapvote_server.api.problems import Problem
from mapvote_server.api.security import PROBES

SCHEMES: dict[str, dict[str, Any]] = {
    "bearer": {"type": "http", "scheme": "bearer", "description": "the key"},
    "basic": {"type": "http", "scheme": "basic", "description": "the key as password, with any user name"},
    "cookie": {"type": "apiKey", "in": "cookie", "name": COOKIE, "description": "a browser's, set by its form"},
}
GROUPS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "map": ("Versions of the map, and the planes of its tiles", ("map", "tiles", "clouds", "stac")),
    "ballots": ("Votes of vehicles", ("ballots",)),
    "changes": ("What was built and demolished, and the votes for it", ("changes", "cells", "evidence")),
    "coverage": ("Where vehicles have been, and where one should drive next", ("coverage", "paths", "vehicles")),
    "review": ("Changes before they are published", ("desk",)),
    "publishing": ("New versions, and the policy for them", ("publish", "rollback", "replay", "policy")),
    "events": ("What happens, and what has happened", ("events", "log")),
    "store": ("What the store holds, damage, retention", ("info", "check", "gc")),
    "keys": ("Who may do what", ("keys",)),
    "health": ("Probes and metrics", ("livez", "healthz", "readyz", "metrics")),
}
"""Groups of operations: each with its description, and the first words of its paths below /v1."""


def complete_document(app: FastAPI) -> None:
    """Complete the app's OpenAPI document."""
    by_fastapi = app.openapi

    def described() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = completed(by_fastapi())
        return app.openapi_schema

    app.openapi = described  # type: ignore[method-assign]


def completed(document: dict[str, Any]) -> dict[str, Any]:
    """FastAPI's ``document`` with all that this module adds."""
    document["tags"] = [{"name": name, "description": about} for name, (about, _) in GROUPS.items()]
    document["components"]["schemas"]["Problem"] = TypeAdapter(Problem).json_schema()
    document["components"]["securitySchemes"] = SCHEMES
    document["security"] = [{name: []} for name in SCHEMES]
    groups = {word: name for name, (_, words) in GROUPS.items() for word in words}
    for path, operations in document["paths"].items():
        for operation in operations.values():
            operation["tags"] = [groups[path.removeprefix("/v1").split("/")[1]]]
            _add_examples(operation)
            if path in PROBES:
                operation["security"] = [{}, *document["security"]]
    return document


@cache
def examples() -> dict[str, Any]:
    """Recorded requests and answers (benchmarks/document_contract.py): "parameters" by name, "requests" and "answers"
    by operation."""
    text = (resources.files("mapvote_server.api") / "examples.json").read_text()
    recorded: dict[str, Any] = json.loads(text)
    return recorded


def _add_examples(operation: dict[str, Any]) -> None:
    recorded = examples()
    name = operation["operationId"]
    for parameter in operation.get("parameters", ()):
        if parameter["name"] in recorded["parameters"]:
            parameter["example"] = recorded["parameters"][parameter["name"]]
    if name in recorded["requests"]:
        operation["requestBody"]["content"]["application/json"]["example"] = recorded["requests"][name]
    for code in ("200", "201"):
        content = operation["responses"].get(code, {}).get("content", {})
        if name in recorded["answers"] and "application/json" in content:
            content["application/json"]["example"] = recorded["answers"][name]
