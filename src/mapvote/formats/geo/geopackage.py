"""Features in map metres as a GeoPackage (OGC 12-128), for GIS: by pyogrio, in the map's own coordinate system."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from mapvote.core.extras import require
from mapvote.core.types import MapvoteError
from mapvote.formats.atomic import whole_file
from mapvote.formats.geo.frame import ENU, MapFrame


def write_geopackage(path: Path, features: Sequence[dict[str, Any]], frame: MapFrame) -> None:
    """GeoJSON features (polygons in map metres) as one layer, whole or not at all.

    Coordinates are those of the frame's coordinate system (its offset added back). A local map is written in metres
    under the name "local map metres"; a map in an ENU plane, which no GIS supports, is a MapvoteError. The file holds
    the layer's colours in the table ``layer_styles``, where QGIS looks for them.
    """
    shapely = require("shapely", "geo", str(path))
    pyogrio = require("pyogrio.raw", "geo", str(path))
    if frame.crs.startswith(ENU):
        raise MapvoteError(f"{path}: no GIS supports this map's plane ({frame.told()}); write .geojson instead")
    offset = np.array(frame.offset_m[:2])
    shapes = [shapely.transform(shapely.geometry.shape(f["geometry"]), lambda xy: xy + offset) for f in features]
    several = shapely.geometry.MultiPolygon
    shapes = [shape if shape.geom_type == "MultiPolygon" else several([shape]) for shape in shapes]
    geometry = np.array([shape.wkb for shape in shapes], dtype=object)
    names = list(features[0]["properties"]) if features else []
    columns = [_column([f["properties"][name] for f in features]) for name in names]
    local = (
        'ENGCRS["local map metres",EDATUM["map"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
    )
    with whole_file(path) as partial:
        named = partial.with_name(f"{partial.name}.gpkg")  # GDAL wants the suffix
        pyogrio.write(
            str(named),
            geometry=geometry,
            field_data=columns,
            fields=names,
            layer="changes",
            driver="GPKG",
            geometry_type="MultiPolygon",
            crs=local if frame.is_local else frame.crs,
        )
        _add_style(named)
        os.replace(named, partial)


def _add_style(file: Path) -> None:
    """The table in which QGIS looks for a layer's default style: red for built, blue for demolished, as on the page."""
    from xml.etree import ElementTree

    qgis = ElementTree.Element("qgis", {"version": "3.22", "styleCategories": "Symbology"})
    renderer = ElementTree.SubElement(qgis, "renderer-v2", {"type": "categorizedSymbol", "attr": "kind"})
    categories = ElementTree.SubElement(renderer, "categories")
    symbols = ElementTree.SubElement(renderer, "symbols")
    for name, kind, colour in (("0", "built", "194,59,46"), ("1", "demolished", "47,98,196")):
        about = {"value": kind, "label": kind, "symbol": name, "render": "true"}
        ElementTree.SubElement(categories, "category", about)
        symbol = ElementTree.SubElement(symbols, "symbol", {"type": "fill", "name": name, "alpha": "0.65"})
        layer = ElementTree.SubElement(symbol, "layer", {"class": "SimpleFill", "enabled": "1"})
        options = ElementTree.SubElement(layer, "Option", {"type": "Map"})
        values = {"color": f"{colour},255", "outline_color": f"{colour},255", "style": "solid"}
        for option, value in values.items():
            ElementTree.SubElement(options, "Option", {"type": "QString", "name": option, "value": value})
    with closing(sqlite3.connect(file)) as database, database:
        database.execute(
            "CREATE TABLE layer_styles (id INTEGER PRIMARY KEY AUTOINCREMENT, "
            "f_table_catalog TEXT, f_table_schema TEXT, f_table_name TEXT, f_geometry_column TEXT, "
            "styleName TEXT, styleQML TEXT, styleSLD TEXT, "
            "useAsDefault BOOLEAN, description TEXT, owner TEXT, ui TEXT, "
            "update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ', 'now')))"
        )
        database.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier) VALUES (?, 'attributes', ?)",
            ("layer_styles", "layer_styles"),
        )
        database.execute(
            "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName, "
            "styleQML, styleSLD, useAsDefault, description) "
            "SELECT '', '', table_name, column_name, 'changes', ?, '', 1, 'built and demolished' "
            "FROM gpkg_geometry_columns",
            (ElementTree.tostring(qgis, encoding="unicode"),),
        )


def _column(values: list[Any]) -> np.ndarray[Any, Any]:
    """One property of all features: numbers as numbers, everything else as text."""
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return np.array(values)
    texts = [None if v is None else v if isinstance(v, str) else ",".join(map(str, v)) for v in values]
    return np.array(texts, dtype=object)
