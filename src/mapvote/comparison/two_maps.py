"""Two maps of one place, of any origin, brought into one frame and onto one lattice."""

from __future__ import annotations

import numpy as np

from mapvote.comparison.register import Registered, register_clouds
from mapvote.core.geometry import rotation_angle
from mapvote.core.point_map import PointMap, all_points, map_from_points
from mapvote.core.types import F64

_SAME_M, _SAME_DEG = 0.05, 0.1
"""Maps of one lattice that are registered this near to where they are already lie where they are: their free space
holds cell by cell."""


def brought_into(map_a: PointMap, map_b: PointMap, *, unbend: bool = False) -> tuple[PointMap, Registered]:
    """(b as a map in a's frame on a's lattice, how it was registered).

    Its ground is laid anew from its points, and it knows no free space: words of voxels cannot be turned. A map that
    lies in a's frame already is returned as it is. MapvoteError where they do not register.
    """
    points_a, points_b = all_points(map_a), all_points(map_b)
    registered = register_clouds(points_a, points_b, unbend=unbend)
    if map_a.lattice == map_b.lattice and not registered.unbent and _is_in_place(registered.T_a_b, points_b):
        return map_b, registered
    return map_from_points(registered.points, lattice=map_a.lattice, map_id=map_b.map_id), registered


def _is_in_place(T: F64, points: F64) -> bool:
    middle = np.median(points, axis=0)
    return bool(
        np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - middle) < _SAME_M and np.degrees(rotation_angle(T)) < _SAME_DEG
    )
