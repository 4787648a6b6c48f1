"""OpenAPI 3.0 of the routes of :mod:`mapvote_server.api.ogc_routes`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from http import HTTPStatus
from typing import Any

from mapvote_server.api.openapi import SCHEMES
from mapvote_server.api.problems import PROBLEM_JSON
from mapvote_server.questions.features import COLLECTIONS


class Media(StrEnum):
    """Media types of the answers."""

    JSON = "application/json"
    GEOJSON = "application/geo+json"
    HTML = "text/html"
    OPENAPI = "application/vnd.oai.openapi+json;version=3.0"


USUAL_PAGE = 100
"""Features of a page if no limit is stated."""
LARGEST_PAGE = 10_000
"""Features of a page at most."""


def document_at(address: str) -> dict[str, Any]:
    """The document of the service whose first page has this address."""
    parameters = _parameters()
    query = [parameters[name] for name in ("bbox", "bbox-crs", "crs", "datetime", "limit", "offset")]
    paths = {
        "/": _get("the first page", [Media.JSON, Media.HTML]),
        "/api": _get("this document", [Media.OPENAPI]),
        "/api.html": _get("this document for people", [Media.HTML]),
        "/conformance": _get("the classes that are met", [Media.JSON, Media.HTML]),
        "/collections": _get("the collections", [Media.JSON, Media.HTML]),
    }
    for name, kind in COLLECTIONS.items():
        versions = [parameters["from"], parameters["to"]] if kind.of_versions else []
        feature = [parameters["featureId"], parameters["crs"], *versions]
        path = f"/collections/{name}"
        paths[path] = _get(kind.title, [Media.JSON, Media.HTML])
        paths[f"{path}/items"] = _get(kind.description, [Media.GEOJSON, Media.HTML], [*query, *versions])
        paths[f"{path}/items/{{featureId}}"] = _get("one feature", [Media.GEOJSON, Media.HTML], feature)
    return {
        "openapi": "3.0.3",
        "info": {"title": "mapvote: OGC API - Features", "version": "1"},
        "servers": [{"url": address}],
        "paths": paths,
        "components": {"securitySchemes": SCHEMES},
        "security": [{name: []} for name in SCHEMES],
    }


def _parameters() -> dict[str, dict[str, Any]]:
    """Every parameter by its name."""
    text = {"type": "string"}
    queries = {
        "bbox": {"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 6},
        "bbox-crs": text | {"format": "uri"},
        "crs": text | {"format": "uri"},
        "datetime": text,
        "f": text | {"enum": ["json", "html"]},
        "from": {"type": "integer", "minimum": 1},
        "limit": {"type": "integer", "minimum": 1, "maximum": LARGEST_PAGE, "default": USUAL_PAGE},
        "offset": {"type": "integer", "minimum": 0, "default": 0},
        "to": {"type": "integer", "minimum": 1},
    }
    parameters = {
        name: {"name": name, "in": "query", "required": False, "schema": schema, "style": "form", "explode": False}
        for name, schema in queries.items()
    }
    return parameters | {"featureId": {"name": "featureId", "in": "path", "required": True, "schema": text}}


def _get(summary: str, kinds: Sequence[str], parameters: Sequence[Mapping[str, Any]] = ()) -> dict[str, Any]:
    """An operation that answers by one of some media types; where it has a choice, ``f`` makes it."""
    content = {kind: {"schema": {"type": "string" if kind == Media.HTML else "object"}} for kind in kinds}
    answers: dict[str, Any] = {"200": {"description": summary, "content": content}}
    problem = {PROBLEM_JSON: {"schema": {"type": "object"}}}
    for code in (400, 401, 403, 404, 422, 429, 500, 503):
        answers[str(code)] = {"description": HTTPStatus(code).phrase, "content": problem}
    choice = [_parameters()["f"]] if len(kinds) > 1 else []
    return {"get": {"summary": summary, "parameters": [*parameters, *choice], "responses": answers}}
