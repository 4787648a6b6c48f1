"""A scan in the map's frame: de-skewed, turned into map axes, with its cells and its obstacles.

Points are float32 metres from where the sensor's rays begin, along the map's axes: within 4 micrometres at 60 m, where
map coordinates of float32 would be centimetres off. Rows of x, y and z make loops over points vectorise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mapvote.core.columns import GROUND_MARGIN_M, height_above
from mapvote.core.geometry import rows_from
from mapvote.core.grid import CELL_SIZE
from mapvote.core.kernel import disjoint
from mapvote.core.types import F32, F64, I32, Bool, Reference, Scan
from mapvote.matching.prepare import deskew_into


class LidarPart(NamedTuple):
    """The points of one LiDAR in a scan: all of them, unless the scan is a sweep of several."""

    part: slice = slice(None)
    """Indices of its points."""
    offset_m: F64 | None = None
    """(3,) where its rays begin, metres from the scan's origin along the map's axes; None: there."""
    by_first: bool = True
    """Whether it is the vehicle's first LiDAR, which the drive's sensor is."""

    def own_rows(self, rows: F32) -> F32:
        """(3, m) metres from where its rays begin, of the scan's ``rows`` (3, n) from the scan's origin."""
        if self.part == slice(None):
            return rows
        own = rows[:, self.part]
        return np.ascontiguousarray(own if self.offset_m is None else own - self.offset_m.astype(np.float32)[:, None])

    def origin_map(self, of_scan: F64) -> F64:
        """(3,) where its rays begin, map metres; ``of_scan`` (3,): the scan's origin."""
        return of_scan if self.offset_m is None else of_scan + self.offset_m


ONE_LIDAR = (LidarPart(),)
"""The parts of a scan that the vehicle's first LiDAR took alone."""


def lidar_parts(scan: Scan, R_map_lidar: F64) -> tuple[LidarPart, ...]:
    """The LiDARs of a scan whose frame is turned by ``R_map_lidar`` (3, 3)."""
    by_first = scan.origin is None
    if not scan.others:
        return (LidarPart(by_first=by_first),)
    begin = np.zeros(3) if scan.origin is None else scan.origin
    starts = [start for start, _ in scan.others]
    parts = [LidarPart(slice(0, starts[0]), None, by_first)]
    for (start, origin), end in zip(scan.others, [*starts[1:], len(scan.points)], strict=True):
        parts.append(LidarPart(slice(start, end), np.asarray(R_map_lidar @ (origin - begin)), False))
    return tuple(parts)


class PlacedPoints(NamedTuple):
    """The points of a scan in the map's frame."""

    rows: F32
    """(3, n) metres from the sensor, along the map's axes."""
    cell: I32
    """(n,) each point's cell in the reference, row * cols + col; -1 outside it."""
    obstacle: Bool
    """(n,) points that stand above the ground of the reference; none outside it."""


def place_points(scan: Scan, twist: F64, T_map_lidar: F64, origin_map: F64, reference: Reference) -> PlacedPoints:
    """The points of ``scan`` in the map, if the sensor's motion per second was ``twist`` (6,), see
    :func:`mapvote.matching.prepare.deskew`. ``origin_map`` (3,): where its rays begin."""
    offset = T_map_lidar[:3, 3] - origin_map
    rows = deskew_into(scan.points, scan.time_s, twist, T_map_lidar[:3, :3], offset)
    return PlacedPoints(rows, *cells_and_obstacles(rows, origin_map, reference))


def cells_and_obstacles(rows: F32, origin_map: F64, reference: Reference) -> tuple[I32, Bool]:
    """:class:`PlacedPoints`' ``cell`` and ``obstacle`` (n,) of ``rows`` (3, n) from ``origin_map`` (3,).

    By the rule that built the reference, see :func:`mapvote.core.columns.height_above`.
    """
    cell = np.empty(rows.shape[1], np.int32)
    obstacle = np.empty(rows.shape[1], np.bool_)
    grid = reference.grid
    corner = float(grid.lattice.x0), float(grid.lattice.y0), grid.row0, grid.col0, grid.rows, grid.cols
    ground_z = np.ascontiguousarray(reference.ground_z).reshape(-1)
    _find_cells(rows, origin_map, corner, ground_z, np.ascontiguousarray(reference.base).reshape(-1), cell, obstacle)
    return cell, obstacle


def find_obstacles(points_map: F64, reference: Reference) -> tuple[Bool, I32]:
    """(obstacle (n,), cell (n,)) of points (n, 3), map metres, see :class:`PlacedPoints`."""
    grid = reference.grid
    middle = np.array([grid.x0 + 0.5 * CELL_SIZE * grid.cols, grid.y0 + 0.5 * CELL_SIZE * grid.rows, 0.0])
    if len(points_map):
        middle[2] = np.floor(points_map[:, 2].mean())
    cell, obstacle = cells_and_obstacles(rows_from(points_map, middle), middle, reference)
    return obstacle, cell


@disjoint
def _find_cells(
    rows: F32, origin: F64, corner: tuple[float, float, int, int, int, int], ground_z: F32, base: I32, cell: I32,
    obstacle: Bool,
) -> None:  # fmt: skip
    """``corner``: x and y of the lattice's, the first row and column of the window, and how many it has; ``ground_z``
    and ``base`` (cells,) of the window."""
    east = rows[0]
    north = rows[1]
    up = rows[2]
    x0, y0, row0, col0, height, width = corner
    for i in range(np.uint64(0), np.uint64(len(cell))):  # as Lattice.cells_of has them, to the last bit
        c = np.int32(np.int32(np.floor((np.float64(east[i]) + origin[0] - x0) / CELL_SIZE)) - np.int32(col0))
        r = np.int32(np.int32(np.floor((np.float64(north[i]) + origin[1] - y0) / CELL_SIZE)) - np.int32(row0))
        inside = (r >= 0) & (c >= 0) & (r < np.int32(height)) & (c < np.int32(width))
        cell[i] = np.int32(r * np.int32(width) + c) if inside else np.int32(-1)
    for i in range(np.uint64(0), np.uint64(len(cell))):
        at = np.uint64(max(cell[i], np.int32(0)))
        above = height_above(np.float64(up[i]) + origin[2], ground_z[at], base[at]) >= GROUND_MARGIN_M
        obstacle[i] = (cell[i] >= 0) & above
