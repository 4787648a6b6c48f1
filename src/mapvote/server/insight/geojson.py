"""Change objects as GeoJSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from mapvote.core.grid import CELL_SIZE, Lattice
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
) -> dict[str, Any]:
    """The objects as a GeoJSON FeatureCollection, ready for ``json.dumps``. Coordinates are map metres; it says so."""
    return {
        "type": "FeatureCollection",
        "coordinates": COORDINATES,
        "map_id": map_id,
        "georeference": dict(georeference or {}),
        "from_version": from_version,
        "to_version": to_version,
        "features": [_feature(o, lattice) for o in objects],
    }


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


COORDINATES = (
    "map metres: x, y in the frame of the map named here, not longitude and latitude; "
    "the WGS 84 of RFC 7946 does not apply"
)
