"""Do drive and map belong together?"""

from __future__ import annotations

import numpy as np

from mapvote.core import geometry
from mapvote.core.grid import CELL_SIZE, TILE_CELLS
from mapvote.core.heights import LEVEL_M, check_heights
from mapvote.core.point_map import PointMap
from mapvote.core.types import F32, F64, Scan
from mapvote.core.voxels import voxel_downsample, voxel_keys
from mapvote.formats.doctor.finding import Finding


def check_overlap(T: F64, scans: dict[int, Scan], point_map: PointMap, prior_sigma_m: float) -> list[Finding]:
    """Does the prior lie on the map, at the right height, and do the scans' points fall on the map's?"""
    windows = [point_map.lattice.tile(t) for t in point_map.tiles]
    side = TILE_CELLS * CELL_SIZE
    low = np.array([[w.x0, w.y0] for w in windows])
    outside_m = np.array(
        [np.linalg.norm(np.maximum(np.maximum(low - p, p - low - side), 0), axis=1).min() for p in T[:, :2, 3]]
    )
    share = float((outside_m == 0).mean())
    if share == 0:
        a, b = low.min(axis=0), low.max(axis=0) + side
        what = (
            f"drive and map do not overlap: the drive starts at ({T[0, 0, 3]:.0f}, {T[0, 1, 3]:.0f}), "
            f"the map covers ({a[0]:.0f}, {a[1]:.0f}) to ({b[0]:.0f}, {b[1]:.0f}), {outside_m.min():.0f} m away"
        )
        return [
            Finding("error", what, "have prior and map the same frame and origin (for oxts: origin in drive.toml)?")
        ]
    found = []
    if share < 0.95:
        found.append(Finding("note", f"{1 - share:.0%} of the drive lies outside the map", "there it cannot vote"))
    hits = [_on_map(T[i], scan.points, point_map) for i, scan in scans.items() if outside_m[i] == 0]
    height = check_heights(point_map, T[outside_m == 0, :3, 3])
    if np.isfinite(height.median_m) and not -0.5 < height.median_m < 6.0:
        what = f"by the prior the sensor is {height.median_m:.1f} m above the map's ground"
        mend = "one height is above the ellipsoid, the other above the sea, or z is missing"
        found.append(Finding("error", what, mend))
    elif np.median(hits) < 0.2:
        what = f"only {np.median(hits):.0%} of a scan falls on the map (within 1 m) where the prior puts it"
        found.append(Finding("warning", what, "the prior is some metres off, or it is another place's map"))
    elif abs(height.worst_off_m) > LEVEL_M + 3.0 * prior_sigma_m:
        mend = "if the prior's heights are sound, so much is wrong with the map's ground: build it anew from its drives"
        found.append(Finding("warning", f"by the prior, {height.complaint}", mend))
    else:
        found.append(Finding("note", f"by the prior: {height}"))
    return found


def check_ground(point_map: PointMap) -> list[Finding]:
    """Does the map's ground lie under the paths that it was made of?"""
    complaints = [check_heights(point_map, path).complaint for path in point_map.driven]
    mend = "build the map anew; where drives run above each other it keeps one level, and the other cannot vote there"
    return [Finding("warning", f"the map: {what}", mend) for what in complaints if what]


def _on_map(T_map_lidar: F64, points: F32, point_map: PointMap) -> float:
    """Share of the scan's points (n, 3) in 1 m voxels of the map."""
    lattice = point_map.lattice
    local = points[np.linalg.norm(points, axis=1) < 30.0]
    placed = geometry.transform(T_map_lidar, local[voxel_downsample(local, 0.5)])
    row, col = lattice.cells_of(T_map_lidar[None, :2, 3])
    home = (int(row[0]) // TILE_CELLS, int(col[0]) // TILE_CELLS)
    near = [k for k in point_map.tiles if max(abs(k[0] - home[0]), abs(k[1] - home[1])) <= 1]
    cloud = np.concatenate([point_map.tiles[k].points_map for k in near])
    occupied = np.unique(voxel_keys(cloud, lattice.x0, lattice.y0, 1.0))
    return float(np.isin(voxel_keys(placed, lattice.x0, lattice.y0, 1.0), occupied).mean())
