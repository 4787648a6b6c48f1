"""Autoware's map_projector_info.yaml: its five projector types, to a map frame and back.

As autoware_geography_utils reckons: heights count from the origin's altitude, except with MGRS, which leaves them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from mapvote.core.types import MapvoteError
from mapvote.formats.extras import read_text, require
from mapvote.formats.geo.frame import LOCAL, MapFrame, enu_frame, read_crs, utm_of

PROJECTOR = "map_projector_info.yaml"
TYPES = ("Local", "MGRS", "LocalCartesianUTM", "LocalCartesian", "TransverseMercator")
_SQUARE_M = 100_000.0


def read_projector(text_or_path: str) -> MapFrame:
    """The frame of a map_projector_info.yaml, of the folder that holds one, or of the short form "MGRS:54SUE".

    Other short forms: "LocalCartesianUTM:35.67,139.65", "LocalCartesian:35.67,139.65,40",
    "TransverseMercator:35.67,139.65" (latitude, longitude, altitude), "Local".
    """
    path = Path(text_or_path)
    if path.is_dir():
        path = path / PROJECTOR
    if path.is_file():
        return frame_of_projector(read_text(path), str(path))
    kind, _, rest = text_or_path.partition(":")
    if kind not in TYPES:
        raise MapvoteError(f"--projector {text_or_path!r}: no such file, and no type among {', '.join(TYPES)}")
    about: dict[str, Any] = {"projector_type": kind, "vertical_datum": "WGS84"}
    if kind == "MGRS":
        about["mgrs_grid"] = rest
    elif kind != "Local":
        try:
            values = [*(float(v) for v in rest.split(",")), 0.0]
            about["map_origin"] = {"latitude": values[0], "longitude": values[1], "altitude": values[2]}
        except (ValueError, IndexError) as error:
            raise MapvoteError(f"--projector {text_or_path!r}: write {kind}:LATITUDE,LONGITUDE") from error
    return frame_of_projector(_as_yaml(about), "--projector")


def frame_of(georeference: Mapping[str, str]) -> MapFrame:
    """The frame that a map carries; local if it carries none."""
    projector = georeference.get(PROJECTOR, "")
    crs = georeference.get("crs") or georeference.get("wkt") or ""
    if not crs:
        return frame_of_projector(projector) if projector else MapFrame()
    offset = [float(v) for v in georeference.get("offset", "0,0,0").split(",")]
    return MapFrame(crs, (offset[0], offset[1], offset[2]), georeference.get("heights", ""), projector)


def frame_of_projector(text: str, where: str = PROJECTOR) -> MapFrame:
    """The frame that a map_projector_info.yaml describes; MapvoteError says what is missing or unknown."""
    try:
        about = yaml.safe_load(text)
        kind = str(about["projector_type"])
    except (yaml.YAMLError, TypeError, KeyError, ValueError) as error:
        raise MapvoteError(f"{where}: no projector_type in it; one of {', '.join(TYPES)}") from error
    heights = {"WGS84": "above the WGS 84 ellipsoid", "EGM2008": "EGM2008 height"}.get(about.get("vertical_datum"), "")
    if kind.lower() == LOCAL:
        return MapFrame(LOCAL, heights=heights, projector=text)
    if kind == "MGRS":
        return replace(mgrs_frame(str(about.get("mgrs_grid", "")), where), heights=heights, projector=text)
    if kind not in TYPES:
        raise MapvoteError(f"{where}: unknown projector_type {kind!r}; one of {', '.join(TYPES)}")
    try:
        origin = about["map_origin"]
        latitude, longitude = float(origin["latitude"]), float(origin["longitude"])
        altitude = float(origin.get("altitude") or 0.0)
        scale = float(about.get("scale_factor", 0.9996))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise MapvoteError(f"{where}: {kind} needs map_origin with latitude and longitude in degrees") from error
    if not (abs(latitude) <= 90 and abs(longitude) <= 360):
        raise MapvoteError(f"{where}: map_origin {latitude}, {longitude} is no latitude and longitude in degrees")
    if kind == "LocalCartesian":
        return replace(enu_frame(latitude, longitude, altitude), projector=text)
    if kind == "TransverseMercator":
        crs = f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +k_0={scale!r} +datum=WGS84 +units=m +type=crs"
        return MapFrame(read_crs(crs).to_wkt(), (0.0, 0.0, altitude), heights, text)
    utm = utm_of(longitude, latitude)
    corner = MapFrame(utm).from_lonlat(np.array([[longitude, latitude, 0.0]]))[0]
    return MapFrame(utm, (float(corner[0]), float(corner[1]), altitude), heights, text)


def mgrs_frame(grid: str, where: str = PROJECTOR) -> MapFrame:
    """Metres from the lower-left corner of a 100 km square such as 54SUE."""
    try:
        zone, hemisphere, easting, northing = require("mgrs", "geo", where).MGRS().MGRSToUTM(grid)
    except MapvoteError:
        raise
    except Exception as error:  # the library raises its own, of several kinds
        raise MapvoteError(f"{where}: {grid!r} is no MGRS grid such as 54SUE") from error
    corner = tuple(float(np.floor(v / _SQUARE_M) * _SQUARE_M) for v in (easting, northing))
    return MapFrame(f"EPSG:{(32600 if hemisphere == 'N' else 32700) + int(zone)}", (corner[0], corner[1], 0.0))


def projector_of(frame: MapFrame) -> str:
    """The text of map_projector_info.yaml for a frame that Autoware can express; MapvoteError if it cannot."""
    if frame.projector:
        return frame.projector
    if frame.is_local:
        return _as_yaml({"projector_type": "Local"})
    raise MapvoteError(f"Autoware has no projector for {frame.crs[:60]}; give --projector MGRS, or LocalCartesianUTM")


def autoware_frame(frame: MapFrame, points: NDArray[np.floating], wanted: str | None = None) -> MapFrame:
    """The frame in which Autoware shall have a map of ``points`` (n, 3), map metres.

    The one it has, if Autoware can express it; else MGRS if all points lie in one square, else metres from the
    middle in UTM. ``wanted``: a projector that the user named; "MGRS" and "LocalCartesianUTM" alone choose for him.
    """
    if wanted not in (None, "MGRS", "LocalCartesianUTM"):
        return read_projector(str(wanted))
    if frame.is_local or (frame.projector and wanted is None):
        return frame
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    corners = frame.to_lonlat(np.array([low, high, (low + high) / 2.0]))
    library = require("mgrs", "geo", "map_projector_info.yaml").MGRS()
    squares = {str(library.toMGRS(float(lat), float(lon), MGRSPrecision=0)) for lon, lat, _ in corners}
    datum = {"vertical_datum": "EGM2008" if "EGM2008" in frame.heights else "WGS84"}
    if wanted == "MGRS" or (wanted is None and len(squares) == 1):
        if len(squares) > 1:
            raise MapvoteError(f"the map spans the MGRS squares {', '.join(sorted(squares))}; use LocalCartesianUTM")
        return frame_of_projector(_as_yaml({"projector_type": "MGRS", **datum, "mgrs_grid": squares.pop()}))
    longitude, latitude = (round(float(v), 6) for v in corners[2, :2])
    origin = {"latitude": latitude, "longitude": longitude, "altitude": 0.0}
    return frame_of_projector(_as_yaml({"projector_type": "LocalCartesianUTM", **datum, "map_origin": origin}))


def _as_yaml(about: dict[str, Any]) -> str:
    text: str = yaml.safe_dump(about, sort_keys=False)
    return text


def frame_wanted(crs: str | None, projector: str | None) -> MapFrame | None:
    """What ``--crs`` or ``--projector`` ask for; None if neither does. MapvoteError if both do."""
    if crs is not None and projector is not None:
        raise MapvoteError("--crs and --projector both name the frame; give one of them")
    if projector is not None:
        return read_projector(projector)
    if crs is None:
        return None
    return MapFrame() if crs.lower() == LOCAL else frame_of({"crs": crs})
