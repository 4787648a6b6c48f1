"""Points that are no surface: what hardly any scan met, and what range noise carried into the next voxel.

A beam that grazes an edge reports a place between two surfaces; a pane shows a room that is not there. Such points lie
where other scans saw nothing, because they saw the wall before it: no ray speaks against them. But a surface that so
many scans passed at close range is met again and again, and these are not. And a wall two centimetres from a voxel's
face is met in two voxels: the fewer points just over the face are the same wall, and no second one.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.core.types import F64, I32, Bool
from mapvote.core.voxels import thin, voxel_keys

NEAR_M = 20.0
"""Whoever passes nearer than this, in the plane, should meet what stands."""
MET_SHARE = 0.03
"""Of these places, the share from which it must be met: two scans of seventy, at 10 Hz and 40 km/h twice past."""
SPILL_M = 0.06
"""Points of two voxels so near on both sides of their common face are one surface: three sigmas of range noise."""
_PLACE_M = 1.0
_MOST_ASKED = 16
"""Voxels met by more scans than this are not asked: 500 places within 20 m are a survey of a dozen passes."""


def strays(points: F64, scans: I32, driven: F64, lattice: Lattice) -> Bool:
    """(n,) which of a map's points (n, 3), one a voxel, in map metres, are no surface of their own.

    ``scans`` (n,): how many scans met each; ``driven`` (m, 3): where all scans were taken. Places count, a metre apart,
    for who waits at a light sees the same again.
    """
    places = driven[thin(driven, _PLACE_M)]
    return _hardly_met(points, scans, places) | _spilled(points, scans, lattice)


def _hardly_met(points: F64, scans: I32, places: F64) -> Bool:
    out = np.zeros(len(points), dtype=np.bool_)
    if not len(places):
        return out
    tree = cKDTree(places[:, :2])
    # Places near to one point are near to each other: what was met oftener than the most of them ask is not counted.
    most = tree.query_ball_point(places[:, :2], 2.001 * NEAR_M, return_length=True).max()
    asked = np.flatnonzero(scans < min(_MOST_ASKED, MET_SHARE * most))
    if len(asked):
        passed = tree.query_ball_point(points[asked, :2], NEAR_M, return_length=True)
        out[asked] = scans[asked] < MET_SHARE * passed
    return out


def _spilled(points: F64, scans: I32, lattice: Lattice) -> Bool:
    """Points over the side of a voxel beside which more scans met a surface, less than SPILL_M off."""
    keys = voxel_keys(points, lattice.x0, lattice.y0)
    order = np.argsort(keys)
    out = np.zeros(len(points), dtype=np.bool_)
    if not len(points):
        return out
    for axis, origin in ((0, lattice.x0), (1, lattice.y0)):
        within = (points[:, axis] - origin) % CELL_SIZE
        aside = np.zeros(3)
        for sign in (-1.0, 1.0):
            aside[axis] = sign * CELL_SIZE
            wanted = voxel_keys(_middles(points, lattice) + aside, lattice.x0, lattice.y0)
            beside = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
            mine = CELL_SIZE - within if sign > 0 else within
            theirs = within[beside] if sign > 0 else CELL_SIZE - within[beside]
            same = (keys[beside] == wanted) & (mine + theirs < SPILL_M)
            out |= same & (mine < theirs) & (scans < scans[beside])
    return out


def _middles(points: F64, lattice: Lattice) -> F64:
    """(n, 3) the middle of each point's voxel: steps from there reach the next one whatever rounding does."""
    origin = np.array([lattice.x0, lattice.y0, 0.0])
    return np.asarray((np.floor((points - origin) / CELL_SIZE) + 0.5) * CELL_SIZE + origin)
