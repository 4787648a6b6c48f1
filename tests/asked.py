"""A store with something of everything, and a request of every operation that answers JSON."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import httpx2
import numpy as np
from fastapi.testclient import TestClient
from msgspec.structs import replace

from hand_made import Say, make_ballot, states_plane
from mapvote.codec.ballot import Ballot, encode, pack_path
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import WALL, send

LANELETS = """<osm>
<node id='1' lat='0' lon='0'><tag k='local_x' v='3'/><tag k='local_y' v='3'/></node>
<node id='2' lat='0' lon='0'><tag k='local_x' v='4'/><tag k='local_y' v='3'/></node>
<way id='9'><nd ref='1'/><nd ref='2'/><tag k='type' v='stop_line'/></way>
</osm>"""
"""A stop line at the first wall of :func:`hand_made.two_walls`."""
POLICY = Policy(fuse=FuseSettings(max_deleted_share=1))
ASKED: list[tuple[str, str, str, Any]] = [
    ("GET", "/healthz", "", None),
    ("GET", "/readyz", "", None),
    ("GET", "/v1/map", "", None),
    ("GET", "/v1/map/versions", "", None),
    ("GET", "/v1/map/versions/{number}", "/v1/map/versions/1", None),
    ("GET", "/v1/changes", "/v1/changes?from=1", None),
    ("GET", "/v1/changes", "/v1/changes?from=1&lonlat=true", None),
    ("POST", "/v1/changes/lanelets", "/v1/changes/lanelets?from=1", "LANELETS"),
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


def ballot(store: Store, vehicle: str, drive: str, gone: list[tuple[int, int]], tile: tuple[int, int]) -> Ballot:
    states = states_plane(dict.fromkeys(gone, CellState.CHANGED_EMPTY), fill=CellState.UNCHANGED_EMPTY)
    made = make_ballot(store.point_map(), {tile: Say(states)}, vehicle, drive, end_ns=store.clock())
    driven = [np.array([x + 76.8 * tile[1], 3.0]) for x in (3.0, 6.0, 9.0)]
    return replace(made, path=pack_path(driven, store.lattice))


def lived_in(store: Store) -> Store:
    """A new store of :func:`hand_made.two_walls` where then one wall went in version 2, and another would go with the
    next."""
    for number, tile in ((1, (0, 0)), (2, (0, 1))):
        for vehicle in "ab":
            send(store, ballot(store, vehicle, f"d{number}", WALL, tile))
        if number == 1:
            publish(store)
    return store


class Answered(NamedTuple):
    """One request of :data:`ASKED`, and its answer."""

    method: str
    path: str
    """The route."""
    url: str
    body: dict[str, Any] | None
    """JSON that was sent."""
    answer: httpx2.Response


def answered(client: TestClient, store: Store) -> Iterator[Answered]:
    """Every request of :data:`ASKED` to an open server of :func:`lived_in`, in turn; the first key closes it."""
    kept: dict[str, str] = {}
    plane = store.tiles()[0, 0].points
    for method, path, asked, sent in ASKED:
        url = (asked or path).replace("SEQ", kept.get("seq", "")).replace("PLANE", plane)
        body = None
        if sent == "BALLOT":
            answer = client.put(url, content=encode(ballot(store, "a", "d3", WALL, (0, 1))))
        elif sent == "LANELETS":
            answer = client.post(url, content=LANELETS)
        elif sent == "PLANE":
            answer = client.put(url, content=client.get(url).content)
        else:
            body = {k: kept["pending"] if v == "PENDING" else v for k, v in sent.items()} if sent else None
            answer = client.request(method, url, json=body)
        yield Answered(method, path, url, body, answer)
        content = answer.json()
        if "seq" in content:
            kept["seq"] = str(content["seq"])
        if "key" in content:
            client.headers["Authorization"] = f"Bearer {content['key']}"
        if path == "/v1/desk" and not asked:
            kept["pending"] = [*content["pending"]["features"], *content["reviewed"]][0]["id"]
