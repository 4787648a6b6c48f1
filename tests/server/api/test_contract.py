"""Declarations of the API: keys, limits, methods, encodings, ranges."""

from __future__ import annotations

import re
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.exc import OperationalError

from asked import POLICY, lived_in
from hand_made import two_walls
from mapvote_server.api.app import create_app
from mapvote_server.errors import Unavailable
from mapvote_server.store.database import Database, _clear_errors
from mapvote_server.store.keys import issue
from mapvote_server.store.store import Store
from stores import NewStore


@pytest.fixture
def client(new_store: NewStore) -> Iterator[TestClient]:
    with TestClient(create_app(new_store(), opened=True), base_url="http://localhost") as client:
        yield client


def test_the_document_says_how_a_key_is_sent_and_that_every_route_may_be_refused_for_a_while(
    client: TestClient,
) -> None:
    document = client.get("/openapi.json").json()
    schemes = document["components"]["securitySchemes"]
    assert {scheme["type"] for scheme in schemes.values()} == {"http", "apiKey"}
    assert [name for entry in document["security"] for name in entry] == list(schemes)
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            assert {"401", "429"} <= set(operation["responses"]), (method, path)
            assert ({} in operation.get("security", ())) == (path in ("/livez", "/readyz")), (method, path)


def test_every_operation_has_a_name_of_its_own_a_group_a_summary_and_one_shape_of_errors(client: TestClient) -> None:
    document = client.get("/openapi.json").json()
    operations = [operation for methods in document["paths"].values() for operation in methods.values()]
    names = [operation["operationId"] for operation in operations]
    assert len(set(names)) == len(names)
    assert not [name for name in names if not re.fullmatch(r"[a-z]+(_[a-z]+)*", name)], "names for a client's code"
    assert {tag for one in operations for tag in one["tags"]} == {tag["name"] for tag in document["tags"]}
    assert all(operation["summary"] for operation in operations)
    refusals = [a for one in operations for code, a in one["responses"].items() if code[0] in "45"]
    assert {tuple(answer["content"]) for answer in refusals} == {("application/problem+json",)}


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/nothing", 404),
        ("GET", "/v1/map/versions/9", 404),
        ("GET", "/v1/map/versions/x", 422),
        ("POST", "/v1/map", 405),
        ("GET", "/ogc/collections/x", 404),
        ("GET", "/ogc?x=1", 400),
    ],
)
def test_every_refusal_is_a_problem_of_rfc_9457(client: TestClient, method: str, path: str, status: int) -> None:
    answer = client.request(method, path)
    assert answer.headers["content-type"] == "application/problem+json"
    told = answer.json()
    assert (told["type"], told["status"], answer.status_code) == ("about:blank", status, status)
    assert (told["title"], told["instance"]) == (HTTPStatus(status).phrase, path.partition("?")[0])
    assert told["detail"]


@pytest.fixture
def lived(new_store: NewStore) -> Iterator[TestClient]:
    """A client of a store with something of everything, as an operator."""
    store = lived_in(new_store(two_walls(), POLICY))
    for name in ("boss", "office"):
        key = issue(store, name, "operator")
    with TestClient(create_app(store), base_url="http://localhost") as client:
        client.headers["Authorization"] = f"Bearer {key}"
        yield client


def parts_of(client: TestClient, path: str, member: str) -> list[list[Any]]:
    """The parts of a list, as the links lead from one to the next."""
    parts = []
    query: str | None = path
    while query:
        answer = client.get(query)
        assert answer.status_code == 200, answer.text
        parts.append(answer.json()[member])
        following = answer.links.get("next", {"url": ""})["url"]
        query = following and path.partition("?")[0] + following
    return parts


@pytest.mark.parametrize(
    ("path", "member"),
    [
        ("/v1/map/versions?", "versions"),
        ("/v1/changes?from=1&", "features"),
        ("/v1/coverage?", "tiles"),
        ("/v1/coverage?format=geojson&", "features"),
        ("/v1/vehicles?", "vehicles"),
        ("/v1/paths?", "features"),
        ("/v1/coverage/passes?", "features"),
        ("/v1/desk?format=geojson&", "features"),
        ("/v1/keys?", "keys"),
    ],
)
def test_the_parts_of_every_list_are_the_list(lived: TestClient, path: str, member: str) -> None:
    (whole,) = parts_of(lived, path.rstrip("?&"), member)
    assert whole or "passes" in path
    parts = parts_of(lived, f"{path}limit=1", member)
    assert [one for part in parts for one in part] == whole
    assert all(len(part) <= 1 for part in parts)


def test_the_events_of_the_log_come_in_parts_too(lived: TestClient) -> None:
    whole = lived.get("/v1/log?events=10000").json()["events"]
    assert [event for part in parts_of(lived, "/v1/log?events=3", "events") for event in part] == whole


@pytest.mark.parametrize(
    ("path", "near", "all_over"),
    [
        ("changes?from=1&", 1, 1),
        ("coverage?format=geojson&", 1, 2),
        ("paths?", 2, 4),
        ("desk?format=geojson&", 0, 1),
    ],
)
def test_a_box_leaves_what_meets_it(lived: TestClient, path: str, near: int, all_over: int) -> None:
    """A wall stands at 3 m of each of two tiles, 76.8 m wide; two vehicles drove by each."""
    every = lived.get(f"/v1/{path}bbox=-1000,-1000,1000,1000").json()["features"]
    first = lived.get(f"/v1/{path}bbox=2,2,5,5").json()["features"]
    assert every == lived.get(f"/v1/{path.rstrip('?&')}").json()["features"]
    assert (len(first), len(every)) == (near, all_over)
    assert [one for one in every if one in first] == first
    assert lived.get(f"/v1/{path}bbox=500,500,501,501").json()["features"] == []
    assert lived.get(f"/v1/{path}bbox=5,5,2,2").json()["features"] == first, "by any two opposite corners"
    assert lived.get(f"/v1/{path}bbox=1,2,3").status_code == 422


def test_an_error_of_the_server_itself_is_a_problem_too(new_store: NewStore) -> None:
    store = new_store()
    app = create_app(store, opened=True)
    client = TestClient(app, base_url="http://localhost", raise_server_exceptions=False)
    with client, mock.patch.object(Store, "blob", side_effect=ZeroDivisionError):
        answer = client.get(f"/v1/tiles/{'0' * 64}")
    assert (answer.status_code, answer.json()["status"]) == (500, 500)
    assert "ZeroDivisionError" not in answer.text


@pytest.mark.parametrize(
    "path", ["/", "/v1/info", "/v1/changes?from=1&to=1", "/v1/changes?from=x", "/nothing", "/stac"]
)
def test_head_answers_as_get_without_content(client: TestClient, path: str) -> None:
    head = client.head(path)
    got = client.get(path)
    assert (head.status_code, head.content) == (got.status_code, b"")
    assert head.headers == got.headers


def test_head_of_a_stream_ends(client: TestClient) -> None:
    head = client.head("/v1/events")
    assert (head.status_code, head.content, head.headers["content-type"]) == (
        200,
        b"",
        "text/event-stream; charset=utf-8",
    )


@pytest.mark.parametrize(
    ("path", "allow"),
    [
        ("/v1/keys", "GET, HEAD, POST"),
        ("/v1/publish", "DELETE, GET, HEAD, POST"),
        ("/v1/ballots/a/d", "DELETE, PUT"),
        (f"/v1/tiles/{'0' * 64}", "GET, HEAD, PUT"),
        ("/v1/map", "GET, HEAD"),
    ],
)
def test_a_405_names_every_method_of_the_path(client: TestClient, path: str, allow: str) -> None:
    answer = client.request("OPTIONS", path)
    assert (answer.status_code, answer.headers["allow"]) == (405, allow)
    assert allow in answer.json()["detail"]


@pytest.mark.parametrize(
    ("accepted", "zstd"),
    [
        ("zstd", True),
        ("gzip, ZSTD;q=0.5", True),
        ("zstd;q=0", False),
        ("gzip, zstd; q=0.0", False),
        ("zstd;q=x", False),
        ("xzstd", False),
        ("", False),
    ],
)
def test_zstd_is_sent_to_who_takes_it(client: TestClient, accepted: str, zstd: bool) -> None:
    plane = client.get("/v1/map").json()["tiles"]["0,0"]["points"]
    for path in ("/viewer/app.js", f"/v1/tiles/{plane}", "/v1/clouds/overview", "/v1/evidence/0/0"):
        answer = client.get(path, headers={"Accept-Encoding": accepted})
        assert (answer.headers.get("content-encoding") == "zstd") is zstd, path


@pytest.mark.parametrize("number", ["-5", "0", "-1", str(1 << 31)])
def test_a_number_that_no_version_can_have_is_422_wherever_it_stands(client: TestClient, number: str) -> None:
    for path in (
        f"/v1/changes?from={number}",
        f"/v1/changes?from=1&to={number}",
        f"/v1/changes/page?from={number}",
        f"/v1/map?since={number}",
        f"/v1/map/versions/{number}",
        f"/v1/clouds/changed?from={number}&to=1",
        f"/v1/clouds/overview?version={number}",
    ):
        assert client.get(path).status_code == 422, path
    assert client.post("/v1/rollback", json={"to": int(number)}).status_code == 422


def test_a_whole_number_may_have_a_fraction_of_zero_as_json_has_one_kind_of_number(client: TestClient) -> None:
    assert client.post("/v1/rollback", json={"to": 7.0}).status_code == 404
    assert client.post("/v1/publish", json={"parent": 1.0, "dry_run": True}).status_code == 200
    assert client.post("/v1/rollback", json={"to": 1.5}).status_code == 422


@pytest.mark.parametrize("path", ["keys", "keys/rotate", "keys/revoke"])
@pytest.mark.parametrize("name", ["", "../x", "a b", "a" * 65, ".a"])
def test_a_name_that_cannot_be_one_is_422_by_its_pattern(client: TestClient, path: str, name: str) -> None:
    answer = client.post(f"/v1/{path}", json={"name": name})
    assert (answer.status_code, "pattern" in answer.json()["detail"]) == (422, True)


@pytest.mark.parametrize(
    ("reason", "says"),
    [
        ("attempt to write a readonly database", "mount the disk writable"),
        ("cannot execute INSERT in a read-only transaction", "mount the disk writable"),
        ("database or disk is full", "free space"),
        ("database is locked", "try again"),
    ],
)
def test_a_store_that_cannot_be_written_says_what_helps(reason: str, says: str) -> None:
    with pytest.raises(Unavailable, match=says) as refused, _clear_errors():
        raise OperationalError("INSERT", {}, Exception(reason))
    assert ("try again" in str(refused.value)) == ("read" not in reason)


def test_a_file_that_is_read_only_is_told_so(tmp_path: Path) -> None:
    database = Database(f"sqlite:///file:{tmp_path / 's.db'}?mode=ro&uri=true")
    Database(f"sqlite:///{tmp_path / 's.db'}").make_private_file()
    with pytest.raises(Unavailable, match="mount the disk writable"), database.writing() as connection:
        connection.exec_driver_sql("CREATE TABLE t (a)")
    database.close()
