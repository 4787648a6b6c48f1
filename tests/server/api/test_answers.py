"""Every JSON answer is what OpenAPI declares: no member is missing, and none comes that no model names."""

from __future__ import annotations

from dataclasses import is_dataclass

import pytest
from fastapi.routing import APIRoute
from fastapi.testclient import TestClient
from pydantic import TypeAdapter

from asked import ASKED, POLICY, answered, lived_in
from hand_made import two_walls
from mapvote_server.api.app import ROUTES, create_app
from mapvote_server.api.schemas import Answer
from mapvote_server.api.security import PROBES
from mapvote_server.store.store import Store
from stores import NewStore

NEVER_HERE = {("DELETE", "/v1/publish")}
"""Nothing is being published in this test; see test_desk.py."""


@pytest.fixture
def store(new_store: NewStore) -> Store:
    return lived_in(new_store(two_walls(), POLICY))


def test_every_json_answer_is_as_openapi_declares_it(store: Store) -> None:
    app = create_app(store, opened=True)
    routes = [route for part in ROUTES for route in part.router.routes if isinstance(route, APIRoute)]
    models = {(method, route.path): route.response_model for route in routes for method in route.methods or ()}
    typed = {asked: model for asked, model in models.items() if model is not None}
    assert {(method, path) for method, path, _, _ in ASKED} | NEVER_HERE == typed.keys()
    models_of = [m for model in typed.values() for m in getattr(model, "__args__", [model])]
    assert all(issubclass(m, Answer) or is_dataclass(m) for m in models_of)
    with TestClient(app, base_url="http://localhost") as client:
        for method, path, url, _, answer in answered(client, store):
            assert answer.status_code in (200, 201), (method, url, answer.text)
            found, model = answer.json(), TypeAdapter(models[method, path])
            taken = model.validate_json(answer.content)
            assert not is_dataclass(taken) or model.dump_python(taken, mode="json") == found, "no other members"
    assert PROBES[1] in {path for _, path in typed}


def test_no_request_builds_a_route(store: Store) -> None:
    """Two first requests at once would build it in two threads; see create_app."""
    routes = [id(route) for part in ROUTES for route in part.router.routes]
    assert routes == [id(route) for route in create_app(store).router.routes[-len(routes) :]]


def test_a_member_that_no_model_names_is_found() -> None:
    with pytest.raises(ValueError, match="extra"):
        TypeAdapter(Answer).validate_python({"more": 1})
