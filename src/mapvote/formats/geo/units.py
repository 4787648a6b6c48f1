"""From the coordinates of a file to map metres and back: units converted, degrees refused on the way in, another frame
where one is wanted."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.record import record
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.geo.frame import ENU, MapFrame, pyproj, read_crs, utm_of

log = logging.getLogger("mapvote.formats")

METRES = {9001: "metre", 9002: "foot", 9003: "US survey foot"}
"""EPSG's codes of units of length."""
_UNITS: dict[str, Any] = {
    "metre": "metre",
    "foot": {"type": "LinearUnit", "name": "foot", "conversion_factor": 0.3048},
    "US survey foot": {"type": "LinearUnit", "name": "US survey foot", "conversion_factor": 1200.0 / 3937.0},
}

Convert = Callable[[NDArray[np.floating]], NDArray[np.floating]]
"""Points (n, 3) of a file to map metres; the same array if there is nothing to do."""


@record()
@dataclass(frozen=True, slots=True)
class EarthSize:
    """Places of streets on Earth, by which units of coordinates are recognised."""

    radius_m: tuple[float, float] = (6.33e6, 6.40e6)
    """Distances of streets from the Earth's centre, least and largest, metres."""
    highest_m: float = 10_000.0
    """Largest height of a street, metres."""


EARTH_SIZE = EarthSize()


def settle(
    source: str, stated: MapFrame, wanted: MapFrame | None, first: NDArray[np.floating], *, sure: bool = False
) -> tuple[MapFrame, Convert]:
    """(frame of the map, how the file's points get there).

    ``stated``: the file's own frame, in any unit. ``wanted``: the requested frame (``--crs``,
    ``--projector``), None to stay where the file is. ``first``: some points (n, 3) of the file, to name the UTM zone.
    ``sure``: the user stated that the file is in local metres.
    MapvoteError if the file is in degrees, or geocentric, and no frame is requested, or if the requested frame is not
    in metres.
    """
    if stated.refusal:
        raise MapvoteError(stated.refusal)
    if wanted is not None and not stated.is_local:
        wanted = _in_metres(source, wanted)
    if stated.is_local:
        if wanted is None or wanted.is_local:
            if not sure:
                _check_no_degrees(source, first)
            return stated, lambda points: points
        log.warning("%s: names no coordinate system: the requested one is assumed", source)
        stated = replace(wanted, heights=stated.heights or wanted.heights)
        if not any(wanted.offset_m):
            wanted = None
    if stated.crs.startswith(ENU):
        return _moved(stated, wanted)
    crs = read_crs(stated.crs)
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
    own = crs.sub_crs_list[1].name if crs.is_compound else "above the ellipsoid" if len(crs.axis_info) == 3 else ""
    heights = stated.heights or own
    if horizontal.is_geographic or horizontal.is_geocentric:
        if wanted is None or wanted.is_local:
            raise MapvoteError(_degrees(source, horizontal, first))
        return _from_degrees(source, horizontal, replace(wanted, heights=wanted.heights or heights))
    to_m, z_to_m = _units_of_file(source, crs)
    metric = replace(stated, crs=_short(stated.crs), heights=heights)
    if (to_m, z_to_m) != (1.0, 1.0):
        in_metres = pyproj().CRS.from_json_dict(_with_unit(horizontal.to_json_dict(), "metre"))
        metric = replace(metric, crs=_short(in_metres.to_wkt()))
        log.warning("%s: x, y in units of %.10g m, z of %.10g m: converted to metres", source, to_m, z_to_m)
    scale = np.array([to_m, to_m, z_to_m])
    frame, move = _moved(metric, wanted)
    if (scale == 1.0).all():
        return frame, move
    return frame, lambda points: move(points.astype(np.float64) * scale)


def settle_out(
    source: str, stated: MapFrame, wanted: MapFrame | None, points: NDArray[np.floating]
) -> tuple[MapFrame, Convert]:
    """(frame of the file, how a map's points get there): as :func:`settle`, the other way.

    x and y are in the unit of the file's coordinate system, degrees too: x east or longitude, y north or latitude. z is
    in the unit that the system names for heights, else in that of x and y, but never in degrees.
    MapvoteError if a map whose place is unknown is wanted in degrees, or for a geocentric system.
    """
    if wanted is None or wanted.is_local or wanted.crs.startswith(ENU):
        return settle(source, stated, wanted, points, sure=True)
    crs = read_crs(wanted.crs)
    if crs.is_geocentric or (stated.is_local and crs.is_geographic):
        cause = "geocentric metres have no heights" if crs.is_geocentric else "the map's place on Earth is unknown"
        raise MapvoteError(f"{source}: {cause}; give --crs a projection in metres or feet, such as EPSG:32654")
    to_m, z_to_m = _units(crs)
    if crs.is_geographic:
        z_to_m = z_to_m if _up(crs) else 1.0
    if stated.is_local:
        log.warning("%s: the map names no coordinate system: the requested one is assumed", source)
        scale = np.array([to_m, to_m, z_to_m])
        return wanted, lambda points: points.astype(np.float64) / scale
    frame, move = _moved(stated, wanted)
    if z_to_m == 1.0:
        return frame, move
    return frame, lambda points: move(points) / np.array([1.0, 1.0, z_to_m])


def _in_metres(source: str, wanted: MapFrame) -> MapFrame:
    """A requested frame of a map, its projection in metres; MapvoteError for degrees."""
    if wanted.is_local or wanted.crs.startswith(ENU):
        return wanted
    crs = read_crs(wanted.crs)
    if crs.is_geographic or crs.is_geocentric:
        raise MapvoteError(
            f"{source}: a map needs metres, but {crs.name} is not a projected system; give --crs EPSG:326zz"
        )
    if _units(crs) == (1.0, 1.0):
        return wanted
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
    in_metres = pyproj().CRS.from_json_dict(_with_unit(horizontal.to_json_dict(), "metre"))
    log.warning("%s: a map is in metres, so the units of %s are taken as metres", source, horizontal.name)
    return replace(wanted, crs=_short(in_metres.to_wkt()))


def _moved(stated: MapFrame, wanted: MapFrame | None) -> tuple[MapFrame, Convert]:
    """From one metric frame to another; the same projection takes only a subtraction, which is exact."""
    if wanted is None or wanted.is_local or (wanted.crs == stated.crs and wanted.offset_m == stated.offset_m):
        return wanted if wanted is not None and wanted.projector else stated, lambda points: points
    wanted = replace(wanted, heights=wanted.heights or stated.heights)
    if wanted.crs == stated.crs:
        shift = np.array(stated.offset_m) - np.array(wanted.offset_m)
        return wanted, lambda points: points.astype(np.float64) + shift
    return wanted, lambda points: wanted.from_lonlat(stated.to_lonlat(points))


def _from_degrees(source: str, crs: Any, wanted: MapFrame) -> tuple[MapFrame, Convert]:
    """From the degrees (or geocentric metres) of a file; x is the longitude."""
    module = pyproj(source)
    to_wgs84 = module.Transformer.from_crs(crs, "EPSG:4979" if crs.is_geocentric else "EPSG:4326", always_xy=True)

    def convert(points: NDArray[np.floating]) -> F64:
        columns = points.astype(np.float64).T
        if not crs.is_geocentric and not (np.abs(columns[1]) <= 90.0).all():
            raise MapvoteError(f"{source}: latitudes beyond 90 degrees; are x and y exchanged?")
        moved = to_wgs84.transform(*columns) if crs.is_geocentric else (*to_wgs84.transform(*columns[:2]), columns[2])
        return wanted.from_lonlat(np.column_stack(moved))

    return wanted, convert


def _degrees(source: str, crs: Any, first: NDArray[np.floating]) -> str:
    longitude, latitude = (float(v) for v in first[0, :2]) if len(first) else (0.0, 0.0)
    zone = "EPSG:n"
    if crs.is_geographic and abs(longitude) <= 180.0 and abs(latitude) <= 90.0:
        zone = utm_of(longitude, latitude)
    unit = "degrees" if crs.is_geographic else "metres from the Earth's centre"
    return (
        f"{source}: coordinates are {unit} ({crs.name}), and a map needs metres; project them: "
        f"mapvote import '{source}' MAP --crs {zone}"
    )


def _check_no_degrees(source: str, points: NDArray[np.floating]) -> None:
    """Refuse what can only be longitudes and latitudes: many points in a plate of degrees, far higher than wide."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        return
    low = points.min(axis=0)
    high = points.max(axis=0)
    radius_m = float(np.linalg.norm(points.astype(np.float64), axis=1).mean())
    if (
        EARTH_SIZE.radius_m[0] < radius_m < EARTH_SIZE.radius_m[1]
        and float(np.abs(points[:, 2]).min()) > EARTH_SIZE.highest_m
    ):
        raise MapvoteError(
            f"{source}: the points lie {radius_m / 1000.0:.0f} km from (0, 0, 0): they look like metres from the "
            f"Earth's centre; if so: mapvote import '{source}' MAP --from-crs EPSG:4978 --crs EPSG:n; "
            "if not: --from-crs local"
        )
    wide = float((high - low)[:2].max())
    on_earth = np.abs([low[0], high[0]]).max() <= 180.0 and np.abs([low[1], high[1]]).max() <= 90.0
    if on_earth and 0.0 < wide < 0.5 and float(high[2] - low[2]) > 4.0 * wide:
        raise MapvoteError(
            f"{source}: {wide:.4f} wide and {high[2] - low[2]:.1f} high: x and y look like degrees; if so: "
            f"mapvote import '{source}' MAP --from-crs EPSG:4326 --crs {utm_of(float(low[0]), float(low[1]))}; "
            f"if these are metres: --from-crs local"
        )


def _units(crs: Any) -> tuple[float, float]:
    """Metres in one unit of x and y, and of z. Heights without a unit have that of x and y."""
    plane = [a for a in crs.axis_info if a.direction.lower() not in ("up", "down")]
    to_m = float(plane[0].unit_conversion_factor) if plane else 1.0
    up = _up(crs)
    return to_m, float(up[0].unit_conversion_factor) if up else to_m


def _up(crs: Any) -> list[Any]:
    """The axis of heights, if the system names one."""
    return [a for a in crs.axis_info if a.direction.lower() in ("up", "down")]


def _units_of_file(source: str, crs: Any) -> tuple[float, float]:
    """:func:`_units`, with a message where the unit of heights is assumed. MapvoteError if z counts downwards."""
    up = _up(crs)
    if up and up[0].direction.lower() == "down":
        raise MapvoteError(f"{source}: z counts downwards ({crs.name}); negate z first")
    to_m, z_to_m = _units(crs)
    if not up and to_m != 1.0:
        log.warning("%s: names no unit for heights: taken to be that of x and y", source)
    return to_m, z_to_m


def with_units(text: str, plane: str | None, up: str | None) -> str:
    """A CRS with other units than its own for x and y, and for z (names of ``METRES``, None for no other)."""
    crs = read_crs(text)
    if crs.is_geographic:
        return text
    parts = list(crs.sub_crs_list) if crs.is_compound else [crs]
    plain = True
    for i, (part, unit) in enumerate(zip(parts, (plane, up), strict=False)):
        own = float(part.axis_info[0].unit_conversion_factor)
        factor = own if unit is None else 1.0 if unit == "metre" else _UNITS[unit]["conversion_factor"]
        if abs(factor - own) > 1e-9:
            parts[i] = pyproj().CRS.from_json_dict(_with_unit(part.to_json_dict(), _UNITS[unit or "metre"]))
            plain = False
    if len(parts) == 1 and up is not None:
        axis = {"name": "Height", "abbreviation": "H", "direction": "up", "unit": _UNITS[up]}
        system = {"subtype": "vertical", "axis": [axis]}
        datum = {"type": "VerticalReferenceFrame", "name": "unknown"}
        vertical = {"type": "VerticalCRS", "name": "height", "datum": datum, "coordinate_system": system}
        parts.append(pyproj().CRS.from_json_dict(vertical))
        plain = False
    if plain:
        return text
    if len(parts) == 1:
        return str(parts[0].to_wkt())
    compound = pyproj().crs.CompoundCRS(" + ".join(part.name for part in parts), parts)
    return str(compound.to_wkt())


def _with_unit(node: Any, unit: Any) -> Any:
    if isinstance(node, list):
        return [_with_unit(child, unit) for child in node]
    if not isinstance(node, dict):
        return node
    out = {key: _with_unit(child, unit) for key, child in node.items() if key not in ("id", "ids")}
    if "axis" in out and "direction" not in out:
        for axis in out["axis"]:
            own = axis.get("unit")
            angular = own == "degree" or (isinstance(own, dict) and own.get("type") == "AngularUnit")
            axis["unit"] = own if angular else unit
    return out


def _short(crs: str) -> str:
    """ "EPSG:n" for a CRS that is exactly that one, else its WKT."""
    own = read_crs(crs)
    code = own.to_epsg(min_confidence=100)
    if code is not None and own.equals(read_crs(f"EPSG:{code}"), ignore_axis_order=True):
        return f"EPSG:{code}"
    return str(own.to_wkt())
