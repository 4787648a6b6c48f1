"""Clouds by HTTP: what the page is sent is the map, and nothing that it vendors was altered."""

from __future__ import annotations

import hashlib
import re
import struct
from collections.abc import Iterator
from importlib.resources import files

import numpy as np
import pytest
from fastapi.testclient import TestClient
from msgspec.structs import replace

from hand_made import make_ballot, make_map, two_walls
from mapvote.codec.ballot import pack_path
from mapvote.config import FuseSettings
from mapvote.core.tile import Tile
from mapvote.core.types import CellState
from mapvote.fusion.loss_budget import change_probability
from mapvote_server.api.app import create_app
from mapvote_server.store.publish import publish
from stores import NewStore, send, wall_gone

VENDORED = {
    "three.core.min.js": "e5a824c8ec97ee44aeb8ce0ab64664e1dd1777df9d0ab2345b35f9941a9fcf33",
    "three.module.min.js": "0f860495069067a103d1df99e2bb01260f250e118ed7a50537167412ba195a0a",
    "LICENSE": "bfe119ea4fd413f5f7ca3fcd63adb0c4a073ed39daa2fe7d3e6b769e21272601",
}


@pytest.fixture
def client(new_store: NewStore) -> Iterator[TestClient]:
    """Two walls, one of which two vehicles saw gone; the path of the first."""
    store = new_store()
    says = {(0, 0): wall_gone(CellState.UNCHANGED_EMPTY)}
    way = pack_path([np.array([x, 6.0, 2.0]) for x in np.arange(2.0, 42.0, 0.5)], store.lattice)
    first, second = (make_ballot(two_walls(), says, name, end_ns=store.clock()) for name in ("v1", "v2"))
    send(store, replace(first, path=way), second)
    publish(store, FuseSettings(max_deleted_share=1.0))
    with TestClient(create_app(store, opened=True), base_url="http://localhost") as found:
        yield found


def cloud(data: bytes, at: int = 0) -> tuple[np.ndarray, int]:
    """((n, 4) packed, where the next cloud begins)."""
    magic, n = struct.unpack_from("<II", data, at)
    assert magic == 0x3143564D
    end = at + 16 + 8 * n
    return np.frombuffer(data[at + 16 : end], "<u2").reshape(n, 4), end


def test_the_intensity_of_each_point_travels_behind_the_places_where_the_map_has_any(new_store: NewStore) -> None:
    def bright(tile: Tile) -> Tile:
        return tile.but(fields={"intensity": (1000 * tile.points[:, 2]).astype(np.uint16)})

    tiles = two_walls().tiles
    store = new_store(make_map({(0, 0): bright(tiles[0, 0]), (0, 1): tiles[0, 1]}))
    with TestClient(create_app(store, opened=True), base_url="http://localhost") as client:
        hashes = client.get("/v1/map").json()["tiles"]["0,0"]
        for level in range(6):
            route = f"/v1/clouds/{hashes['points']}/{hashes['ground']}/{level}"
            data = client.get(route, params={"fields": hashes["fields"]}).content
            packed, end = cloud(data)
            assert client.get(route).content == data[:end], "who does not ask for it gets what there was before"
            above_cm = packed[:, 3].astype(int) - 1000
            assert np.abs(np.frombuffer(data, "u1", offset=end) - above_cm * 10 * 255 / 4095).max(initial=0) < 1
        coarse = client.get("/v1/clouds/overview").content
        counts = [struct.unpack_from("<I", coarse, 8 + 24 * i + 12)[0] for i in range(2)]
        assert counts == [12, 12]
        assert len(coarse) == 8 + 2 * 24 + 24 * 8 + 24
        lit = np.frombuffer(coarse, "u1", offset=8 + 2 * 24 + 24 * 8)
        assert lit[:12].max() == round(1050 * 255 / 4095)
        assert not lit[12:].any()


def test_the_levels_of_a_tile_hold_its_points_and_no_more(client: TestClient) -> None:
    tiles = client.get("/v1/map/versions/1").json()["tiles"]
    hashes = tiles["0,0"]
    answers = [client.get(f"/v1/clouds/{hashes['points']}/{hashes['ground']}/{level}") for level in range(6)]
    assert sum(len(cloud(answer.content)[0]) for answer in answers) == 12
    assert "immutable" in answers[0].headers["cache-control"]
    assert client.get(f"/v1/clouds/{'0' * 64}/{hashes['ground']}/0").status_code == 404
    assert client.get(f"/v1/clouds/{hashes['points']}/{hashes['ground']}/6").status_code == 422


def test_the_overview_shows_every_tile_of_a_small_map_whole(client: TestClient) -> None:
    data = client.get("/v1/clouds/overview?version=1").content
    magic, n = struct.unpack_from("<II", data)
    assert (magic, n) == (0x3143564F, 2)
    heads = [struct.unpack_from("<iiiIff", data, 8 + 24 * i) for i in range(n)]
    assert [(row, col, level, count) for row, col, level, count, _, _ in heads] == [(0, 0, 5, 12), (0, 1, 5, 12)]
    assert len(data) == 8 + 2 * 24 + 8 * 24
    assert client.get("/v1/clouds/overview?version=9").status_code == 404


def test_what_came_and_went_between_two_versions_is_told_of_the_tiles_that_differ(client: TestClient) -> None:
    data = client.get("/v1/clouds/changed?from=1&to=2").content
    assert struct.unpack_from("<ii", data) == (0, 0)
    gone, at = cloud(data, 8)
    come, end = cloud(data, at)
    assert (len(gone), len(come), end) == (9, 0, len(data))
    assert sorted(set((gone[:, 3] / 100 - 10).round(2))) == [0.45, 0.75, 1.05]
    back, _ = cloud(client.get("/v1/clouds/changed?from=2&to=1").content, 8)
    assert len(back) == 0
    assert client.get("/v1/clouds/changed?from=1&to=1").content == b""
    assert client.get("/v1/clouds/changed?from=1&to=9").status_code == 404


def test_evidence_tells_votes_age_probability_and_state_of_each_cell(client: TestClient) -> None:
    plane = np.frombuffer(client.get("/v1/evidence/0/0").content, np.uint8).reshape(256, 256, 4)
    likely = change_probability(np.array([CellState.CHANGED_EMPTY], np.uint8), *np.array([[2], [0], [2]]))[0]
    assert plane[10, 11].tolist() == [2, 0, round(255 * likely), CellState.CHANGED_EMPTY]
    assert plane[50, 50].tolist() == [2, 0, 0, CellState.UNCHANGED_EMPTY]
    unseen = np.frombuffer(client.get("/v1/evidence/0/1").content, np.uint8).reshape(256, 256, 4)
    assert (unseen == [0, 255, 0, 255]).all()
    one = np.frombuffer(client.get("/v1/evidence/0/0?vehicle=v1").content, np.uint8).reshape(256, 256, 4)
    assert one[10, 11, 0] == 1


def test_where_vehicles_drove_lies_on_the_ground_and_is_a_line_or_a_row(client: TestClient) -> None:
    (line,) = client.get("/v1/paths").json()["features"]
    assert (line["properties"]["vehicle"], line["properties"]["length_m"]) == ("v1", pytest.approx(39.5, abs=0.5))
    x, y, z = np.array(line["geometry"]["coordinates"]).T
    assert (x[0], x[-1]) == (pytest.approx(2.0, abs=0.2), pytest.approx(41.5, abs=0.2))
    assert y == pytest.approx(6.0, abs=0.2)
    assert np.abs(z).max() < 0.2
    head, row = client.get("/v1/paths?format=csv").text.splitlines()
    assert head == "vehicle,drive,start,end,version,length_m"
    assert row.startswith("v1,d1,")
    assert client.get("/v1/paths?vehicle=v2").json()["features"] == []
    assert client.delete("/v1/ballots/v1/d1").status_code == 200
    assert client.get("/v1/paths").json()["features"] == [], "a vote that was taken back takes its path along"


def test_a_list_of_changes_is_geojson_or_csv(client: TestClient) -> None:
    assert client.get("/v1/changes?from=1").json()["features"][0]["properties"]["kind"] == "demolished"
    head, row = client.get("/v1/changes?from=1&format=csv").text.splitlines()
    assert head.startswith("id,kind,size,area_m2,height_m")
    assert row.startswith("demolished.v2.10.10,demolished,small,0.27,1.05")


def test_what_is_vendored_is_three_js_as_npm_has_it() -> None:
    folder = files("mapvote.shapes") / "viewer" / "vendor"
    assert {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in folder.iterdir()} == VENDORED


def test_the_page_names_every_module_that_it_begins_with_so_that_all_are_asked_for_at_once(client: TestClient) -> None:
    folders = files("mapvote_server") / "web", files("mapvote.shapes") / "viewer"

    def needed(name: str) -> set[str]:
        parts = re.findall(
            r'from ?"\./([^"]+)"', next(file for folder in folders if (file := folder / name).is_file()).read_text()
        )
        home = name.rpartition("/")[0]
        inside = [f"{home}/{part}" if home else part for part in parts]
        return {name}.union(*(needed(part) for part in inside))

    begun = set().union(*(needed(name) for name in ("app.js", "cloud.js", "stream.js", "tools.js")))
    named = re.findall(r'rel="modulepreload" href="viewer/([^"]+)"', client.get("/").text)
    assert sorted(named) == sorted(begun - {"app.js"})


def test_the_page_has_its_files_and_nobody_reaches_others(client: TestClient) -> None:
    page = client.get("/viewer/vendor/three.core.min.js")
    assert page.status_code == 200
    known = {"If-None-Match": client.get("/viewer/app.js").headers["etag"]}
    assert client.get("/viewer/app.js", headers=known).status_code == 304
    for name in ("vendor/../../app.py", "/etc/passwd", "vendor/LICENSE", "vendor"):
        assert client.get(f"/viewer/{name}").status_code == 404, name
