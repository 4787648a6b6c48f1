"""What lies below ground that was struck from above is a reflection; beside an edge or a bridge it may be real."""

from __future__ import annotations

import numpy as np

from mapvote.core.grid import Lattice
from mapvote.core.point_map import map_from_points
from mapvote.core.types import F64
from mapvote.slam.clean_map import mirrored

LATTICE = Lattice(-30.0, -30.0)


def sheet(x: tuple[float, float], y: tuple[float, float], z: float) -> F64:
    """A level surface, a point every 0.15 m."""
    a, b = np.meshgrid(np.arange(*x, 0.15), np.arange(*y, 0.15))
    return np.column_stack([a.ravel(), b.ravel(), np.full(a.size, z)])


def road(y: float, z: float = 0.0) -> F64:
    along = np.arange(0.0, 30.0, 0.15)
    return np.column_stack([along, np.full(len(along), y), np.full(len(along), z)])


def left_out(cloud: F64, driven: F64, asked: F64) -> list[bool]:
    """Which of the points ``asked`` are taken for reflections in a map of ``cloud`` and them."""
    points = np.vstack([cloud, asked])
    out = mirrored(points, map_from_points(points, lattice=LATTICE, road=driven), driven)
    return [bool(left) for left in out[len(cloud) :]]


def test_points_metres_below_the_road_are_reflections_and_the_road_is_none() -> None:
    street = sheet((0, 30), (0, 20), 0.0)
    below = np.array([[10.0, 5.0, -1.2], [12.0, 9.0, -7.0], [12.1, 9.1, -7.1], [20.0, 5.0, -0.3], [21.0, 5.0, 0.0]])
    assert left_out(street, road(5.0), below) == [True, True, True, False, False]
    points = np.vstack([street, below])
    assert not mirrored(points, map_from_points(points, lattice=LATTICE, road=road(5.0)), road(5.0))[:-5].any()


def test_the_wall_down_to_a_yard_beside_the_street_stays() -> None:
    street, yard = sheet((0, 30), (0, 10), 0.0), sheet((0, 30), (10, 20), -3.0)
    wall = np.column_stack([np.full(10, 15.0), np.full(10, 10.0), np.linspace(-2.8, -0.2, 10)])
    assert not any(left_out(np.vstack([street, yard]), road(5.0), wall))
    assert left_out(np.vstack([street, yard]), road(5.0), np.array([[15.0, 15.0, -5.0]])) == [True]


def test_where_a_vehicle_drove_below_a_bridge_nothing_is_left_out() -> None:
    street, bridge = sheet((0, 30), (0, 30), 0.0), sheet((12, 18), (0, 30), 6.0)
    over, under = road(15.0, 6.0)[:, [1, 0, 2]], road(15.0)
    kerb = np.array([[15.0, 5.0, 0.1]])  # below the bridge, beside its path: there the map keeps the bridge
    assert left_out(np.vstack([street, bridge]), np.vstack([under, over]), kerb) == [False]
    assert left_out(np.vstack([street, bridge]), over, kerb) == [True], "one level a cell: the street was not driven"
