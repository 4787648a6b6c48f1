"""The STAC catalogue of a server: pystac walks it, and its items are those of the static export."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pystac
import pytest
from fastapi.testclient import TestClient
from pystac.stac_io import DefaultStacIO
from pystac.validation.stac_validator import JsonSchemaSTACValidator

from command_line import typed
from hand_made import two_walls
from mapvote_server.api.app import create_app
from mapvote_server.store.policy import KeepPolicy, Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.retention import clear
from mapvote_server.store.store import Store
from stores import vote_gone

GEOREFERENCE = {"crs": "EPSG:32654", "offset": "380000,3940000,0"}


class Asked(DefaultStacIO):  # type: ignore[misc]
    """pystac's files are the answers of a server."""

    def __init__(self, client: TestClient) -> None:
        super().__init__()
        self._client = client

    def read_text(self, source: Any, *args: Any, **kwargs: Any) -> str:
        answer = self._client.get(urlsplit(str(source)).path)
        assert answer.status_code == 200, answer.text
        return answer.text


def store_of_two_versions(path: Path, georeference: dict[str, str], policy: Policy | None = None) -> Store:
    store = Store.create(f"sqlite:///{path}", replace(two_walls(), georeference=georeference), policy)
    vote_gone(store, "ab")
    publish(store, override=True)
    return store


def without_addresses(item: dict[str, Any]) -> dict[str, Any]:
    """An item but for its hrefs and the link to itself."""
    links = [{**link, "href": ""} for link in item["links"] if link["rel"] != "self"]
    return item | {"links": links, "assets": {n: {**one, "href": ""} for n, one in item["assets"].items()}}


@pytest.mark.parametrize("georeference", [GEOREFERENCE, {}])
def test_pystac_walks_the_versions_and_each_item_is_that_of_the_export(
    tmp_path: Path, georeference: dict[str, str]
) -> None:
    typed_out = tmp_path / "catalogue"
    with closing(store_of_two_versions(tmp_path / "s.db", georeference)) as store:
        typed("export", tmp_path / "s.db", typed_out, "--stac")
        with TestClient(create_app(store, opened=True), base_url="http://localhost") as client:
            catalog = pystac.Catalog.from_file("http://localhost/stac", Asked(client))
            first, second = sorted(catalog.get_items(recursive=True), key=lambda item: item.id)
            for number, item in ((1, first), (2, second)):
                JsonSchemaSTACValidator().validate(
                    item.to_dict(transform_hrefs=False) | {"stac_extensions": []},
                    pystac.STACObjectType.ITEM,
                    "1.1.0",
                    [],
                    None,
                )
                answer = client.get(f"/stac/v{number}/v{number}.json")
                assert answer.headers["Content-Type"] == "application/geo+json"
                static = json.loads((typed_out / f"v{number}" / f"v{number}.json").read_text())
                assert without_addresses(answer.json()) == without_addresses(static)
                cloud = client.head(item.assets["cloud"].href)
                assert (cloud.status_code, cloud.headers["Content-Type"]) == (200, item.assets["cloud"].media_type)
            (derived,) = second.get_links("derived_from")
            assert derived.get_absolute_href() == first.get_self_href()
            if georeference:
                (collection,) = catalog.get_children()
                JsonSchemaSTACValidator().validate(
                    client.get("/stac/collection.json").json() | {"stac_extensions": []},
                    pystac.STACObjectType.COLLECTION,
                    "1.1.0",
                    [],
                    None,
                )
                assert collection.id == first.collection_id == store.map_id
                ((west, south, east, north),) = collection.extent.spatial.bboxes
                assert west <= first.bbox[0] <= first.bbox[3] <= east
                assert south <= first.bbox[1] <= first.bbox[4] <= north
                assert collection.extent.temporal.intervals == [[first.datetime, second.datetime]]
            else:
                assert client.get("/stac/collection.json").status_code == 404
            features = client.get(second.assets["changes"].href).json()["features"]
            assert [f["properties"]["kind"] for f in features] == ["demolished"]
            assert client.get("/stac/v1/v2.json").status_code == client.get("/stac/v9/v9.json").status_code == 404


def test_a_version_that_was_cleared_away_is_in_no_catalogue(tmp_path: Path) -> None:
    keep = Policy(keep=KeepPolicy(versions=1))
    with closing(store_of_two_versions(tmp_path / "s.db", GEOREFERENCE, keep)) as store:
        clear(store, dry_run=False)
        typed("export", tmp_path / "s.db", tmp_path / "catalogue", "--stac")
        with TestClient(create_app(store, opened=True), base_url="http://localhost") as client:
            links = client.get("/stac/collection.json").json()["links"]
            assert [link["href"] for link in links if link["rel"] == "item"] == ["http://localhost/stac/v2/v2.json"]
            assert "derived_from" not in {link["rel"] for link in client.get("/stac/v2/v2.json").json()["links"]}
        (item,) = pystac.Catalog.from_file(str(tmp_path / "catalogue" / "catalog.json")).get_items(recursive=True)
        assert item.id == "v2"
        assert "changes" not in item.assets
