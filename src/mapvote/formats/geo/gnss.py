"""Poses from latitude, longitude and attitude, in the map's frame: what oxts, NavSatFix and CSV priors share."""

from __future__ import annotations

import logging

import numpy as np
import scipy

from mapvote.core.types import F64, MapvoteError
from mapvote.formats.geo.frame import MapFrame, enu_frame

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
