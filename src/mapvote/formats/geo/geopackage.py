"""Features in map metres as a GeoPackage (OGC 12-128), for GIS: by pyogrio, in the map's own coordinate system."""

from __future__ import annotations

import os
from collections.abc import Sequence
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
    under the name "local map metres"; a map in an ENU plane, which no GIS supports, is a MapvoteError.
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
        os.replace(named, partial)


def _column(values: list[Any]) -> np.ndarray[Any, Any]:
    """One property of all features: numbers as numbers, everything else as text."""
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        return np.array(values)
    texts = [None if v is None else v if isinstance(v, str) else ",".join(map(str, v)) for v in values]
    return np.array(texts, dtype=object)
