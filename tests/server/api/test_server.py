"""Vehicles and operators at a real server: a process of its own on loopback; and the API within one process, which the
command line uses on a store."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import httpx2
import pytest
from fastapi.testclient import TestClient

from hand_made import Say, make_ballot, states_plane, two_walls
from live_server import serving
from mapvote.client import MapClient
from mapvote.codec.ballot import Ballot, encode
from mapvote.config import FuseSettings, ServerSettings, Settings
from mapvote.core.point_map import PointMap
from mapvote.core.types import CellState
from mapvote_server.api.app import URL, create_app, in_process
from mapvote_server.store import keys
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import NewStore, send

CELL = (10, 10)
OPERATES: list[tuple[str, str, object]] = [
    ("POST", "/v1/publish", {}),
    ("POST", "/v1/rollback", {"to": 1}),
    ("POST", "/v1/replay", {"vehicle": "b"}),
    ("PATCH", "/v1/policy", {"values": {}}),
    ("DELETE", "/v1/ballots/b", None),
    ("DELETE", "/v1/ballots?everybody=true", None),
    ("PUT", f"/v1/tiles/{'0' * 64}", None),
    *((method, f"/v1/{what}", None) for method in ("GET", "POST") for what in ("check", "gc")),
    ("GET", "/v1/keys", None),
    ("POST", "/v1/keys", {"name": "a", "role": "operator"}),
    ("POST", "/v1/keys/rotate", {"name": "boss"}),
    ("POST", "/v1/keys/revoke", {"name": "b"}),
]


class Site(NamedTuple):
    """A running server with keys for an operator and two vehicles."""

    url: str
    operator: str
    a: str
    b: str
    store: Store
    log: Path

    def ask(self, method: str, path: str, key: str | None, **more: object) -> httpx2.Response:
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        return httpx2.request(method, self.url + path, headers=headers, timeout=300.0, **more)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    home = tmp_path_factory.mktemp("site")
    store = Store.create(f"sqlite:///{home / 'store.db'}", two_walls())
    operator = keys.issue(store, "boss", "operator")
    a, b = (keys.issue(store, name, "vehicle") for name in "ab")
    with serving(home / "store.db", log=home / "log") as (url, _):
        yield Site(url, operator, a, b, store, home / "log")
    store.close()


def says(point_map: PointMap, vehicle: str, drive: str = "d1", state: int = CellState.CHANGED_EMPTY) -> Ballot:
    return make_ballot(point_map, {(0, 0): Say(states_plane({CELL: state}))}, vehicle, drive)


def test_the_whole_story(site: Site, tmp_path: Path) -> None:
    """Two vehicles fetch the map and vote, the operator publishes, a third fetches only the tile that changed."""
    for key, name in ((site.a, "a"), (site.b, "b")):
        with MapClient(site.url, key=key, home=tmp_path / name) as client:
            point_map = client.fetch()
            assert client.version == 1
            assert client.send(says(point_map, name)) == "created"
            assert client.send(says(point_map, name)) == "repeated"
    assert site.ask("POST", "/v1/publish", site.operator, json={"dry_run": True}).json()["points_deleted"] == 3
    done = site.ask("POST", "/v1/publish", site.operator, json={"parent": 1}).json()
    assert done == {
        "version": 2, "published": True, "tiles": ["0,0"], "points_added": 0, "points_deleted": 3, "held": [],
        "doubts": [],
        "waits": ""
    }  # fmt: skip
    assert site.ask("POST", "/v1/publish", site.operator, json={"parent": 1}).status_code == 409
    before = len(list((tmp_path / "a" / "planes").iterdir()))
    with MapClient(site.url, key=site.a, home=tmp_path / "a") as client:
        assert len(client.fetch().tiles[0, 0].points) == len(two_walls().tiles[0, 0].points) - 3
        assert len(client.fetch(1).tiles[0, 0].points) == len(two_walls().tiles[0, 0].points)
    assert len(list((tmp_path / "a" / "planes").iterdir())) == before + 1
    found = site.ask("GET", "/v1/changes?from=1&to=2", site.operator).json()
    assert [f["properties"]["kind"] for f in found["features"]] == ["demolished"]
    assert found["features"][0]["properties"]["votes_min"] == 2
    exact = found["features"][0]["properties"]["last_seen"]
    by_day = site.ask("GET", "/v1/changes?from=1&to=2", site.a).json()["features"][0]["properties"]["last_seen"]
    assert (by_day[:10], by_day[10:19]) == (exact[:10], "T00:00:00"), "no minute of anybody's pass"
    assert exact != by_day
    cell = site.ask("GET", "/v1/cells?x=3.1&y=3.1", site.operator).json()
    assert [(v["vehicle"], v["state"], v["counts"]) for v in cell["votes"]] == [
        ("a", "changed_empty", False),
        ("b", "changed_empty", False),
    ]
    assert cell["decisions"] == [{"version": 2, "state": "changed_empty", "edit": None, "fell": ""}]
    tiles = site.ask("GET", "/v1/coverage", site.operator).json()["tiles"]
    assert [(t["vehicles"], t["last_seen"] is not None) for t in tiles] == [(2, True), (0, False)]
    assert site.ask("POST", "/v1/rollback", site.operator, json={"to": 1}).json() == {"version": 3}
    versions = site.ask("GET", "/v1/map/versions", site.operator).json()["versions"]
    assert [v["kind"] for v in versions] == ["import", "publish", "rollback"]
    assert versions[1]["policy"]["fuse"]["min_votes"] == 2


def test_no_route_answers_without_a_key(site: Site) -> None:
    paths = site.ask("GET", "/openapi.json", site.operator).json()["paths"]
    assert len(paths) >= 12
    for path in [*paths, "/", "/docs", "/openapi.json", "/viewer/app.js", "/nothing"]:
        for key in (None, "wrong"):
            probed = key is None and path in ("/livez", "/readyz")
            assert site.ask("GET", path, key).status_code == (200 if probed else 401), path


def test_a_vehicle_touches_its_own_ballots_only_and_never_operates(site: Site) -> None:
    ballot = encode(says(two_walls(), "b", "theft"))
    assert site.ask("PUT", "/v1/ballots/b/theft", site.a, content=ballot).status_code == 403
    assert site.ask("PUT", "/v1/ballots/a/theft", site.a, content=ballot).status_code == 422
    assert site.ask("DELETE", "/v1/ballots/b/d1", site.a).status_code == 403
    for method, path, body in OPERATES:
        assert site.ask(method, path, site.a, json=body).status_code == 403, path


def test_browsers_send_the_key_as_a_password(site: Site) -> None:
    page = httpx2.get(site.url + "/", auth=("operator", site.operator), timeout=300.0)
    assert page.status_code == 200
    assert "text/html" in page.headers["content-type"]


def test_a_browser_is_asked_for_the_key_by_a_form_and_keeps_it_in_a_cookie(site: Site) -> None:
    html = {"Accept": "text/html,application/xhtml+xml"}
    with httpx2.Client(base_url=site.url, timeout=60.0) as browser:
        page = browser.get("/", headers=html)
        assert (page.status_code, page.headers["www-authenticate"]) == (401, "Bearer"), (
            "no question of the browser's own"
        )
        assert 'action="key"' in page.text
        assert browser.get("/viewer/key.css").status_code == 200
        assert browser.get("/viewer/app.js").status_code == 401, "nothing else without a key"
        wrong = browser.post("/key", data={"key": "wrong"})
        assert (wrong.status_code, "unknown" in wrong.text) == (401, True)
        assert browser.post("/key", content=b"\xff" * 9_000).status_code == 401
        right = browser.post("/key", data={"key": site.operator})
        assert (right.status_code, right.headers["location"]) == (303, "./")
        assert {"HttpOnly", "SameSite=strict"} <= set(right.headers["set-cookie"].split("; "))
        assert browser.get("/", headers=html).status_code == 200
        assert browser.get("/v1/desk").status_code == 200
        assert browser.get("/v1/desk", headers={"Origin": "http://evil.example"}).status_code == 403
    assert site.operator not in site.log.read_text()


def test_errors_say_what_to_do(site: Site) -> None:
    unknown = site.ask("GET", "/v1/map?since=99", site.a)
    assert (unknown.status_code, "newest is" in unknown.json()["detail"]) == (404, True)
    assert site.ask("GET", "/v1/map/versions/99", site.a).status_code == 404
    assert site.ask("GET", f"/v1/tiles/{'0' * 64}", site.a).status_code == 404
    assert site.ask("DELETE", "/v1/ballots/a/never", site.a).status_code == 404
    assert site.ask("GET", "/v1/cells?x=1e300&y=0", site.a).status_code == 422
    assert site.ask("GET", "/v1/cells?x=nan&y=0", site.a).status_code == 422


def test_tiles_are_immutable_and_cacheable(site: Site) -> None:
    digest = site.ask("GET", "/v1/map/versions/1", site.a).json()["tiles"]["0,1"]["points"]
    answer = site.ask("GET", f"/v1/tiles/{digest}", site.a)
    assert "immutable" in answer.headers["cache-control"]
    headers = {"Authorization": f"Bearer {site.a}", "If-None-Match": answer.headers["etag"]}
    assert httpx2.get(f"{site.url}/v1/tiles/{digest}", headers=headers, timeout=300.0).status_code == 304


def test_a_manifest_is_sent_again_only_when_the_map_is_a_new_one(new_store: NewStore, tmp_path: Path) -> None:
    """Also when another process publishes it."""
    store = new_store()
    elsewhere = Store.open(f"sqlite:///{tmp_path / 's.db'}")
    with TestClient(create_app(store, opened=True), base_url="http://localhost") as http:
        first = http.get("/v1/map")
        known = {"If-None-Match": first.headers["etag"]}
        again = http.get("/v1/map", headers=known)
        assert (again.status_code, again.content) == (304, b"")
        assert http.get("/v1/map?since=1", headers=known).json()["tiles"] == {}
        send(elsewhere, *[says(store.point_map(), vehicle) for vehicle in ("a", "b")])
        assert publish(elsewhere, FuseSettings(max_deleted_share=1.0)).version == 2
        new = http.get("/v1/map", headers=known)
        assert (new.status_code, new.json()["version"]) == (200, 2)
        assert list(http.get("/v1/map?since=1").json()["tiles"]) == ["0,0"]
        assert http.get("/v1/map/versions/1", headers=known).status_code == 304
    elsewhere.close()


def test_metrics_and_logs_hold_no_secret(site: Site) -> None:
    text = site.ask("GET", "/metrics", site.operator).text
    assert "mapvote_requests_total" in text
    assert "mapvote_version" in text
    log = site.log.read_text()
    assert all(json.loads(line)["event"] for line in log.splitlines())
    for secret in (site.operator, site.a, site.b):
        assert secret not in log + text


def test_a_revoked_key_stops_working_at_once(site: Site) -> None:
    key = keys.issue(site.store, "c", "vehicle")
    assert site.ask("GET", "/v1/map", key).status_code == 200
    newest = replace(two_walls(), version=site.ask("GET", "/v1/map", key).json()["version"])
    ballots = [encode(says(newest, "c", drive, CellState.UNCHANGED_OCCUPIED)) for drive in ("d1", "d2")]
    assert site.ask("PUT", "/v1/ballots/c/d1", key, content=ballots[0]).status_code == 201
    keys.revoke(site.store, "c")
    assert site.ask("PUT", "/v1/ballots/c/d2", key, content=ballots[1]).status_code == 401
    assert site.ask("GET", "/v1/map", key).status_code == 401


@pytest.mark.parametrize("headers", [{}, {"Host": "mapvote.default.svc"}])
def test_a_probe_needs_no_key_and_no_name_and_learns_nothing_else(site: Site, headers: dict[str, str]) -> None:
    for path in ("/livez", "/readyz"):
        answer = httpx2.get(site.url + path, headers=headers, timeout=300.0)
        assert (answer.status_code, answer.content) == (200, b"")
        assert httpx2.post(site.url + path, headers=headers, timeout=300.0).status_code in (401, 403)
    assert httpx2.get(site.url + "/healthz", headers=headers, timeout=300.0).status_code in (401, 403)
    assert site.ask("GET", "/readyz", "wrong").status_code == 401
    assert site.ask("GET", "/readyz", site.a).json()["status"] == "ready"


@pytest.fixture
def client(new_store: NewStore) -> Iterator[httpx2.Client]:
    """The API of a store that holds a key, as its owner ``kim``; over HTTP its vehicles could send one drive a day."""
    store = new_store()
    keys.issue(store, "v1", "vehicle")
    settings = Settings(server=ServerSettings(drives_a_day=1))
    with in_process(store, settings, owner="kim") as transport:
        yield httpx2.Client(transport=transport, base_url=URL)


def test_the_owner_of_a_store_needs_no_key_and_no_quota_and_signs_what_he_does(client: httpx2.Client) -> None:
    for drive in ("d1", "d2"):
        states = states_plane({}, fill=CellState.UNCHANGED_EMPTY)
        ballot = encode(make_ballot(two_walls(), {(0, 0): Say(states)}, "v1", drive))
        assert client.put(f"/v1/ballots/v1/{drive}", content=ballot).status_code == 201
    assert client.request("DELETE", "/v1/ballots/v1/d2").json() == {"withdrawn": 1}
    assert client.get("/v1/log", params={"events": 1}).json()["events"][0]["actor"] == "kim"


def test_a_plane_comes_compressed_or_not(client: httpx2.Client) -> None:
    digest = next(iter(client.get("/v1/map").json()["tiles"].values()))["points"]
    plain = client.get(f"/v1/tiles/{digest}", headers={"Accept-Encoding": "identity"}).content
    assert client.get(f"/v1/tiles/{digest}", headers={"Accept-Encoding": "zstd"}).content == plain


def test_what_is_refused_is_the_same_answer_as_over_http(client: httpx2.Client) -> None:
    answer = client.post("/v1/rollback", json={"to": 7})
    assert (answer.status_code, list(answer.json())) == (404, ["type", "title", "status", "detail", "instance"])
