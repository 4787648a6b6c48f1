"""export --stac: what pystac validates and walks."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pystac
import pytest
from pystac.validation.stac_validator import JsonSchemaSTACValidator

from command_line import typed
from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.core.types import CellState, MapvoteError
from mapvote.formats import write_map
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import send

GEOREFERENCE = {"crs": "EPSG:32654", "offset": "380000,3940000,0"}


def store_of_two_versions(path: Path, georeference: dict[str, str]) -> Path:
    before = replace(two_walls(), georeference=georeference)
    gone = states_plane({(10, c): CellState.CHANGED_EMPTY for c in (10, 11, 12)})
    with closing(Store.create(f"sqlite:///{path}", before)) as store:
        send(store, *[make_ballot(before, {(0, 0): Say(gone)}, name) for name in "ab"])
        publish(store, override=True)
    return path


@pytest.mark.parametrize("georeference", [GEOREFERENCE, {}])
def test_a_catalogue_of_all_versions_is_valid_and_each_is_derived_from_the_one_before(
    tmp_path: Path, georeference: dict[str, str]
) -> None:
    store = store_of_two_versions(tmp_path / "fleet.db", georeference)
    said = typed("export", store, tmp_path / "catalogue", "--stac")
    assert "2 versions" in said
    catalog = pystac.Catalog.from_file(str(tmp_path / "catalogue" / "catalog.json"))
    first, second = sorted(catalog.get_items(recursive=True), key=lambda item: item.id)
    for item in (first, second):
        core = item.to_dict(transform_hrefs=False) | {"stac_extensions": []}  # their schemas are on the network
        JsonSchemaSTACValidator().validate(core, pystac.STACObjectType.ITEM, core["stac_version"], [], None)
        with laspy.CopcReader.open(item.assets["cloud"].get_absolute_href()) as reader:
            assert reader.header.point_count == item.properties["pc:count"]
        assert (item.geometry is None) == (not georeference)
    if georeference:
        (collection,) = catalog.get_children()
        core = collection.to_dict(transform_hrefs=False) | {"stac_extensions": []}
        JsonSchemaSTACValidator().validate(core, pystac.STACObjectType.COLLECTION, core["stac_version"], [], None)
        boxes = np.array([first.bbox, second.bbox])
        assert collection.extent.spatial.bboxes == [[*boxes[:, :2].min(axis=0), *boxes[:, 3:5].max(axis=0)]]
        assert collection.extent.temporal.intervals == [[first.datetime, second.datetime]]
        assert collection.summaries.to_dict()["proj:code"] == ["EPSG:32654"]
        assert {item.collection_id for item in (first, second)} == {collection.id}
    (derived,) = second.get_links("derived_from")
    assert Path(derived.get_absolute_href()) == Path(first.get_self_href())
    changes = json.loads(Path(second.assets["changes"].get_absolute_href()).read_text())
    assert [f["properties"]["kind"] for f in changes["features"]] == ["demolished"]
    assert "changes" not in first.assets


def test_the_same_command_adds_versions_and_writes_no_item_again(tmp_path: Path) -> None:
    store = store_of_two_versions(tmp_path / "fleet.db", GEOREFERENCE)
    typed("export", store, tmp_path / "catalogue", "--stac", "--version", "1")
    item = tmp_path / "catalogue" / "v1" / "v1.json"
    before = item.stat().st_mtime_ns
    typed("export", store, tmp_path / "catalogue", "--stac")
    assert item.stat().st_mtime_ns == before
    assert (tmp_path / "catalogue" / "v2" / "v2.json").is_file()


@pytest.mark.parametrize("order", [(2, 1), (1, 2), (2, None), (None, 1)])
def test_the_catalogue_names_every_item_that_was_ever_added_with_its_derivation(
    tmp_path: Path, order: tuple[int | None, ...]
) -> None:
    """--version N into a catalogue of more versions made one that named version N alone."""
    store = store_of_two_versions(tmp_path / "fleet.db", GEOREFERENCE)
    folder = tmp_path / "catalogue"
    for version in order:
        typed("export", store, folder, "--stac", *(() if version is None else ("--version", str(version))))
    catalog = pystac.Catalog.from_file(str(folder / "catalog.json"))
    items = {item.id: item for item in catalog.get_items(recursive=True)}
    assert sorted(items) == ["v1", "v2"]
    if order != (2, 1):  # nobody asked for version 2 once its parent was there
        (derived,) = items["v2"].get_links("derived_from")
        assert Path(derived.get_absolute_href()) == Path(items["v1"].get_self_href())
        assert json.loads(Path(items["v2"].assets["changes"].get_absolute_href()).read_text())["features"]


def test_the_catalogue_of_another_map_is_left_alone(tmp_path: Path) -> None:
    typed(
        "export", store_of_two_versions(tmp_path / "fleet.db", {}), tmp_path / "catalogue", "--stac", "--version", "1"
    )
    write_map(replace(two_walls(), map_id="elsewhere"), tmp_path / "my_map")
    with pytest.raises(MapvoteError, match="not of 'elsewhere'"):
        typed("export", tmp_path / "my_map", tmp_path / "catalogue", "--stac")


def test_a_map_of_files_is_one_item_and_a_folder_of_other_things_is_left_alone(tmp_path: Path) -> None:
    write_map(replace(two_walls(), georeference=GEOREFERENCE), tmp_path / "my_map")
    typed("export", tmp_path / "my_map", tmp_path / "catalogue", "--stac")
    catalog = pystac.Catalog.from_file(str(tmp_path / "catalogue" / "catalog.json"))
    assert [item.id for item in catalog.get_items(recursive=True)] == ["v1"]
    with pytest.raises(MapvoteError, match="holds other files"):
        typed("export", tmp_path / "my_map", tmp_path / "my_map", "--stac")
    store = store_of_two_versions(tmp_path / "fleet.db", {})
    with pytest.raises(MapvoteError, match="has no version 7"):
        typed("export", store, tmp_path / "other", "--stac", "--version", "7")
