"""Every JSON answer is what OpenAPI declares: no member is missing, and none comes that no model names."""

from __future__ import annotations

from dataclasses import is_dataclass
from typing import Any

import numpy as np
import pytest
from fastapi.routing import APIRoute
from fastapi.testclient import TestClient
from msgspec.structs import replace
from pydantic import TypeAdapter

from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.codec.ballot import Ballot, encode, pack_path
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote_server.api.app import ROUTES, create_app
from mapvote_server.api.schemas import Answer
from mapvote_server.api.security import PROBES
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import WALL, NewStore, send

ASKED: list[tuple[str, str, str, Any]] = [
    ("GET", "/healthz", "", None),
    ("GET", "/readyz", "", None),
    ("GET", "/v1/map", "", None),
    ("GET", "/v1/map/versions", "", None),
    ("GET", "/v1/map/versions/{number}", "/v1/map/versions/1", None),
    ("GET", "/v1/changes", "/v1/changes?from=1", None),
    ("GET", "/v1/changes", "/v1/changes?from=1&lonlat=true", None),
    ("GET", "/v1/cells", "/v1/cells?x=3.15&y=3.15", None),
    ("GET", "/v1/coverage", "", None),
    ("GET", "/v1/coverage", "/v1/coverage?format=geojson", None),
    ("GET", "/v1/coverage/passes", "", None),
    ("GET", "/v1/vehicles", "", None),
    ("GET", "/v1/vehicles", "/v1/vehicles?format=geojson", None),
    ("GET", "/v1/paths", "", None),
    ("GET", "/v1/policy", "", None),
    ("PATCH", "/v1/policy", "", {"values": {"fuse.min_votes": 2}}),
    ("GET", "/v1/info", "", None),
    ("GET", "/v1/log", "/v1/log?events=9", None),
    ("GET", "/v1/check", "", None),
    ("POST", "/v1/check", "", None),
    ("PUT", "/v1/tiles/{digest}", "/v1/tiles/PLANE", "PLANE"),
    ("GET", "/v1/gc", "", None),
    ("POST", "/v1/gc", "", None),
    ("GET", "/v1/publish", "", None),
    ("GET", "/v1/desk", "", None),
    ("GET", "/v1/desk", "/v1/desk?format=geojson", None),
    ("POST", "/v1/desk/reviews", "", {"change": "PENDING", "verdict": "held"}),
    ("GET", "/v1/desk", "", None),
    ("DELETE", "/v1/desk/reviews/{seq}", "/v1/desk/reviews/SEQ", None),
    ("POST", "/v1/publish", "", {"dry_run": True}),
    ("POST", "/v1/rollback", "", {"to": 1}),
    ("POST", "/v1/replay", "", {"vehicle": "a"}),
    ("DELETE", "/v1/ballots/{vehicle}/{drive}", "/v1/ballots/a/d2", None),
    ("DELETE", "/v1/ballots/{vehicle}", "/v1/ballots/b", None),
    ("PUT", "/v1/ballots/{vehicle}/{drive}", "/v1/ballots/a/d3", "BALLOT"),
    ("DELETE", "/v1/ballots", "/v1/ballots?everybody=true", None),
    ("POST", "/v1/keys", "", {"name": "boss", "role": "operator"}),
    ("GET", "/v1/keys", "", None),
    ("POST", "/v1/keys/rotate", "", {"name": "boss"}),
    ("POST", "/v1/keys/revoke", "", {"name": "boss"}),
]
"""Method, route, what is asked where that differs, and what is sent."""
NEVER_HERE = {("DELETE", "/v1/publish")}
"""Nothing is being published in this test; see test_desk.py."""


def ballot(store: Store, vehicle: str, drive: str, gone: list[tuple[int, int]], tile: tuple[int, int]) -> Ballot:
    states = states_plane(dict.fromkeys(gone, CellState.CHANGED_EMPTY), fill=CellState.UNCHANGED_EMPTY)
    made = make_ballot(store.point_map(), {tile: Say(states)}, vehicle, drive, end_ns=store.clock())
    driven = [np.array([x + 76.8 * tile[1], 3.0]) for x in (3.0, 6.0, 9.0)]
    return replace(made, path=pack_path(driven, store.lattice))


@pytest.fixture
def store(new_store: NewStore) -> Store:
    """A store where one wall went in version 2, and another would go with the next."""
    store = new_store(two_walls(), Policy(fuse=FuseSettings(max_deleted_share=1)))
    for number, tile in ((1, (0, 0)), (2, (0, 1))):
        for vehicle in "ab":
            send(store, ballot(store, vehicle, f"d{number}", WALL, tile))
        if number == 1:
            publish(store)
    return store


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
