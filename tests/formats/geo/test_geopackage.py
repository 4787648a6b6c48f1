"""Changes as GIS read them: GeoJSON in longitude and latitude, a GeoPackage in the map's coordinate system."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from mapvote.core.types import MapvoteError
from mapvote.formats.geo.frame import MapFrame, enu_frame
from mapvote.formats.geo.geopackage import write_geopackage

SQUARE = [[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [0.0, 3.0], [0.0, 0.0]]


def feature(**properties: object) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [SQUARE]}, "properties": properties}


def test_a_geopackage_is_read_back_by_gdal_in_the_maps_system(tmp_path: Path) -> None:
    import pyogrio
    import shapely

    frame = MapFrame("EPSG:32654", (367_000.0, 3_948_000.0, 0.0))
    features = [feature(kind="built", area_m2=9.0, versions=[2, 3], last_seen=None)] * 2
    write_geopackage(tmp_path / "c.gpkg", features, frame)
    about, _, geometry, columns = pyogrio.raw.read(tmp_path / "c.gpkg", layer="changes")
    assert about["crs"] == "EPSG:32654"
    assert shapely.from_wkb(geometry[0]).bounds == (367_000.0, 3_948_000.0, 367_003.0, 3_948_003.0)
    read = dict(zip(about["fields"], columns, strict=True))
    assert read["kind"].tolist() == ["built", "built"]
    assert np.allclose(read["area_m2"], 9.0)
    assert read["versions"][0] == "2,3"


def test_a_geopackage_brings_its_colours_in_the_table_where_qgis_looks_for_them(tmp_path: Path) -> None:
    import pyogrio

    write_geopackage(tmp_path / "c.gpkg", [feature(kind="built")], MapFrame("EPSG:32654"))
    about, _, _, columns = pyogrio.raw.read(tmp_path / "c.gpkg", layer="layer_styles")
    style = {name: column[0] for name, column in zip(about["fields"], columns, strict=True)}
    geometry_column = pyogrio.read_info(tmp_path / "c.gpkg", layer="changes")["geometry_name"]
    assert (style["f_table_name"], style["f_geometry_column"]) == ("changes", geometry_column)
    assert style["useAsDefault"]
    renderer = ElementTree.fromstring(style["styleQML"]).find("renderer-v2")
    assert renderer is not None
    assert renderer.get("attr") == "kind"
    symbols = {one.get("name") for one in renderer.iter("symbol")}
    assert {one.get("value"): one.get("symbol") in symbols for one in renderer.iter("category")} == {
        "built": True,
        "demolished": True,
    }


def test_a_local_map_gives_a_package_in_local_metres_and_a_plane_none(tmp_path: Path) -> None:
    import pyogrio

    write_geopackage(tmp_path / "c.gpkg", [feature(kind="built")], MapFrame())
    about = pyogrio.raw.read(tmp_path / "c.gpkg", layer="changes")[0]
    assert "local map metres" in about["crs"]
    with pytest.raises(MapvoteError, match="no GIS supports"):
        write_geopackage(tmp_path / "d.gpkg", [feature(kind="built")], enu_frame(49.0, 8.4, 0.0))
    assert not (tmp_path / "d.gpkg").exists()
