"""mapvote keeps 3D point-cloud maps true: vehicles vote on what has changed.

The public names below are imported when they are first used, so that ``import mapvote`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mapvote.client import MapClient as MapClient
    from mapvote.codec.ballot import Ballot as Ballot
    from mapvote.config import Settings as Settings
    from mapvote.config import load_settings as load_settings
    from mapvote.core.point_map import PointMap as PointMap
    from mapvote.core.point_map import map_from_points as map_from_points
    from mapvote.core.sensors import Sensor as Sensor
    from mapvote.core.types import CellState as CellState
    from mapvote.core.types import Drive as Drive
    from mapvote.core.types import MapvoteError as MapvoteError
    from mapvote.core.types import Scan as Scan
    from mapvote.formats import open_drive as open_drive
    from mapvote.formats import read_map as read_map
    from mapvote.formats import write_map as write_map
    from mapvote.formats.drives.point_fields import scan_from_point_cloud2 as scan_from_point_cloud2
    from mapvote.fusion.fuse import update_map as update_map
    from mapvote.survey.build import build_map as build_map
    from mapvote.vehicle import Vehicle as Vehicle
    from mapvote.vehicle import vote_drive as vote_drive

_HOME = {
    "Ballot": "codec.ballot",
    "CellState": "core.types",
    "Drive": "core.types",
    "MapClient": "client",
    "MapvoteError": "core.types",
    "PointMap": "core.point_map",
    "Scan": "core.types",
    "Sensor": "core.sensors",
    "Settings": "config",
    "Vehicle": "vehicle",
    "build_map": "survey.build",
    "load_settings": "config",
    "map_from_points": "core.point_map",
    "open_drive": "formats",
    "read_map": "formats",
    "scan_from_point_cloud2": "formats.drives.point_fields",
    "update_map": "fusion.fuse",
    "vote_drive": "vehicle",
    "write_map": "formats",
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'mapvote' has no attribute {name!r}")
    try:
        return getattr(import_module(f"mapvote.{_HOME[name]}"), name)
    except ModuleNotFoundError as error:
        from mapvote.core.extras import missing_extra
        from mapvote.core.types import MapvoteError

        mend = missing_extra(error)
        if mend is None:
            raise
        raise MapvoteError(f"mapvote.{name}: {mend}") from error


def __dir__() -> list[str]:
    return __all__
