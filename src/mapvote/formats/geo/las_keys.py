"""GeoTIFF keys, by which LAS up to 1.3 names its coordinate system (GeoTIFF 1.1, OGC 19-008)."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from mapvote.core.types import MapvoteError
from mapvote.formats.geo.frame import MapFrame, read_crs
from mapvote.formats.geo.units import METRES, with_units

log = logging.getLogger("mapvote.formats")

_MODEL, _GEODETIC, _PROJECTED, _UNIT, _VERTICAL, _VERTICAL_UNIT = 1024, 2048, 3072, 3076, 4096, 4099
_USER_DEFINED = 32767
_MODEL_GEOGRAPHIC = 2


def frame_of_keys(where: str, keys: Mapping[int, int]) -> MapFrame:
    """The frame that the keys name; local if they name none, with a warning if they describe one of their own.

    MapvoteError if a code is none that pyproj knows.
    """
    code = keys.get(_PROJECTED) or 0
    if code in (0, _USER_DEFINED) and keys.get(_MODEL) == _MODEL_GEOGRAPHIC:
        code = keys.get(_GEODETIC) or 0
    if code == _USER_DEFINED or (keys.get(_PROJECTED) == _USER_DEFINED):
        raise MapvoteError(
            f"{where}: describes a coordinate system of its own in GeoTIFF keys, without a code; name the one it "
            f"means with --from-crs EPSG:n, or --from-crs local for metres from somewhere"
        )
    if not code:
        return MapFrame()
    vertical = keys.get(_VERTICAL, 0)
    text = f"EPSG:{code}"
    if 0 < vertical < _USER_DEFINED and _is_height(vertical):
        text += f"+{vertical}"
    try:
        read_crs(text)
        units = [METRES.get(keys.get(key, 0)) for key in (_UNIT, _VERTICAL_UNIT)]
        return MapFrame(with_units(text, units[0], units[1]))
    except MapvoteError as error:
        raise MapvoteError(f"{where}: {error}; say what it is with --from-crs") from error


def _is_height(code: int) -> bool:
    """Files often hold a code of a vertical datum, or of an ellipsoid, where that of a vertical CRS belongs."""
    try:
        return bool(read_crs(f"EPSG:{code}").is_vertical)
    except MapvoteError:
        log.warning("heights: EPSG:%d is no vertical coordinate system; ignored", code)
        return False
