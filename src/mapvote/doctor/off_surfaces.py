"""Do the points of a localised drive lie on the surfaces of the map? Ranges with an offset or with noise do not.

A drive whose ranges scatter by .4 m, or are all .15 m short, is localised in every scan, and its points beside the
walls are voted in as new walls. Vehicles with the same sensor share the defect. So points of some scans are compared
with the planes that the map shows around them, walls and roads apart. In the median they lie .02 to .03 m off walls and
.01 m off roads, on two recorded streets and a simulated one; what has changed lies farther away and does not count.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mapvote.core.geometry import transform
from mapvote.core.neighbours import nearest
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.sampling import evenly
from mapvote.core.types import F32, F64, Bool, Drive, MapvoteError
from mapvote.doctor import Finding
from mapvote.doctor.bent_scans import check_bent, window_for
from mapvote.matching.ndt_map import MapWindow, tiles_within
from mapvote.matching.prepare import Sample, deskew, motion_at


@record()
@dataclass(frozen=True, slots=True)
class OffSurfaces:
    """Numbers of the comparison of points with the planes of a map."""

    scans: int = 8
    """Scans that are compared, evenly along the drive."""
    least_scans: int = 3
    """Least number of scans that show enough of a kind of surface."""
    points: int = 4_000
    """Points of a scan that are compared."""
    ranges_m: tuple[float, float] = (2.0, 40.0)
    """Least and greatest range of these, metres."""
    neighbours: int = 10
    """Map points that make a plane."""
    reach_m: float = 1.0
    """Greatest distance of these from the point, metres."""
    flat_m: float = 0.05
    """Greatest thickness of a plane, standard deviation, metres."""
    wide_m: float = 0.08
    """Least extent of a plane in both directions, standard deviation, metres."""
    same_m: float = 0.3
    """Points farther off a plane belong to something else, metres."""
    least_on_walls: int = 150
    """Points of a scan beside walls, at least."""
    least_on_road: int = 400
    """Points of a scan beside the road, at least: fewer are what was left of a road that was cut out."""
    wall: float = 0.3
    """Greatest vertical part of a wall's normal."""
    road: float = 0.9
    """Least vertical part of a road's normal."""
    off_wall_m: float = 0.055
    """Greatest median distance of points from walls, metres."""
    off_road_m: float = 0.045
    """The same from roads, metres."""
    offset_share: float = 0.6
    """Share of the median distance from which on a median with its sign is an offset."""


OFF_SURFACES = OffSurfaces()


def check_points(
    drive: Drive, T_map_lidar: Sequence[F64], point_map: PointMap, *, localised: bool = True
) -> list[Finding]:
    """Whether times or ranges of the points are wrong, by the map: bent scans, else points off its surfaces, on which
    those of bent scans do not lie either. ``T_map_lidar`` as :func:`check_off_surfaces`."""
    around = window_for(point_map, localised)
    bent = list(check_bent(drive, T_map_lidar, around))
    return bent or list(check_off_surfaces(drive, T_map_lidar, around))


def check_off_surfaces(
    drive: Drive, T_map_lidar: Sequence[F64], around: MapWindow, rules: OffSurfaces = OFF_SURFACES
) -> Iterator[Finding]:
    """Points that lie farther off the walls or the roads of the map than those of a sound sensor. ``T_map_lidar`` and
    ``around`` as :func:`check_bent`."""
    poses = np.array(T_map_lidar)
    if len(poses) < rules.least_scans:
        return
    of_walls: list[tuple[float, float]] = []
    of_roads: list[tuple[float, float]] = []
    for i in evenly(0, len(poses) - 1, rules.scans)[::-1].tolist():  # the window was used last at the end
        try:
            scan = drive.read_scan(i)
        except MapvoteError:  # its own finding
            continue
        # A scan lies where the map fits it best: what is left then is no error of the pose.
        twist = motion_at(drive.stamps_ns[: len(poses)], poses, i)
        T = around(poses[i, :3, 3]).refine(Sample(scan).clouds(twist), poses[i]).T_map_lidar
        off_m, steep = _off_planes(deskew(scan, twist), T, around.point_map, rules)
        for kind, chosen, least in (
            (of_walls, steep <= rules.wall, rules.least_on_walls),
            (of_roads, steep >= rules.road, rules.least_on_road),
        ):
            if chosen.sum() >= least:
                kind.append((float(np.median(np.abs(off_m[chosen]))), float(np.median(off_m[chosen]))))
    yield from _finding("walls", np.array(of_walls), rules.off_wall_m, rules)
    yield from _finding("road", np.array(of_roads), rules.off_road_m, rules)


def _off_planes(points: F32, T: F64, point_map: PointMap, rules: OffSurfaces) -> tuple[F64, F64]:
    """(distance of points from the map's planes near them, metres, positive on the sensor's side; vertical part of each
    plane's normal), of the points (n, 3) of a scan at ``T`` (4, 4) that lie beside a plane."""
    few = points[:: max(1, len(points) // rules.points)].astype(np.float64)
    range_m = np.linalg.norm(few, axis=1)
    few = few[(range_m > rules.ranges_m[0]) & (range_m < rules.ranges_m[1])]
    on_map = transform(T, few)
    tiles = [point_map.tiles[index].points_map for index in tiles_within(point_map, T[:3, 3], rules.ranges_m[1])]
    mapped = np.concatenate([np.zeros((0, 3)), *tiles])
    x_m, y_m = mapped[:, :2].T - T[:2, 3, None]
    mapped = mapped[x_m**2 + y_m**2 < (rules.ranges_m[1] + rules.reach_m) ** 2]
    if len(mapped) < rules.neighbours or not len(on_map):
        return np.zeros(0), np.zeros(0)
    away_m, beside = nearest(mapped, on_map, rules.neighbours, rules.reach_m)
    near = np.isfinite(away_m).all(axis=1)
    on_map = on_map[near]
    patches = mapped[beside[near]]
    middles = patches.mean(axis=1)
    patches = patches - middles[:, None]
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", patches, patches) / rules.neighbours)
    normals = axes[:, :, 0]
    towards = np.sign(np.einsum("ni,ni->n", T[:3, 3] - middles, normals))
    off_m = np.einsum("ni,ni->n", on_map - middles, normals) * towards
    is_plane: Bool = (variances[:, 0] < rules.flat_m**2) & (variances[:, 1] > rules.wide_m**2)
    chosen = is_plane & (np.abs(off_m) < rules.same_m)
    return off_m[chosen], np.abs(normals[chosen, 2])


def _finding(surface: str, scans: F64, most_m: float, rules: OffSurfaces) -> Iterator[Finding]:
    """The finding on one kind of surface. ``scans`` (m, 2): median distance and median offset of each, metres."""
    if len(scans) < rules.least_scans:
        return
    off_m, offset_m = np.median(scans, axis=0).tolist()
    if off_m <= most_m:
        return
    problem = f"points lie {off_m:.2f} m (median) off the {surface} of the map, those of sound drives .01 to .03 m"
    if abs(offset_m) > rules.offset_share * off_m:
        problem += f", {'nearer to' if offset_m > 0.0 else 'farther from'} the sensor"
        mend = "is an offset or a factor missing in the ranges, or are the angles of the beams another sensor's?"
    else:
        mend = "do ranges scatter, or are scans bent or put together from several?"
    yield Finding("error", problem, f"{mend} Correct the points; where the map is that rough, say --unchecked")
