"""OGC API - Features as its clients use it: every requirement of its classes, GDAL's and OWSLib's readers."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import httpx2
import numpy as np
import pytest
import shapely
from openapi_spec_validator import OpenAPIV30SpecValidator
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

JSON = "application/json"
UTM = "http://www.opengis.net/def/crs/EPSG/0/32654"
REQUIREMENTS = {
    "core": "api-definition-op api-definition-success conformance-op conformance-success crs84 f-links f-op f-success "
    "fc-bbox-definition fc-bbox-response fc-limit-definition fc-limit-response-1 fc-links fc-md-extent "
    "fc-md-extent-multi fc-md-items fc-md-items-links fc-md-links fc-md-op fc-md-success fc-numberMatched "
    "fc-numberReturned fc-op fc-rel-type fc-response fc-time-definition fc-time-response fc-timeStamp http "
    "query-param-invalid query-param-unknown root-op root-success sfc-md-op sfc-md-success",
    "geojson": "definition content",
    "html": "definition content",
    "oas30": "oas-definition-1 oas-definition-2 oas-impl completeness exceptions-codes security",
    "crs": "crs-uri fc-md-crs-list fc-md-storageCrs fc-md-storageCrs-valid-value fc-md-crs-list-global "
    "fc-bbox-crs-definition fc-bbox-crs-valid-value fc-bbox-crs-default-value fc-bbox-crs-action fc-crs-definition "
    "fc-crs-valid-value fc-crs-default-value fc-crs-action ogc-crs-header ogc-crs-header-value geojson",
}
"""Names of the requirements of OGC 17-069r4 (Part 1, 1.0.1) and 18-058r1 (Part 2) by their class."""
MET: dict[str, Callable[..., object]] = {}
"""The test of each requirement."""
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


Test = TypeVar("Test", bound=Callable[..., object])


def meets(kind: str, names: str) -> Callable[[Test], Test]:
    """Marks the test of some requirements of a class."""

    def marked(test: Test) -> Test:
        MET.update({f"{kind}/{name}": test for name in names.split()})
        return test

    return marked


def test_every_requirement_of_the_classes_has_a_test(url: str) -> None:
    named = {f"{kind}/{name}" for kind, names in REQUIREMENTS.items() for name in names.split()}
    assert named == MET.keys()
    classes = [name.rpartition("/")[2] for name in get(f"{url}/conformance").json()["conformsTo"]]
    assert sorted(classes) == sorted(REQUIREMENTS)


def get(url: str, status: int = 200, /, **headers: str) -> httpx2.Response:
    answer = httpx2.get(url, headers=headers, timeout=60.0)
    assert answer.status_code == status, answer.text
    return answer


@meets("core", "root-op root-success conformance-op fc-md-op fc-op f-op api-definition-op fc-rel-type http")
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
            assert link["href"].startswith(url)
            assert {"rel", "type"} <= link.keys()
            found = get(link["href"])
            assert found.headers["content-type"].partition(";")[0] == link["type"].partition(";")[0]
            if link["href"] not in seen and link["rel"] not in ("next", "prev", "alternate"):
                pages.append(link["href"])
    assert {f"{url}/conformance", f"{url}/collections/changes/items"} <= seen
    first = {link["rel"] for link in get(url).json()["links"]}
    assert {"self", "alternate", "service-desc", "service-doc", "conformance", "data"} <= first


@meets("core", "conformance-success")
def test_the_conformance_names_core_geojson_html_oas30_and_crs(url: str) -> None:
    named = get(f"{url}/conformance").json()["conformsTo"]
    assert [name.rpartition("/")[2] for name in named] == ["core", "geojson", "html", "oas30", "crs"]


@meets("core", "fc-md-success fc-md-links fc-md-items fc-md-items-links fc-md-extent fc-md-extent-multi")
@meets("core", "sfc-md-op sfc-md-success fc-links f-links")
@meets("crs", "crs-uri fc-md-crs-list fc-md-storageCrs fc-md-storageCrs-valid-value fc-md-crs-list-global")
def test_a_collection_is_the_same_in_the_list_and_alone_and_links_to_its_other_forms(url: str) -> None:
    listed = get(f"{url}/collections").json()
    assert {link["rel"]: link["type"] for link in listed["links"]} == {"self": JSON, "alternate": "text/html"}
    assert listed["crs"] == [CRS84, UTM]
    assert {one["id"] for one in listed["collections"]} == set(COLLECTIONS)
    for one in listed["collections"]:
        path = f"{url}/collections/{one['id']}"
        alone = get(path).json()
        assert without_links(alone) == without_links(one)
        assert (one["crs"], one["storageCrs"]) == ([CRS84, UTM], UTM)
        types = {link["type"] for link in one["links"] if link["rel"] == "items"}
        assert types == {"application/geo+json", "text/html"}
        features = get(f"{path}/items").json()["features"]
        if "extent" in one:
            ((west, south, east, north),) = one["extent"]["spatial"]["bbox"]
            box = shapely.box(west, south, east, north).buffer(1e-7)
            assert all(box.contains(shape(feature["geometry"])) for feature in features)
        pages = [f"{path}/items", *(f"{path}/items/{feature['id']}" for feature in features[:1])]
        for page in pages:
            rels = {link["rel"] for link in get(page).json()["links"]}
            assert {"self", "alternate", "collection"} - {"alternate"} <= rels
            assert "alternate" in rels


def without_links(about: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in about.items() if name != "links"}


@meets("crs", "fc-bbox-crs-default-value fc-crs-default-value ogc-crs-header ogc-crs-header-value")
@meets("core", "crs84")
def test_coordinates_are_longitude_and_latitude_unless_another_system_is_asked_for(url: str) -> None:
    tiles = f"{url}/collections/tiles/items"
    for page in (tiles, f"{tiles}/0,0"):
        plain = get(page)
        assert plain.headers["content-crs"] == f"<{CRS84}>"
        assert (
            plain.json().get("features", [plain.json()])[0]["geometry"]
            == (get(f"{page}?crs={CRS84}").json().get("features", [get(f"{page}?crs={CRS84}").json()])[0]["geometry"])
        )
    x, y = shape(get(f"{tiles}/0,0").json()["geometry"]).centroid.coords[0]
    box = f"{x},{y},{x},{y}"
    assert get(f"{tiles}?bbox={box}").json()["numberMatched"] == 1
    assert get(f"{tiles}?bbox={box}&bbox-crs={CRS84}").json()["numberMatched"] == 1


@meets("geojson", "definition content")
@meets("core", "fc-response f-success fc-timeStamp fc-numberMatched fc-numberReturned")
def test_features_are_geojson_with_their_number_and_the_time(url: str) -> None:
    for name in COLLECTIONS:
        answer = get(f"{url}/collections/{name}/items?limit=1")
        assert answer.headers["content-type"] == "application/geo+json"
        content = answer.json()
        assert content["type"] == "FeatureCollection"
        assert content["numberReturned"] == len(content["features"]) <= content["numberMatched"]
        age_s = abs((datetime.now(UTC) - datetime.fromisoformat(content["timeStamp"])).total_seconds())
        assert age_s < 60.0
        for feature in content["features"]:
            alone = get(f"{url}/collections/{name}/items/{feature['id']}")
            assert alone.headers["content-type"] == "application/geo+json"
            assert alone.json()["type"] == "Feature"
            outline = shape(feature["geometry"])
            assert outline.is_valid
            assert outline.geom_type != "Polygon" or outline.exterior.is_ccw, "RFC 7946, 3.1.6"


@meets("crs", "fc-crs-action geojson")
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


@meets("core", "fc-bbox-response")
@meets("crs", "fc-bbox-crs-action")
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
        ("139.6755,35.5966,139.6755,35.5966", 1),  # a point
        ("139,35.5966,140,35.5966", 2),  # a line
        ("-1e300,-1e300,1e300,1e300", 2),
        ("139.6755,-1e-300,139.6755,1e300", 1),
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


@meets("core", "fc-time-response")
@pytest.mark.parametrize(
    ("interval", "n"),
    [
        ("../..", 1),
        ("/", 1),
        ("1960-01-01/..", 1),
        ("1960-01-01/", 1),
        ("../1960-01-01T00:00:00Z", 0),
        ("2999-01-01T00:00:00Z", 0),
        ("../1970-01-01", 1),  # the whole day
        ("1970-01-01", 1),
        ("1970-01-01t00:00:01z", 1),
        ("1970-01-01T02:00:01%2B02:00", 1),
        ("1970-01-01T00:00:01.5Z", 0),
        ("2016-12-31T23:59:60Z", 0),  # a leap second
    ],
)
def test_an_interval_of_time_holds_the_changes_seen_in_it(url: str, interval: str, n: int) -> None:
    assert get(f"{url}/collections/changes/items?datetime={interval}").json()["numberMatched"] == n


@meets("core", "query-param-invalid query-param-unknown")
@meets("crs", "fc-bbox-crs-valid-value fc-crs-valid-value")
@pytest.mark.parametrize(
    "query",
    [
        "bbox=",
        "bbox=1,2,3,4,",
        "bbox=inf,0,1,1",
        "limit=-1",
        "limit=1.5",
        "limit=",
        "datetime=",
        "datetime=..",
        "datetime=20180212",
        "datetime=2018-W07-1",
        "datetime=2018-02-12T23:20:50",
        "crs=",
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


@meets("core", "query-param-unknown")
def test_no_page_takes_an_unknown_parameter_or_one_twice(url: str) -> None:
    for path in ("", "/api", "/api.html", "/conformance", "/collections", "/collections/tiles"):
        get(f"{url}{path}?colour=red", 400)
    get(f"{url}/collections/tiles/items/0,0?limit=1", 400)
    get(f"{url}/collections/tiles/items?limit=1&limit=2", 400)


@meets("core", "fc-limit-response-1")
def test_a_large_limit_is_lowered_and_what_is_not_there_is_404(url: str) -> None:
    for limit in ("1000000", "9" * 30, "0" * 20 + "2"):
        assert get(f"{url}/collections/tiles/items?limit={limit}").json()["numberReturned"] == 2
    get(f"{url}/collections/roads", 404)
    get(f"{url}/collections/tiles/items/9,9", 404)
    get(f"{url}/collections/changes/items?from=7", 404)


@meets("html", "definition content")
def test_people_get_pages_and_programs_json(url: str) -> None:
    """A page has all that the JSON has, links as links."""
    for path in ("", "/conformance", "/collections", "/collections/tiles", "/collections/tiles/items"):
        page = get(f"{url}{path}?f=html")
        assert page.headers["content-type"].startswith("text/html")
        assert page.text.startswith("<!doctype html>")
        content = get(url + path).json()
        for link in content.get("links", ()):
            if link["rel"] not in ("self", "alternate"):
                assert f'<a href="{link["href"]}"' in page.text
        for feature in content.get("features", ()):
            assert str(feature["geometry"]["coordinates"][0][0][0]) in page.text
            assert all(str(value) in page.text for value in feature["properties"].values())


@pytest.mark.parametrize(
    ("accept", "kind"),
    [
        ("text/html", "text/html"),
        ("text/html,application/xhtml+xml,application/xml;q=0.9,image/avif,*/*;q=0.8", "text/html"),  # Firefox
        ("application/json;q=0.5, text/html", "text/html"),
        ("TEXT/*", "text/html"),
        ("text/html, */*", "text/html"),
        ("text/html;q=0.1,application/json", "application/geo+json"),
        ("text/html;q=0", "application/geo+json"),
        ("text/html;q=many, application/json;q=0.1", "application/geo+json"),
        ("application/geo+json,text/html;q=0.9", "application/geo+json"),
        ("application/*, text/html;q=0.5", "application/geo+json"),
        ("*/*", "application/geo+json"),
        ("image/png", "application/geo+json"),
        ("", "application/geo+json"),
    ],
)
def test_the_form_is_that_to_which_accept_gives_the_highest_weight(url: str, accept: str, kind: str) -> None:
    answer = get(f"{url}/collections/tiles/items", accept=accept)
    assert answer.headers["content-type"].partition(";")[0] == kind
    assert "Accept" in answer.headers["vary"]


def test_an_answer_is_compressed_for_who_takes_it(url: str) -> None:
    plain, packed = (
        get(f"{url}/collections/tiles", **{"Accept-Encoding": coding}) for coding in ("gzip;q=0", "br, gzip")
    )
    assert "content-encoding" not in plain.headers
    assert packed.headers["content-encoding"] == "gzip"
    assert plain.json() == packed.json()


def test_links_lead_through_the_proxy_that_stands_before_the_server(url: str) -> None:
    forwarded = {"X-Forwarded-Proto": "https", "X-Forwarded-Host": "192.0.2.7:8443", "X-Forwarded-Prefix": "/maps"}
    one = get(f"{url}/collections/tiles", **forwarded).json()
    outside = "https://192.0.2.7:8443/maps/ogc/collections/tiles"
    assert [link["href"].partition("?")[0] for link in one["links"]] == [outside, outside, *[f"{outside}/items"] * 2]
    page = get(url, accept="text/html", **forwarded).text
    assert 'href="/maps/viewer/pages.css"' in page
    for foreign in ("evil.example", "192.0.2.7/x", "<"):
        mended = get(f"{url}/collections/tiles", **{"X-Forwarded-Host": foreign, "X-Forwarded-Prefix": foreign})
        assert mended.json()["links"][0]["href"] == f"{url}/collections/tiles"


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


@meets("core", "api-definition-success fc-limit-definition fc-bbox-definition fc-time-definition")
@meets("crs", "fc-bbox-crs-definition fc-crs-definition")
@meets("oas30", "oas-definition-1 oas-definition-2 oas-impl completeness exceptions-codes security")
def test_the_api_document_is_openapi_3_0_and_names_every_path_that_answers(url: str) -> None:
    answer = get(f"{url}/api")
    assert answer.headers["content-type"] == "application/vnd.oai.openapi+json;version=3.0"
    document = answer.json()
    OpenAPIV30SpecValidator(document).validate()
    assert set(document["components"]["securitySchemes"]) == {"bearer", "basic", "cookie"}
    for path, operations in document["paths"].items():
        answers = operations["get"]["responses"]
        assert {"200", "400", "401", "403", "404", "422", "429", "503"} <= answers.keys()
        for kind in answers["200"]["content"] if "{" not in path else ():
            stated = get(url + path.rstrip("/"), accept=kind).headers["content-type"]
            assert stated.partition(";")[0] == kind.partition(";")[0]
    changes = document["paths"]["/collections/changes/items"]["get"]["parameters"]
    by_name = {parameter["name"]: parameter for parameter in changes}
    assert set(by_name) == {"bbox", "bbox-crs", "crs", "datetime", "limit", "offset", "from", "to", "f"}
    assert all(one["in"] == "query" and one["style"] == "form" and not one["explode"] for one in changes)
    assert by_name["limit"]["schema"] == {"type": "integer", "minimum": 1, "maximum": 10_000, "default": 100}
    assert (by_name["bbox"]["schema"]["minItems"], by_name["bbox"]["schema"]["maxItems"]) == (4, 6)
