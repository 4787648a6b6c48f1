"""The desk on SQLite and PostgreSQL: what people decide about a change, and that publishing obeys."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from threading import Event
from time import sleep
from typing import Any

import pytest
from fastapi.testclient import TestClient

from hand_made import two_walls
from mapvote.codec.manifest import TileHashes
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote_server.api.app import create_app
from mapvote_server.questions.clouds import Clouds
from mapvote_server.store import keys
from mapvote_server.store.publish import round_at
from mapvote_server.store.store import Store
from stores import vote_gone

Server = tuple[TestClient, Store, dict[str, dict[str, str]]]


def vote(store: Store, drive: str) -> None:
    """Two vehicles say that both walls are gone."""
    vote_gone(store, ("v1", "v2"), drive, [(0, 0), (0, 1)], CellState.UNCHANGED_EMPTY)


@pytest.fixture
def server(database_url: str) -> Iterator[Server]:
    """A server where a publish would take two walls away; keys of two reviewers, an operator and a vehicle."""
    store = Store.create(database_url, two_walls())
    now = store.policy()
    store.set_policy(now.model_copy(update={"fuse": FuseSettings(max_deleted_share=1.0)}), by="test")
    vote(store, "d1")
    people: dict[str, keys.Role] = {"anna": "reviewer", "bert": "reviewer", "boss": "operator", "v1": "vehicle"}
    who = {name: {"Authorization": f"Bearer {keys.issue(store, name, role)}"} for name, role in people.items()}
    with TestClient(create_app(store), base_url="http://localhost") as client:
        yield client, store, who
    store.close()


def pending(server: Server) -> list[dict[str, Any]]:
    client, _, who = server
    found: list[dict[str, Any]] = client.get("/v1/desk", headers=who["anna"]).json()["pending"]["features"]
    return found


def decide(server: Server, who: str, change: str, verdict: str, **more: Any) -> Any:
    client, _, whose = server
    return client.post("/v1/desk/reviews", headers=whose[who], json={"change": change, "verdict": verdict} | more)


def published(server: Server) -> dict[str, Any]:
    client, _, who = server
    answer: dict[str, Any] = client.post("/v1/publish", headers=who["boss"], json={}).json()
    return answer


def test_what_was_rejected_is_left_out_and_the_same_votes_never_bring_it_back(server: Server) -> None:
    first, second = pending(server)
    assert first["properties"]["votes_median"] == 2
    assert decide(server, "anna", first["id"], "rejected", comment="a wall of glass").status_code == 200
    assert [f["id"] for f in pending(server)] == [second["id"]]
    assert published(server)["points_deleted"] == 9, "the other wall alone"
    assert published(server)["published"] is False
    assert pending(server) == []
    vote(server[1], "d2")
    assert [f["properties"]["kind"] for f in pending(server)] == ["demolished"], "new drives do"


def test_what_is_held_waits_for_all_votes_until_it_is_let_go(server: Server) -> None:
    client, store, who = server
    first, _ = pending(server)
    seq = decide(server, "anna", first["id"], "held").json()["seq"]
    assert published(server)["points_deleted"] == 9
    vote(store, "d2")
    assert pending(server) == []
    (waiting,) = client.get("/v1/desk", headers=who["bert"]).json()["reviewed"]
    assert (waiting["id"], waiting["properties"]["verdict"]["by"]) == (f"verdict.{seq}", "anna")
    assert client.delete(f"/v1/desk/reviews/{seq}", headers=who["bert"]).status_code == 200
    assert published(server)["points_deleted"] == 9, "no new vote was needed"


def test_a_verdict_alone_makes_its_tile_one_to_decide_again(server: Server) -> None:
    """Nothing else happened there since it was last decided: no ballot, no version."""
    client, store, who = server
    first, _ = pending(server)
    seq = decide(server, "anna", first["id"], "held").json()["seq"]
    assert published(server)["tiles"] == ["0,1"]
    assert list(round_at(store, store.clock()).decided) == [(0, 1)], "what the newest version changed"
    assert client.delete(f"/v1/desk/reviews/{seq}", headers=who["anna"]).status_code == 200
    assert list(round_at(store, store.clock()).decided) == [(0, 0), (0, 1)]
    (again,) = pending(server)
    assert decide(server, "bert", again["id"], "rejected").status_code == 200
    assert published(server)["published"] is False
    assert published(server)["published"] is False, "and it stays so"


def test_of_two_reviewers_at_once_one_wins_and_the_other_is_told_by_whom(server: Server) -> None:
    change = pending(server)[0]["id"]
    with ThreadPoolExecutor(2) as both:
        answers = list(both.map(lambda who: decide(server, who, change, "accepted"), ("anna", "bert")))
    assert sorted(answer.status_code for answer in answers) == [200, 409]
    told = next(answer.json()["detail"] for answer in answers if answer.status_code == 409)
    assert "has accepted this change meanwhile" in told
    seen = next(f["properties"]["verdict"] for f in pending(server) if f["id"] == change)
    loser = "bert" if seen["by"] == "anna" else "anna"
    assert decide(server, loser, change, "held", after=seen["seq"]).status_code == 200, "having looked again"
    assert decide(server, seen["by"], f"verdict.{seen['seq']}", "rejected", after=seen["seq"]).status_code == 404


def test_a_verdict_can_be_taken_back_once(server: Server) -> None:
    client, _, who = server
    before = pending(server)
    told = "<script>alert(1)</script>\u202e'; DROP TABLE reviews; --"
    seq = decide(server, "anna", before[0]["id"], "rejected", comment=told).json()["seq"]
    (left_out,) = client.get("/v1/desk", headers=who["boss"]).json()["reviewed"]
    assert left_out["properties"]["verdict"]["comment"] == told, "text stays text"
    assert client.delete(f"/v1/desk/reviews/{seq}", headers=who["anna"]).status_code == 200
    assert client.delete(f"/v1/desk/reviews/{seq}", headers=who["bert"]).status_code == 409
    assert client.delete("/v1/desk/reviews/0", headers=who["bert"]).status_code == 404
    assert pending(server) == before


def test_only_reviewers_and_operators_sit_at_the_desk(server: Server) -> None:
    client, _, who = server
    assert client.get("/v1/desk", headers=who["v1"]).status_code == 403
    assert client.get("/v1/paths", headers=who["v1"]).status_code == 403
    assert decide(server, "v1", "x", "accepted").status_code == 403
    assert decide(server, "boss", "x", "accepted").status_code == 404
    assert client.get("/v1/desk").status_code == 401


def test_a_pending_change_can_be_looked_at_in_3d_as_it_would_be(server: Server) -> None:
    client, store, who = server
    asked = client.get("/v1/desk/clouds", headers=who["anna"])
    changed = Clouds(store)
    now = client.get("/v1/desk", headers=who["anna"]).json()
    (tile,) = [hashes for name, hashes in now["tiles"].items() if name == "0,0"]
    levels = [client.get(f"/v1/clouds/{tile['points']}/{tile['ground']}/{k}", headers=who["anna"]) for k in range(6)]
    assert client.get("/v1/desk/clouds", headers=who["v1"]).status_code == 403
    assert published(server)["version"] == 2
    assert asked.content == changed.changed(1, 2), "what is shown is what is published"
    held = changed.levels(TileHashes(tile["points"], tile["ground"], None))
    assert [answer.content for answer in levels] == [held.part(k) for k in range(6)]


def test_every_list_is_geojson_where_it_has_a_place_and_csv_always(server: Server) -> None:
    client, _, who = server
    first, second = pending(server)
    decide(server, "anna", first["id"], "rejected", comment="=glass")
    for path in ("desk", "coverage", "vehicles"):
        found = client.get(f"/v1/{path}?format=geojson", headers=who["boss"]).json()
        assert found["type"] == "FeatureCollection"
    tiles = client.get("/v1/coverage?format=geojson", headers=who["boss"]).json()["features"]
    corners = tiles[1]["geometry"]["coordinates"][0]
    assert (tiles[1]["properties"]["col"], corners[0], corners[2]) == (1, [76.8, 0.0], [153.6, 76.8])
    desk = client.get("/v1/desk?format=csv", headers=who["boss"]).text.splitlines()
    assert len(desk) == 3, "what waits and what was rejected"
    assert ",rejected,anna,'=glass" in desk[2], "no spreadsheet takes a comment for a formula"
    versions = client.get("/v1/map/versions?format=csv", headers=who["boss"]).text.splitlines()
    assert versions[0].startswith("number,parent,kind,target,published_by,reason,created")
    assert len(versions) == 2
    vehicles = client.get("/v1/vehicles?format=csv", headers=who["boss"]).text.splitlines()
    assert [row.split(",")[0] for row in vehicles] == ["vehicle", "v1", "v2"]
    assert second["id"] in desk[1]


def test_a_publish_tells_how_far_it_is_and_can_be_cancelled(server: Server) -> None:
    _, store, who = server
    go_on = Event()
    with ThreadPoolExecutor(1) as fusing, ThreadPoolExecutor(1) as beside:
        fusing.submit(go_on.wait, 30)
        with TestClient(create_app(store, executor=fusing), base_url="http://localhost") as client:
            assert client.delete("/v1/publish", headers=who["boss"]).status_code == 404, "nothing is being published"
            asked = beside.submit(client.post, "/v1/publish", headers=who["boss"], json={})
            try:
                running: list[dict[str, Any]] = []
                while not running or not running[0]["of"]:
                    running = client.get("/v1/publish", headers=who["anna"]).json()["running"]
                    sleep(0.01)
                assert running == [{"by": "boss", "dry_run": False, "done": 0, "of": 2, "cancelled_by": None}]
                assert client.delete("/v1/publish", headers=who["anna"]).status_code == 403, "reviewers only look"
                assert client.delete("/v1/publish", headers=who["boss"]).json() == {"cancelled": 1}
            finally:
                go_on.set()
            answer = asked.result(30)
            assert answer.status_code == 409
            assert answer.json()["detail"] == "cancelled by boss after 1 of 2 tiles: nothing was published"
            assert client.get("/v1/map", headers=who["boss"]).json()["version"] == 1
            assert client.get("/v1/publish", headers=who["boss"]).json() == {"running": []}
            again = client.post("/v1/publish", headers=who["boss"], json={}).json()
            assert again["published"], "the votes still stand"


def test_the_list_of_changes_waits_for_nobody_at_the_desk(server: Server) -> None:
    _, store, who = server
    go_on = Event()
    with ThreadPoolExecutor(1) as fusing, ThreadPoolExecutor(3) as beside:
        blocked = fusing.submit(go_on.wait, 30)
        with TestClient(create_app(store, executor=fusing), base_url="http://localhost") as client:
            looks = [beside.submit(client.get, "/v1/desk", headers=who["anna"]) for _ in range(3)]
            try:
                assert client.get("/v1/changes?from=1", headers=who["v1"]).status_code == 200
                assert not blocked.done(), "the desk still waits for tiles to be fused"
                assert not any(look.done() for look in looks)
            finally:
                go_on.set()
            assert [look.result(30).status_code for look in looks] == [200, 200, 200]


def test_what_is_beyond_the_budget_is_listed_apart_with_where_to_drive_by(server: Server) -> None:
    """Ballots that do not say how sure they are: a budget so small lets nothing go."""
    client, store, who = server
    store.change_policy({"fuse.false_deletions": "1e-6"}, by="test")
    told = client.get("/v1/desk", headers=who["anna"]).json()
    assert told["pending"]["features"] == []
    assert [f["properties"]["drive_by"] for f in told["waiting"]] == [[3.45, 3.15], [80.25, 3.15]]
    listed = client.get("/v1/desk", params={"format": "csv"}, headers=who["anna"]).text.splitlines()
    assert len(listed) == 3
    assert "drive_by" in listed[0]
    assert all(row.startswith("waits.demolished.") for row in listed[1:])
    assert published(server)["published"] is False
