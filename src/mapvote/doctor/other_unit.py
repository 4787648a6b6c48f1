"""Is the map in another unit than metres? Its points are made metres, and scans are registered to what comes out.

Scans made larger instead would not do: voxels have the size that suits points of a map in metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mapvote.core.grid import Lattice
from mapvote.core.point_map import PointMap, cut_tiles
from mapvote.core.tile import Tile
from mapvote.core.types import F64, Scan
from mapvote.doctor.finding import Finding, Progress
from mapvote.doctor.places import Place, fitting, register_all
from mapvote.localisation.map_window import MapWindow

_FEET_M = 0.3048
_SENSOR_M = 2.0
"""Height of a sensor over the road, about."""
_AROUND_M = 120.0
"""Of the drive: what its scans can see, and then some."""
_LOOKED_AT = 3
_FEWEST = 1000
"""Points of a map around a drive."""


@dataclass(frozen=True, slots=True)
class Unit:
    """What the map's numbers may be instead of metres."""

    name: str
    metres: float
    mend: str


_BY = "multiply the map's points by {:.6g}, then import it (a LAS that names its unit is converted by itself)"
UNITS = [
    Unit("in feet", _FEET_M, _BY.format(_FEET_M)),
    Unit("in centimetres", 0.01, _BY.format(0.01)),
    Unit("in millimetres", 0.001, _BY.format(0.001)),
    Unit("in inches", 0.0254, _BY.format(0.0254)),
    Unit("in kilometres", 1000.0, _BY.format(1000.0)),
    Unit("in metres that were converted as if they were feet", 1.0 / _FEET_M, "import it without converting feet"),
]


def in_another_unit(
    point_map: PointMap,
    scans: Mapping[int, Scan],
    T: F64,
    range_sigma_m: float,
    tell: Progress | None,
) -> Finding | None:
    """What the map is in, if scans fit it once it is made metres about its origin, about its middle or about the road
    below the middle of the drive; None if none does.

    ``T`` (n, 4, 4): the prior, metres.
    """
    some = list(scans)[:: max(1, len(scans) // _LOOKED_AT)][:_LOOKED_AT]

    def places(around: MapWindow, index: list[int]) -> list[Place]:
        guesses = {i: [T[i]] for i in index}
        return register_all(around, {i: scans[i] for i in index}, guesses, range_sigma_m, None)

    for k, unit in enumerate(UNITS):
        if tell is not None:
            tell("trying other units", k + 1, len(UNITS))
        for centre in (np.zeros(3), _middle(point_map), T[:, :3, 3].mean(axis=0) - [0.0, 0.0, _SENSOR_M]):
            metres = _in_metres(point_map, unit.metres, centre, T)
            if metres is None:
                continue
            around = MapWindow(metres)
            if 2 * len(fitting(places(around, some))) > len(some):
                fits = len(fitting(places(around, list(scans))))
                what = f"the map is {unit.name}: made metres, it fits {fits} of {len(scans)} scans looked at"
                return Finding("error", what, unit.mend)
    return None


def _middle(point_map: PointMap) -> F64:
    """The mean of its points."""
    sums = [(tile.points_map.sum(axis=0), len(tile.points)) for tile in point_map.tiles.values()]
    return np.asarray(sum(total for total, _ in sums) / max(1, sum(n for _, n in sums)))


def _in_metres(point_map: PointMap, scale: float, centre: F64, T: F64) -> PointMap | None:
    """Its points around the drive, ``scale`` times as large about ``centre``; None if there are hardly any."""
    low, high = T[:, :2, 3].min(axis=0) - _AROUND_M, T[:, :2, 3].max(axis=0) + _AROUND_M
    parts = []
    for tile in point_map.tiles.values():
        points = centre + scale * (tile.points_map - centre)
        parts.append(points[((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)])
    points = np.concatenate([np.empty((0, 3)), *parts])
    if len(points) < _FEWEST:
        return None
    lattice = Lattice()
    tiles = {}
    for index, mine in cut_tiles(points, lattice):
        empty = Tile.empty(lattice.tile(index))
        tiles[index] = empty.but(points=empty.window.from_map(points[mine]))
    return PointMap(point_map.map_id, lattice, tiles)
