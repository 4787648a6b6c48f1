"""OGC API - Features as its clients use it: each requirement that a client can see, GDAL's and OWSLib's readers."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import httpx2
import numpy as np
import pytest
import shapely
from owslib.ogcapi.features import Features
from shapely.geometry import shape

from hand_made import Say, make_ballot, states_plane, two_walls
from live_server import serving_here
from mapvote.core.types import F64, CellState
from mapvote.formats.geo.frame import frame_of
from mapvote_server.questions.features import COLLECTIONS, CRS84
from mapvote_server.store import keys
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import send

UTM = "http://www.opengis.net/def/crs/EPSG/0/32654"
GEOREFERENCE = {"crs": "EPSG:32654", "offset": "380000,3940000,0"}


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A server of two versions: the wall of one tile went, and one vehicle says that the other's goes, too."""
    home = tmp_path_factory.mktemp("ogc")
    before = replace(two_walls(), georeference=GEOREFERENCE)
    gone = states_plane({(10, c): CellState.CHANGED_EMPTY for c in (10, 11, 12)})
    with closing(Store.create(f"sqlite:///{home / 'store.db'}", before)) as store:
        send(store, *[make_ballot(before, {(0, 0): Say(gone)}, name) for name in "ab"])
        publish(store, override=True)
        send(store, *[make_ballot(before, {(0, 1): Say(gone)}, name, "d2") for name in "ab"])
    with serving_here(home / "store.db", log=home / "log") as address:
        yield f"{address}/ogc"


def get(url: str, status: int = 200, /, **headers: str) -> httpx2.Response:
    answer = httpx2.get(url, headers=headers, timeout=60.0)
    assert answer.status_code == status, answer.text
    return answer


def test_every_link_of_the_pages_leads_to_what_it_says(url: str) -> None:
    pages, seen = [url], set[str]()
    while pages:
        page = pages.pop()
        seen.add(page)
        answer = get(page)
        if "json" not in answer.headers["content-type"]:
            continue
        content = answer.json()
        links = [link for link in content.get("links", []) if isinstance(link, dict)]
        links += [link for one in content.get("collections", []) for link in one["links"]]
        for link in links:
            found = get(link["href"])
            assert found.headers["content-type"].partition(";")[0] == link["type"].partition(";")[0]
            if link["href"] not in seen and link["rel"] not in ("next", "prev", "alternate"):
                pages.append(link["href"])
    assert {f"{url}/conformance", f"{url}/collections/changes/items"} <= seen


def test_the_conformance_names_core_geojson_html_oas30_and_crs(url: str) -> None:
    named = get(f"{url}/conformance").json()["conformsTo"]
    assert [name.rpartition("/")[2] for name in named] == ["core", "geojson", "html", "oas30", "crs"]


def test_a_change_lies_where_the_map_does_in_either_system(url: str) -> None:
    degrees, metres = (get(f"{url}/collections/changes/items?crs={crs}") for crs in (CRS84, UTM))
    assert [answer.headers["content-crs"] for answer in (degrees, metres)] == [f"<{CRS84}>", f"<{UTM}>"]
    (in_degrees,), (in_metres,) = (answer.json()["features"] for answer in (degrees, metres))
    x0, _, x1, _ = shape(in_metres["geometry"]).bounds
    assert 380_000 < x0 < x1 < 380_010
    frame = frame_of({"crs": "EPSG:32654"})
    back = shapely.transform(shape(in_degrees["geometry"]), lambda xy: frame.from_lonlat(flat(xy))[:, :2])
    assert back.hausdorff_distance(shape(in_metres["geometry"])) < 0.01
    assert in_degrees["properties"]["kind"] == "demolished"


def flat(xy: F64) -> F64:
    return np.column_stack([xy, np.zeros(len(xy))])


@pytest.mark.parametrize("name", COLLECTIONS)
def test_pages_of_one_hold_each_feature_once_and_a_feature_is_found_by_its_id(url: str, name: str) -> None:
    whole = get(f"{url}/collections/{name}/items").json()
    assert whole["numberMatched"] == whole["numberReturned"] == len(whole["features"])
    listed, page = [], f"{url}/collections/{name}/items?limit=1"
    while page:
        content = get(page).json()
        listed += content["features"]
        page = next((link["href"] for link in content["links"] if link["rel"] == "next"), "")
    assert [f["id"] for f in listed] == [f["id"] for f in whole["features"]]
    for feature in whole["features"]:
        alone = get(f"{url}/collections/{name}/items/{feature['id']}").json()
        assert {k: alone[k] for k in ("id", "geometry", "properties")} == {
            k: feature[k] for k in ("id", "geometry", "properties")
        }


def test_a_box_holds_what_it_meets_in_degrees_and_in_metres(url: str) -> None:
    tiles = {f["id"]: shape(f["geometry"]).bounds for f in get(f"{url}/collections/tiles/items").json()["features"]}
    assert set(tiles) == {"0,0", "0,1"}
    x0, y0, x1, _ = tiles["0,0"]
    inside = f"{x0 + 1e-5},{y0 + 1e-5},{x0 + 2e-5},{y0 + 2e-5}"
    both = f"{x1 - 1e-5},{y0 + 1e-5},{x1 + 1e-5},{y0 + 2e-5}"
    metres = f"380001,3940001,380002,3940002&bbox-crs={UTM}"
    for box, expected in ((inside, ["0,0"]), (both, ["0,0", "0,1"]), (metres, ["0,0"]), ("0,0,1,1", [])):
        found = get(f"{url}/collections/tiles/items?bbox={box}").json()
        assert [f["id"] for f in found["features"]] == expected


@pytest.mark.parametrize(
    ("box", "n"),
    [
        ("-180,-90,180,90", 2),
        ("100,-10,-100,80", 2),  # over the date line
        ("-100,-10,100,80", 0),
        ("-181,0,181,60", 2),
        ("-180,-90,-9,180,90,9", 2),  # with heights
    ],
)
def test_a_box_may_be_the_world_or_cross_the_date_line(url: str, box: str, n: int) -> None:
    assert get(f"{url}/collections/tiles/items?bbox={box}").json()["numberMatched"] == n


def test_a_map_on_the_date_line_is_found_from_both_sides(tmp_path: Path) -> None:
    ((x, y),) = frame_of({"crs": "EPSG:32601"}).plane_from_lonlat(np.array([[180.0, 72.0]]))
    there = replace(two_walls(), georeference={"crs": "EPSG:32601", "offset": f"{x - 76.8},{y},0"})
    Store.create(f"sqlite:///{tmp_path / 's.db'}", there).close()
    with serving_here(tmp_path / "s.db", log=tmp_path / "log") as address:
        tiles = f"{address}/ogc/collections/tiles"
        ((west, south, east, north),) = get(tiles).json()["extent"]["spatial"]["bbox"]
        assert west > 179.9
        assert east < -179.9
        for box in (f"{west},{south},{east},{north}", "-180,-90,180,90", "-180,0,-179,80", "179,0,180,80"):
            assert get(f"{tiles}/items?bbox={box}").json()["numberMatched"] >= 1
        assert get(f"{tiles}/items?bbox=-1,0,1,80").json()["numberMatched"] == 0


@pytest.mark.parametrize(
    ("interval", "n"),
    [("../..", 1), ("1960-01-01/..", 1), ("../1960-01-01T00:00:00Z", 0), ("2999-01-01T00:00:00Z", 0)],
)
def test_an_interval_of_time_holds_the_changes_seen_in_it(url: str, interval: str, n: int) -> None:
    assert get(f"{url}/collections/changes/items?datetime={interval}").json()["numberMatched"] == n


@pytest.mark.parametrize(
    "query",
    [
        "bbox=1,2,3",
        "bbox=1,2,9,3,4,5",
        "bbox=nan,0,1,1",
        "bbox=a,b,c,d",
        "bbox=1,9,2,3",
        "limit=0",
        "limit=x",
        "offset=-1",
        "datetime=monday",
        "colour=red",
        "crs=EPSG:1",
        "bbox-crs=x",
        "datetime=2020-01-02/2020-01-01",
        "datetime=a/b/c",
        "f=gml",
        "from=0",
    ],
)
def test_a_wrong_or_unknown_parameter_is_400_and_says_which(url: str, query: str) -> None:
    assert query.partition("=")[0] in get(f"{url}/collections/changes/items?{query}", 400).json()["detail"]


def test_a_large_limit_is_lowered_and_what_is_not_there_is_404(url: str) -> None:
    assert get(f"{url}/collections/tiles/items?limit=1000000").json()["numberReturned"] == 2
    get(f"{url}/collections/roads", 404)
    get(f"{url}/collections/tiles/items/9,9", 404)
    get(f"{url}/collections/changes/items?from=7", 404)


def test_people_get_pages_and_programs_json(url: str) -> None:
    for path in ("", "/collections", "/collections/tiles/items"):
        assert "<!doctype html>" in get(url + path, accept="text/html,application/xhtml+xml").text
        assert "<!doctype html>" in get(f"{url}{path}?f=html").text
        assert get(url + path, accept="*/*").headers["content-type"].startswith("application/")


def test_a_vehicle_s_key_sees_no_desk_and_a_map_without_a_place_says_so(tmp_path: Path) -> None:
    with closing(
        Store.create(f"sqlite:///{tmp_path / 'a.db'}", replace(two_walls(), georeference=GEOREFERENCE))
    ) as store:
        key = keys.issue(store, "a", "vehicle")
    with serving_here(tmp_path / "a.db", log=tmp_path / "log") as address:
        mine = {"Authorization": f"Bearer {key}"}
        listed = get(f"{address}/ogc/collections", **mine).json()["collections"]
        assert {one["id"] for one in listed} == {"changes", "coverage", "tiles"}
        get(f"{address}/ogc/collections/pending/items", 403, **mine)
        get(f"{address}/ogc/collections", 401)
    Store.create(f"sqlite:///{tmp_path / 'b.db'}", two_walls()).close()
    with serving_here(tmp_path / "b.db", log=tmp_path / "log") as address:
        assert "--crs" in get(f"{address}/ogc/collections", 422).json()["detail"]


def test_owslib_lists_and_reads_the_collections_with_bbox_and_paging(url: str) -> None:
    client = Features(url + "/")
    assert sorted(client.feature_collections()) == sorted(COLLECTIONS)
    assert client.collection_items("tiles", limit=1)["numberReturned"] == 1
    assert client.collection_items("tiles", bbox=[0, 0, 1, 1])["numberMatched"] == 0
    change = client.collection_items("changes")["features"][0]["id"]
    assert client.collection_item("changes", change)["id"] == change


@pytest.mark.skipif(shutil.which("ogrinfo") is None, reason="GDAL's ogrinfo is not installed: apt install gdal-bin")
def test_gdal_which_qgis_uses_reads_every_collection(url: str) -> None:
    def ogrinfo(*options: str) -> str:
        return subprocess.run(["ogrinfo", *options], capture_output=True, text=True, check=True, timeout=120).stdout

    layers = ogrinfo(f"OAPIF:{url}")
    for name in COLLECTIONS:
        assert name in layers
        said = ogrinfo("-al", "-so", f"OAPIF:{url}", name, "-oo", "PAGE_SIZE=1")
        expected = get(f"{url}/collections/{name}/items").json()["numberMatched"]
        assert f"Feature Count: {expected}" in said
    middle = shape(get(f"{url}/collections/tiles/items/0,0").json()["geometry"]).centroid
    box = (middle.x, middle.y, middle.x + 1e-5, middle.y + 1e-5)
    inside = ogrinfo("-al", "-so", "-spat", *(str(v) for v in box), f"OAPIF:{url}", "tiles")
    assert "Feature Count: 1" in inside


def test_the_api_document_is_openapi_3_0_and_names_every_path_that_answers(url: str) -> None:
    document = json.loads(get(f"{url}/api").text)
    assert document["openapi"].startswith("3.0")
    for path in document["paths"]:
        if "{" not in path:
            get(url + path.rstrip("/"))
