"""The frame of a map: how its metres lie on Earth, and the way between them and longitude, latitude, height; poses from
latitude, longitude and attitude (what oxts, NavSatFix and CSV priors share).
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from mapvote.core.types import F64, MapvoteError
from mapvote.formats.extras import require

LOCAL = "local"
"""Metres from an unknown place on Earth."""
ENU = "ENU "
"""``crs`` of a plane that touches the Earth: "ENU latitude longitude height" of its origin, x east, y north, z up."""
_CHUNK = 1_000_000


def pyproj(where: str = "world coordinates") -> ModuleType:
    """The module; MapvoteError naming the extra if it is not installed."""
    return require("pyproj", "geo", where)


@dataclass(frozen=True, slots=True)
class MapFrame:
    """How a map lies on Earth: ``map = coordinates in crs - offset_m``; x is east (easting), y north, z up."""

    crs: str = LOCAL
    """"local", "EPSG:n", WKT, or "ENU latitude longitude height"."""
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    heights: str = ""
    """What z counts from, e.g. "EGM2008 height", where a file states it."""
    projector: str = ""
    """The text of Autoware's map_projector_info.yaml, where the map has one."""

    @property
    def is_local(self) -> bool:
        return self.crs == LOCAL

    def georeference(self) -> dict[str, str]:
        """As free text that a PointMap carries through import, update, publish and export."""
        texts = {"crs": self.crs, "heights": self.heights, "map_projector_info.yaml": self.projector}
        if any(self.offset_m):
            texts["offset"] = ",".join(repr(v) for v in self.offset_m)
        return {name: text for name, text in texts.items() if text}

    def told(self) -> str:
        """In words: the coordinate system, what is subtracted, what heights count from."""
        if self.is_local:
            name = "local metres (place on Earth unknown)"
        elif self.crs.startswith(ENU):
            name = f"a plane at latitude, longitude, height {self.crs.removeprefix(ENU)}"
        else:
            name = f"{read_crs(self.crs).name} ({self.crs})" if len(self.crs) < 20 else str(read_crs(self.crs).name)
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

    def axes_at(self, lonlat: NDArray[np.floating]) -> F64:
        """(n, 3, 3) rotations whose columns are east, north and up at longitude, latitude, height, in map axes.

        In a projection east and north are turned by the meridian's convergence; in an ENU plane up leans away from
        its origin. Found by central differences of 100 m, right to a microradian.
        """
        step_deg = np.degrees(100.0 / 6.37e6)
        parts = []
        for east, north in ((step_deg, 0.0), (0.0, step_deg)):
            wide = east / np.cos(np.radians(lonlat[:, 1]))
            ahead, behind = lonlat.astype(np.float64).copy(), lonlat.astype(np.float64).copy()
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
        return transformer(self.crs)


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
def transformer(crs: str) -> Any:
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
    for start in range(0, len(out), _CHUNK):
        piece = out[start : start + _CHUNK]
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


log = logging.getLogger("mapvote.formats")


def poses_from_gnss(lonlat: F64, rpy: F64, frame: MapFrame | None) -> tuple[F64, MapFrame]:
    """(T_map_base (n, 4, 4), the frame they are in).

    ``lonlat`` (n, 3): longitude, latitude in degrees (WGS 84), height in metres. ``rpy`` (n, 3): roll, pitch and yaw
    in radians about the local east, north and up; yaw 0 is east, counter-clockwise. ``frame``: the map's; None or a
    local one gives a plane that touches the Earth at the first place, with a message.
    """
    if len(lonlat) == 0 or not (np.isfinite(lonlat).all() and (np.abs(lonlat[:, 1]) <= 90).all()):
        raise MapvoteError("a prior from GNSS needs latitudes within 90 degrees and no holes")
    if frame is None or frame.is_local:
        lon, lat, height = (float(v) for v in lonlat[0])
        log.warning(
            "no place on Earth is known for the map: a plane at the first fix (origin = [%.7f, %.7f, %.2f])",
            lat,
            lon,
            height,
        )
        frame = enu_frame(lat, lon, height)
    T = np.tile(np.eye(4), (len(lonlat), 1, 1))
    T[:, :3, 3] = frame.from_lonlat(lonlat)
    R_enu_base = scipy.spatial.transform.Rotation.from_euler("ZYX", rpy[:, ::-1]).as_matrix()
    T[:, :3, :3] = frame.axes_at(lonlat) @ R_enu_base
    return T, frame


def yaw_from_track(T: F64) -> F64:
    """The poses (n, 4, 4) with x along the way driven, for receivers without a heading; standing keeps the last."""
    out = T.copy()
    ahead = np.diff(T[:, :3, 3], axis=0, append=T[-1:, :3, 3])
    moving = np.flatnonzero(np.linalg.norm(ahead[:, :2], axis=1) > 0.05)
    if len(moving) == 0:
        return out
    nearest = moving[np.clip(np.searchsorted(moving, np.arange(len(T)), side="right") - 1, 0, len(moving) - 1)]
    yaw = np.arctan2(ahead[nearest, 1], ahead[nearest, 0])
    out[:, :3, :3] = scipy.spatial.transform.Rotation.from_euler("z", yaw[:, None]).as_matrix()
    return out
