"""Every JSON answer is what OpenAPI declares: no member is missing, and none comes that no model names."""

from __future__ import annotations

from dataclasses import is_dataclass

import pytest
from fastapi.routing import APIRoute
from fastapi.testclient import TestClient
from pydantic import TypeAdapter

from asked import ASKED, LANELETS, POLICY, ballot, lived_in
from hand_made import two_walls
from mapvote.codec.ballot import encode
from mapvote_server.api.app import ROUTES, create_app
from mapvote_server.api.schemas import Answer
from mapvote_server.api.security import PROBES
from mapvote_server.store.store import Store
from stores import WALL, NewStore

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
    kept: dict[str, str] = {}
    plane = store.tiles()[0, 0].points
    with TestClient(app, base_url="http://localhost") as client:
        for method, path, asked, sent in ASKED:
            url = (asked or path).replace("SEQ", kept.get("seq", "")).replace("PLANE", plane)
            if sent == "BALLOT":
                answer = client.put(url, content=encode(ballot(store, "a", "d3", WALL, (0, 1))))
            elif sent == "LANELETS":
                answer = client.post(url, content=LANELETS)
            elif sent == "PLANE":
                answer = client.put(url, content=client.get(url).content)
            else:
                body = {k: kept["pending"] if v == "PENDING" else v for k, v in sent.items()} if sent else None
                answer = client.request(method, url, json=body)
            assert answer.status_code in (200, 201), (method, url, answer.text)
            found, model = answer.json(), TypeAdapter(models[method, path])
            taken = model.validate_json(answer.content)
            assert not is_dataclass(taken) or model.dump_python(taken, mode="json") == found, "no other members"
            kept |= {"seq": str(found["seq"])} if "seq" in found else {}
            if "key" in found:  # the first key closes an open server
                client.headers["Authorization"] = f"Bearer {found['key']}"
            if path == "/v1/desk" and not asked:
                features = [*found["pending"]["features"], *found["reviewed"]]
                kept["pending"] = features[0]["id"]
    assert PROBES[1] in {path for _, path in typed}


def test_no_request_builds_a_route(store: Store) -> None:
    """Two first requests at once would build it in two threads; see create_app."""
    routes = [id(route) for part in ROUTES for route in part.router.routes]
    assert routes == [id(route) for route in create_app(store).router.routes[-len(routes) :]]


def test_a_member_that_no_model_names_is_found() -> None:
    with pytest.raises(ValueError, match="extra"):
        TypeAdapter(Answer).validate_python({"more": 1})
