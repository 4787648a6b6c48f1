"""The frame of a map: how its metres lie on Earth, and the way between them and longitude, latitude, height; poses from
latitude, longitude and attitude (what oxts, NavSatFix and CSV priors share).

Autoware's map_projector_info.yaml, its five projector types, to a frame and back: as autoware_geography_utils reckons,
heights count from the origin's altitude, except with MGRS, which leaves them.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import scipy
import yaml
from numpy.typing import NDArray

from mapvote.core.extras import require
from mapvote.core.geometry import poses_at
from mapvote.core.types import F64, Bool, MapvoteError
from mapvote.formats.reading import parse_yaml, read_text

LOCAL = "local"
"""Metres from an unknown place on Earth."""
ENU = "ENU "
"""``crs`` of a plane that touches the Earth: "ENU latitude longitude height" of its origin, x east, y north, z up."""
PROJECTOR = "map_projector_info.yaml"
TYPES = ("Local", "MGRS", "LocalCartesianUTM", "LocalCartesian", "TransverseMercator")
log = logging.getLogger("mapvote.formats")


def pyproj(needed_by: str = "world coordinates") -> ModuleType:
    """The module; MapvoteError naming the extra if it is not installed."""
    return require("pyproj", "geo", needed_by)


@dataclass(frozen=True, slots=True)
class MapFrame:
    """How a map lies on Earth: ``map = coordinates in crs - offset_m``; x is east (easting), y north, z up."""

    crs: str = LOCAL
    """"local", "EPSG:n", WKT, or "ENU latitude longitude height"."""
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    heights: str = ""
    """Vertical datum, e.g. "EGM2008 height", where a file states it."""
    projector: str = ""
    """The text of Autoware's map_projector_info.yaml, where the map has one."""
    refusal: str = ""
    """Why the coordinate system of a file is unclear, and how to name it; empty if it is known."""

    @property
    def is_local(self) -> bool:
        return self.crs == LOCAL

    def georeference(self) -> dict[str, str]:
        """The frame as free text, which a PointMap carries through import, update, publish and export."""
        texts = {"crs": self.crs, "heights": self.heights, "map_projector_info.yaml": self.projector}
        if any(self.offset_m):
            texts["offset"] = ",".join(repr(v) for v in self.offset_m)
        return {name: text for name, text in texts.items() if text}

    def told(self) -> str:
        """The frame in words: coordinate system, unit if not metres, subtracted offset, zero of the heights."""
        if self.is_local:
            name = "local metres (place on Earth unknown)"
        elif self.crs.startswith(ENU):
            name = f"a plane at latitude, longitude, height {self.crs.removeprefix(ENU)}"
        else:
            crs = read_crs(self.crs)
            name = f"{crs.name} ({self.crs})" if len(self.crs) < 20 else str(crs.name)
            unit = crs.axis_info[0].unit_name if crs.axis_info else "metre"
            if crs.is_geographic:
                name += ", x longitude, y latitude, degrees"
            elif unit != "metre":
                name += f", {unit}"
        offset = f", minus ({', '.join(f'{v:.3f}' for v in self.offset_m)})" if any(self.offset_m) else ""
        return f"{name}{offset}" + (f"; heights: {self.heights}" if self.heights else "")

    def to_lonlat(self, points: NDArray[np.floating]) -> F64:
        """(n, 3) longitude, latitude (degrees, WGS 84) and height (metres) of points (n, 3) in map metres.

        Heights are kept as they are, whatever they count from, except in an ENU plane, which knows the ellipsoid.
        MapvoteError if the map is local.
        """
        return _through(self._transformer(), points + np.array(self.offset_m), inverse=True)

    def from_lonlat(self, lonlat: NDArray[np.floating]) -> F64:
        """(n, 3) map metres of longitude, latitude (degrees, WGS 84) and height (n, 3). MapvoteError if local."""
        out: F64 = _through(self._transformer(), lonlat, inverse=False) - np.array(self.offset_m)
        return out

    def plane_to_lonlat(self, xy: NDArray[np.floating]) -> F64:
        """(n, 2) longitude and latitude, degrees to 1e-8 (a millimetre), of places (n, 2) in map metres at height 0."""
        return np.round(self.to_lonlat(_at_height_0(xy))[:, :2], 8)

    def plane_from_lonlat(self, lonlat: NDArray[np.floating]) -> F64:
        """(n, 2) map metres of longitude and latitude (n, 2), degrees, at height 0."""
        return self.from_lonlat(_at_height_0(lonlat))[:, :2]

    def axes_at(self, lonlat: NDArray[np.floating]) -> F64:
        """(n, 3, 3) rotations whose columns are east, north and up at longitude, latitude, height, in map axes.

        In a projection east and north are turned by the meridian's convergence; in an ENU plane up leans away from
        its origin. Found by central differences of 100 m, right to a microradian.
        """
        step_deg = np.degrees(100.0 / 6.37e6)
        parts = []
        for east, north in ((step_deg, 0.0), (0.0, step_deg)):
            wide = east / np.cos(np.radians(lonlat[:, 1]))
            ahead = lonlat.astype(np.float64).copy()
            behind = lonlat.astype(np.float64).copy()
            ahead[:, 0] += wide
            behind[:, 0] -= wide
            ahead[:, 1] += north
            behind[:, 1] -= north
            tangent = self.from_lonlat(ahead) - self.from_lonlat(behind)
            parts.append(tangent / np.linalg.norm(tangent, axis=1, keepdims=True))
        up = np.cross(parts[0], parts[1])
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        return np.stack([parts[0], np.cross(up, parts[0]), up], axis=2)

    def _transformer(self) -> Any:
        if self.is_local:
            raise MapvoteError(
                "the map's coordinates are local and its place on Earth is unknown; import it with --crs EPSG:n, "
                "or with --projector map_projector_info.yaml"
            )
        return _transformer(self.crs)


def _at_height_0(xy: NDArray[np.floating]) -> F64:
    return np.column_stack([xy, np.zeros(len(xy))])


def enu_frame(latitude: float, longitude: float, height: float) -> MapFrame:
    """The plane that touches the Earth at a place (degrees, metres above the ellipsoid): x east, y north, z up."""
    return MapFrame(f"{ENU}{latitude!r} {longitude!r} {height!r}", heights="above the plane")


@lru_cache(maxsize=64)
def read_crs(text: str) -> Any:
    """pyproj's CRS of an EPSG code, WKT or PROJ string; MapvoteError if it is none."""
    module = pyproj()
    try:
        return module.CRS.from_user_input(text)
    except (module.exceptions.CRSError, ValueError) as error:
        raise MapvoteError(
            f"{text[:120]!r} is no coordinate system that pyproj knows ({str(error).splitlines()[0][:200]}); "
            "give for example EPSG:32654"
        ) from error


@lru_cache(maxsize=64)
def _transformer(crs: str) -> Any:
    """From longitude, latitude (WGS 84) and height to ``crs``."""
    module = pyproj()
    if crs.startswith(ENU):
        latitude, longitude, height = (float(v) for v in crs.removeprefix(ENU).split())
        return module.Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 +lon_0={longitude!r} +lat_0={latitude!r} +h_0={height!r}"
        )
    target = read_crs(crs)
    horizontal = target.sub_crs_list[0] if target.is_compound else target
    return module.Transformer.from_crs("EPSG:4326", horizontal.to_2d(), always_xy=True)


def _through(how: Any, points: NDArray[np.floating], *, inverse: bool) -> F64:
    """Points (n, 3) through a transformer, in pieces. MapvoteError if one lies where the projection has no answer."""
    flat = "topocentric" not in how.definition
    out = np.array(points, dtype=np.float64)
    for start in range(0, len(out), 1_000_000):
        piece = out[start : start + 1_000_000]
        columns = piece[:, :2].T if flat else piece.T
        moved = how.transform(*columns, direction="INVERSE" if inverse else "FORWARD")
        for column, values in enumerate(moved):
            piece[:, column] = values
    if not np.isfinite(out[:, :2]).all():
        raise MapvoteError("points lie outside the area of their coordinate system; check --crs and --from-crs")
    return out


def utm_of(longitude: float, latitude: float) -> str:
    """ "EPSG:326zz" or "EPSG:327zz": the UTM zone (WGS 84) of a place."""
    zone = min(max(math.floor((longitude + 180.0) / 6.0) + 1, 1), 60)
    return f"EPSG:{32600 + zone if latitude >= 0 else 32700 + zone}"


def poses_from_gnss(lonlat: F64, rpy: F64, frame: MapFrame | None) -> tuple[F64, MapFrame]:
    """(T_map_base (n, 4, 4), the frame they are in).

    ``lonlat`` (n, 3): longitude, latitude in degrees (WGS 84), height in metres. ``rpy`` (n, 3): roll, pitch and yaw
    in radians about the local east, north and up; yaw 0 is east, counter-clockwise. ``frame``: the map's; None or a
    local one gives a plane that touches the Earth at the first place, with a message.
    """
    if len(lonlat) == 0 or not np.isfinite(lonlat).all():
        raise MapvoteError("a prior from GNSS needs a place for every row; leave out the others, or --prior none")
    farthest = float(np.abs(lonlat[:, 1]).max())
    if farthest > 90.0:
        problem = f"a prior from GNSS has a latitude of {farthest:.10g} degrees"
        swapped = (np.abs(lonlat[:, 0]) <= 90.0).all() and farthest <= 180.0
        mend = "are latitude and longitude swapped?" if swapped else "write decimal degrees, between -90 and 90"
        raise MapvoteError(f"{problem}: {mend}")
    if (np.abs(lonlat[:, :2]) <= [np.pi, np.pi / 2.0]).all():
        lon, lat = lonlat[0, :2].tolist()
        problem = f"a prior from GNSS lies in the sea at latitude {lat:.6f}, longitude {lon:.6f}"
        raise MapvoteError(f"{problem}: are they radians, or no fixes at all? Write degrees, or --prior none")
    if frame is None or frame.is_local:
        lon, lat, height = (float(v) for v in lonlat[0])
        problem = "no place on Earth is known for the map: a plane at the first fix (origin = [%.7f, %.7f, %.2f])"
        log.warning(problem, lat, lon, height)
        frame = enu_frame(lat, lon, height)
    R_enu_base = scipy.spatial.transform.Rotation.from_euler("ZYX", rpy[:, ::-1]).as_matrix()
    return poses_at(frame.from_lonlat(lonlat), frame.axes_at(lonlat) @ R_enu_base), frame


def have_place(lonlat: F64) -> Bool:
    """Which of the fixes (n, 3), longitude and latitude in degrees, state a place: numbers, and not (0, 0) in the Gulf
    of Guinea, which receivers send before their first fix."""
    degrees = lonlat[:, :2]
    return np.asarray(np.isfinite(degrees).all(axis=1) & (np.abs(degrees) >= 1e-6).any(axis=1))


def sound_fixes(source: str, lonlat: F64, status: F64 | None = None) -> tuple[Bool, F64]:
    """(which of the fixes (n, 3), longitude, latitude in degrees, height in metres, are ones (n,), these (m, 3)).

    Left out and counted: no fix by its ``status`` (n,), not a number, and (0, 0), which receivers send before their
    first fix. A height that is not a number is interpolated between its neighbours, or 0 where there is none, and
    counted. MapvoteError if none is left.
    """
    finite = np.isfinite(lonlat[:, :2]).all(axis=1)
    at_zero = finite & ~have_place(lonlat)
    no_fix = np.zeros(len(lonlat), dtype=np.bool_) if status is None else status < 0
    keep = finite & ~at_zero & ~no_fix
    if not keep.all():
        problem = (
            "%s: %d of %d fixes are left out: %d by their status, %d at latitude 0, longitude 0, %d without a place"
        )
        log.warning(problem, source, (~keep).sum(), len(keep), no_fix.sum(), (at_zero & ~no_fix).sum(), (~finite).sum())
    if not keep.any():
        raise MapvoteError(f"{source}: none of its {len(keep)} fixes is valid; choose another prior, or --prior none")
    place = np.array(lonlat[keep], dtype=np.float64)
    high = np.isfinite(place[:, 2])
    if not high.all():
        how = "interpolated" if high.any() else "taken as 0 m: only the map can tell them"
        log.warning("%s: %d of %d fixes have no altitude; theirs are %s", source, (~high).sum(), len(high), how)
        at = np.arange(len(place))
        place[:, 2] = np.interp(at, at[high], place[high, 2]) if high.any() else 0.0
    return keep, place


def yaw_from_track(T: F64) -> F64:
    """The poses (n, 4, 4) with x along the way driven, for receivers without a heading; standing keeps the last."""
    ahead = np.diff(T[:, :3, 3], axis=0, append=T[-1:, :3, 3])
    moving = np.flatnonzero(np.linalg.norm(ahead[:, :2], axis=1) > 0.05)
    if len(moving) == 0:
        return T
    nearest = moving[np.clip(np.searchsorted(moving, np.arange(len(T)), side="right") - 1, 0, len(moving) - 1)]
    yaw = np.arctan2(ahead[nearest, 1], ahead[nearest, 0])
    return poses_at(T[:, :3, 3], scipy.spatial.transform.Rotation.from_euler("z", yaw[:, None]).as_matrix())


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
    crs = georeference.get("crs", "")
    if not crs:
        return frame_of_projector(projector) if projector else MapFrame()
    offset = [float(v) for v in georeference.get("offset", "0,0,0").split(",")]
    return MapFrame(crs, (offset[0], offset[1], offset[2]), georeference.get("heights", ""), projector)


def frame_of_projector(text: str, source: str = PROJECTOR) -> MapFrame:
    """The frame that a map_projector_info.yaml describes; MapvoteError says what is missing or unknown."""
    about = parse_yaml(text, source)
    try:
        kind = str(about["projector_type"])
    except (TypeError, KeyError) as error:
        raise MapvoteError(f"{source}: no projector_type in it; one of {', '.join(TYPES)}") from error
    heights = {"WGS84": "above the WGS 84 ellipsoid", "EGM2008": "EGM2008 height"}.get(about.get("vertical_datum"), "")
    if kind.lower() == LOCAL:
        return MapFrame(LOCAL, heights=heights, projector=text)
    if kind == "MGRS":
        return replace(_mgrs_frame(str(about.get("mgrs_grid", "")), source), heights=heights, projector=text)
    if kind not in TYPES:
        raise MapvoteError(f"{source}: unknown projector_type {kind!r}; one of {', '.join(TYPES)}")
    try:
        origin = about["map_origin"]
        latitude = float(origin["latitude"])
        longitude = float(origin["longitude"])
        altitude = float(origin.get("altitude") or 0.0)
        scale = float(about.get("scale_factor", 0.9996))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise MapvoteError(f"{source}: {kind} needs map_origin with latitude and longitude in degrees") from error
    if not (abs(latitude) <= 90 and abs(longitude) <= 360):
        raise MapvoteError(f"{source}: map_origin {latitude}, {longitude} is no latitude and longitude in degrees")
    if kind == "LocalCartesian":
        return replace(enu_frame(latitude, longitude, altitude), projector=text)
    if kind == "TransverseMercator":
        crs = f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +k_0={scale!r} +datum=WGS84 +units=m +type=crs"
        return MapFrame(read_crs(crs).to_wkt(), (0.0, 0.0, altitude), heights, text)
    utm = utm_of(longitude, latitude)
    corner = MapFrame(utm).from_lonlat(np.array([[longitude, latitude, 0.0]]))[0]
    return MapFrame(utm, (float(corner[0]), float(corner[1]), altitude), heights, text)


def _mgrs_frame(grid: str, source: str = PROJECTOR) -> MapFrame:
    """Metres from the lower-left corner of a 100 km square such as 54SUE."""
    try:
        zone, hemisphere, easting, northing = require("mgrs", "geo", source).MGRS().MGRSToUTM(grid)
    except MapvoteError:
        raise
    except Exception as error:  # the library raises its own, of several kinds
        raise MapvoteError(f"{source}: {grid!r} is no MGRS grid such as 54SUE") from error
    side_m = 100_000.0
    x0, y0 = (float(np.floor(v / side_m) * side_m) for v in (easting, northing))
    return MapFrame(f"EPSG:{(32600 if hemisphere == 'N' else 32700) + int(zone)}", (x0, y0, 0.0))


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
    low = points.min(axis=0).astype(np.float64)
    high = points.max(axis=0).astype(np.float64)
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
    """The frame of ``--crs`` or ``--projector``; None without either. MapvoteError if both do."""
    if crs is not None and projector is not None:
        raise MapvoteError("--crs and --projector both name the frame; give one of them")
    if projector is not None:
        return read_projector(projector)
    if crs is None:
        return None
    return MapFrame() if crs.lower() == LOCAL else frame_of({"crs": crs})
