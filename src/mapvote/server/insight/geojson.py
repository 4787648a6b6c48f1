"""Change objects as GeoJSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.formats.geo.frame import MapFrame, frame_of
from mapvote.server.insight.changes import ChangeObject
from mapvote.server.insight.polygons import Ring


def to_geojson(
    objects: Sequence[ChangeObject],
    lattice: Lattice,
    *,
    map_id: str,
    from_version: int | None = None,
    to_version: int | None = None,
    georeference: Mapping[str, str] | None = None,
    lonlat: bool = False,
) -> dict[str, Any]:
    """The objects as a GeoJSON FeatureCollection (RFC 7946), ready for ``json.dumps``; its member "frame" says where
    coordinates lie.

    ``lonlat``: longitude and latitude, as the RFC wants them, where the map knows its place on Earth; else map metres.
    """
    frame = frame_of(georeference or {})
    features = [_feature(o, lattice) for o in objects]
    if lonlat and not frame.is_local:
        for feature in features:
            _to_lonlat(feature["geometry"], frame)
    return {
        "type": "FeatureCollection",
        "frame": "WGS 84 longitude, latitude" if lonlat and not frame.is_local else f"{MAP_METRES}: {frame.told()}",
        "map_id": map_id,
        "georeference": dict(georeference or {}),
        "from_version": from_version,
        "to_version": to_version,
        "features": features,
    }


def _to_lonlat(geometry: dict[str, Any], frame: MapFrame) -> None:
    """Rings in map metres to degrees, in place; 1e-8 degrees are a millimetre. The sense of the rings stays."""
    polygons = [geometry["coordinates"]] if geometry["type"] == "Polygon" else geometry["coordinates"]
    for polygon in polygons:
        for i, ring in enumerate(polygon):
            corners = np.column_stack([np.array(ring), np.zeros(len(ring))])
            polygon[i] = np.round(frame.to_lonlat(corners)[:, :2], 8).tolist()


def _feature(change: ChangeObject, lattice: Lattice) -> dict[str, Any]:
    polygons = [[_corners(ring, lattice) for ring in polygon] for polygon in change.outline]
    single = len(polygons) == 1
    return {
        "type": "Feature",
        "id": change.id,
        "geometry": {
            "type": "Polygon" if single else "MultiPolygon",
            "coordinates": polygons[0] if single else polygons,
        },
        "properties": {
            "kind": change.kind,
            "area_m2": round(change.area_m2, 2),
            "height_m": round(change.height_m, 2),
            "cells": change.cells,
            "points": change.points,
            "votes_min": change.votes_min,
            "votes_median": change.votes_median,
            "first_seen": _utc(change.first_seen_ns),
            "last_seen": _utc(change.last_seen_ns),
            "versions": change.versions,
        },
    }


def _corners(ring: Ring, lattice: Lattice) -> list[list[float]]:
    metres = np.round(ring * CELL_SIZE + np.array([lattice.x0, lattice.y0]), 3) + 0.0  # + 0.0: no "-0.0" in the file
    corners: list[list[float]] = metres.tolist()
    return corners


def _utc(stamp_ns: int | None) -> str | None:
    """ISO 8601, whole seconds; ``None`` where unknown."""
    if stamp_ns is None:
        return None
    return datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


MAP_METRES = "map metres, not the longitude and latitude of RFC 7946"
