"""What the server lists besides changes, for maps and spreadsheets: tiles as squares, contradictions as points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice
from mapvote.server.insight.consensus import Standing
from mapvote.server.insight.geojson import MAP_METRES


def tile_squares(tiles: Sequence[Mapping[str, Any]], lattice: Lattice) -> dict[str, Any]:
    """Tiles (each with row and col) as GeoJSON polygons in map metres, everything said of them as properties."""
    return _collection([(_square(lattice, tile["row"], tile["col"]), dict(tile)) for tile in tiles])


def contradictions(standings: Sequence[Standing]) -> dict[str, Any]:
    """Where vehicles contradict the others, as GeoJSON points in map metres."""
    return _collection(
        [
            (
                {"type": "Point", "coordinates": [e.x, e.y]},
                {"vehicle": s.vehicle, "verdict": s.verdict, "says": e.says, "cells": e.cells},
            )
            for s in standings
            for e in s.evidence
        ]
    )


def standing_rows(standings: Sequence[Standing]) -> list[dict[str, Any]]:
    """A row a vehicle, without the places."""
    told = ("vehicle", "verdict", "cells", "objects", "others_cells", "others_objects", "p_value", "threshold")
    return [{name: getattr(s, name) for name in told} for s in standings]


def _collection(things: Sequence[tuple[dict[str, Any], dict[str, Any]]]) -> dict[str, Any]:
    features = [{"type": "Feature", "geometry": geometry, "properties": told} for geometry, told in things]
    return {"type": "FeatureCollection", "frame": MAP_METRES, "features": features}


def _square(lattice: Lattice, row: int, col: int) -> dict[str, Any]:
    window = lattice.tile((row, col))
    side = TILE_CELLS * CELL_SIZE
    x, y, x1, y1 = (round(v, 3) for v in (window.x0, window.y0, window.x0 + side, window.y0 + side))
    return {"type": "Polygon", "coordinates": [[[x, y], [x1, y], [x1, y1], [x, y1], [x, y]]]}
