"""The list of changes comes in parts, and a client that has it is told so without comparing anything again."""

from __future__ import annotations

from collections.abc import Iterator
from unittest import mock

import numpy as np
import pytest
from fastapi.testclient import TestClient

from hand_made import Cell, Say, make_ballot, make_map, make_tile, states_plane, wall
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote.shapes.change_objects import changed_cells
from mapvote_server.api.app import create_app
from mapvote_server.questions import changes
from mapvote_server.store.keys import issue
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.retention import clear
from mapvote_server.store.store import Store
from stores import NewStore, send

HEIGHTS_M = [0.45, 2.25, 4.35]
THINGS = 7


def thing(number: int) -> list[Cell]:
    """A wall, each longer than the one before; 12 m apart."""
    return [(40 * (number // 4) + 10, 40 * (number % 4) + 10 + i) for i in range(12 + number)]


@pytest.fixture
def store(new_store: NewStore) -> Store:
    """Seven walls of a tile, of which version 2 has none."""
    cells = [cell for number in range(THINGS) for cell in thing(number)]
    points = np.concatenate([wall(cells, [0.05]), wall(cells, HEIGHTS_M)])
    store = new_store(make_map({(0, 0): make_tile(points)}), Policy(fuse=FuseSettings(max_deleted_share=1.0)))
    say = Say(states_plane(dict.fromkeys(cells, CellState.CHANGED_EMPTY), fill=CellState.UNCHANGED_EMPTY))
    send(store, *(make_ballot(store.point_map(), {(0, 0): say}, name, end_ns=store.clock()) for name in "ab"))
    assert publish(store).published
    return store


@pytest.fixture
def client(store: Store) -> Iterator[TestClient]:
    with TestClient(create_app(store, opened=True), base_url="http://localhost") as found:
        yield found


def test_the_parts_of_a_list_are_the_list_largest_first(client: TestClient) -> None:
    whole = client.get("/v1/changes?from=1").json()
    assert (whole["numberMatched"], whole["numberReturned"]) == (THINGS, THINGS)
    cells = [feature["properties"]["cells"] for feature in whole["features"]]
    assert cells == [18, 17, 16, 15, 14, 13, 12]
    parts, url = [], "/v1/changes?from=1&limit=3"
    while url:
        answer = client.get(url)
        parts.append(answer.json()["features"])
        following = answer.links.get("next", {"url": ""})["url"]
        url = following and f"/v1/changes{following}"
    assert [len(part) for part in parts] == [3, 3, 1]
    assert [feature for part in parts for feature in part] == whole["features"]
    assert client.get("/v1/changes?from=1&offset=7").json()["features"] == []
    assert client.get("/v1/changes?from=1&min_cells=17&limit=1").json()["numberMatched"] == 2


def test_a_table_of_changes_has_parts_too(client: TestClient) -> None:
    first = client.get("/v1/changes?from=1&format=csv&limit=5")
    rest = client.get(f"/v1/changes{first.links['next']['url']}")
    assert [len(one.text.splitlines()) for one in (first, rest)] == [6, 3]
    assert "next" not in rest.links


def test_what_is_near_does_not_depend_on_the_part(client: TestClient) -> None:
    def near(url: str) -> list[list[str]]:
        return [feature["properties"]["near"] for feature in client.get(url).json()["features"]]

    whole = near("/v1/changes?from=1")
    assert any(whole)
    assert [near(f"/v1/changes?from=1&limit=1&offset={i}")[0] for i in range(THINGS)] == whole


@pytest.mark.parametrize("path", ["/v1/changes", "/v1/changes/page"])
def test_versions_are_compared_once_and_whoever_has_the_answer_is_told_so(client: TestClient, path: str) -> None:
    with mock.patch.object(changes, "changed_cells", wraps=changed_cells) as compared:
        first = client.get(f"{path}?from=1")
        assert compared.call_count == 1
        tag = first.headers["ETag"]
        for held in (tag, f'"other", W/{tag}', "*"):
            again = client.get(f"{path}?from=1&to=2", headers={"If-None-Match": held})
            assert (again.status_code, again.content) == (304, b"")
        other = client.get(f"{path}?from=1&min_cells=5", headers={"If-None-Match": tag})
        assert other.status_code == 200
        assert compared.call_count == 1


def test_who_may_not_know_names_and_times_has_another_answer(store: Store, client: TestClient) -> None:
    keys = [issue(store, "anna", "operator"), issue(store, "ron", "reader")]
    tags = [client.get("/v1/changes?from=1", headers={"Authorization": f"Bearer {k}"}).headers["ETag"] for k in keys]
    assert tags[0] != tags[1]


def test_a_version_that_was_cleared_away_is_not_answered_from_memory(store: Store, client: TestClient) -> None:
    tag = client.get("/v1/changes?from=1").headers["ETag"]
    store.change_policy({"keep.versions": 1})
    clear(store, dry_run=False)
    gone = client.get("/v1/changes?from=1&to=2", headers={"If-None-Match": tag})
    assert gone.status_code == 404


def test_a_comparison_that_ran_out_of_time_goes_on_where_it_stopped(store: Store) -> None:
    made = changes.compare_versions(store, 1, 2)
    with store.database.reading() as connection:
        pair = changes._Pair()
        with (
            mock.patch.object(changes, "change_objects", side_effect=TimeoutError),
            pytest.raises(TimeoutError),
        ):
            changes._compare(store, connection, 1, 2, pair)
        with mock.patch.object(changes, "load_tile", side_effect=AssertionError("read again")):
            assert changes._compare(store, connection, 1, 2, pair).digest == made.digest
