"""Does the drive lie on the map? Scans along it are registered, and how the map differs from the prior is measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapvote.config import NdtSettings
from mapvote.core.geometry import from_xyz_rpy, inverse
from mapvote.core.grid import CELL_SIZE, TILE_CELLS
from mapvote.core.heights import LEVEL_M, check_heights, heights_over_ground
from mapvote.core.point_map import PointMap
from mapvote.core.types import F32, F64, Drive, MapvoteError, Scan
from mapvote.doctor.difference import Difference, difference_of
from mapvote.doctor.finding import Finding, Progress, Severity
from mapvote.doctor.other_scale import in_another_scale
from mapvote.doctor.other_unit import in_another_unit
from mapvote.doctor.places import Place, fitting, register_all, total_fit
from mapvote.doctor.road import find_road
from mapvote.localisation.global_search import GlobalSearch
from mapvote.localisation.map_window import MapWindow
from mapvote.localisation.pose_check import MIN_FIT
from mapvote.localisation.prepare import deskew, motion_at

_PLACES = 6
_SEARCHED = 4
_FEW = 0.8
"""If fewer scans fit, the map may be in another scale."""
_MIRROR = np.array([1.0, -1.0, 1.0], dtype=np.float32)
_TURN_DEG, _TILT_DEG, _SCALE = 0.5, 1.5, 0.01


def check_on_map(drive: Drive, T: F64, point_map: PointMap, tell: Progress | None = None) -> tuple[list[Finding], F64]:
    """(findings, the poses (n, 4, 4) as they lie on the map), by a prior (n, 4, 4) that suits the scans."""
    found = _outside(T, point_map)
    scans = _some_scans(drive, T)
    around = MapWindow(point_map)
    road = find_road([scan.points for scan in scans.values()])
    depth_m = road.depth_m if road.up == "+z" and road.is_there else None
    guesses = {i: _on_ground(T[i], point_map, depth_m) for i in scans}
    places = register_all(around, scans, guesses, drive.sensor.range_sigma_m, tell)
    scale = 1.0
    if len(fitting(places)) < _FEW * len(places):
        scale, better = in_another_scale(around, scans, T, drive.sensor.range_sigma_m, tell)
        if total_fit(better) > 1.2 * total_fit(places):
            places = better
        else:
            scale = 1.0
    if len(fitting(places)) < 0.5 * len(places):
        scale = 1.0
        unit = in_another_unit(point_map, scans, T, drive.sensor.range_sigma_m, tell)
        if unit is not None:
            return [unit], T
        search = GlobalSearch(point_map, NdtSettings(), drive.sensor.range_sigma_m)
        better, mirrored = _searched(search, around, drive, T, scans, tell)
        if mirrored:
            what = f"the map is mirrored against the scans: {mirrored} mirrored scans fit it, as they are none does"
            return [*found, Finding("error", what, "negate y of the map's points, or of the scans'")], T
        places = better if len(fitting(better)) > len(fitting(places)) else places
    good = fitting(places)
    if len(good) < 2:
        return [*found, _fits_nowhere(places)], T
    found += _where_not(places, good)
    difference = difference_of(np.array([T[p.index] for p in good]), np.array([p.T_map_lidar for p in good]), scale)
    found += _differs(difference, drive)
    mended = np.array([difference.applied(one) for one in T])
    return found + _heights(point_map, mended, drive), mended


def check_unit(drive: Drive, T: F64, point_map: PointMap, tell: Progress | None = None) -> list[Finding]:
    """Of a map that cannot be in metres: in which unit scans of the drive fit it."""
    unit = in_another_unit(point_map, _some_scans(drive, T), T, drive.sensor.range_sigma_m, tell)
    return [] if unit is None else [unit]


def _some_scans(drive: Drive, T: F64) -> dict[int, Scan]:
    """Along the drive, by their numbers."""
    index = np.unique(np.linspace(0, len(drive) - 1, _PLACES).astype(np.int64))
    return {int(i): _deskewed(drive, T, int(i)) for i in index}


def _deskewed(drive: Drive, T: F64, i: int) -> Scan:
    scan = drive.read_scan(i)
    points: F32 = np.ascontiguousarray(deskew(scan, motion_at(drive.stamps_ns, T, i)), dtype=np.float32)
    return Scan(scan.stamp_ns, points)


def _outside(T: F64, point_map: PointMap) -> list[Finding]:
    """How much of the drive lies outside the map's tiles, and how far."""
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
        mend = "have prior and map the same frame and origin (for oxts: origin in drive.toml)?"
        return [Finding("error", what, mend)]
    if share < 0.95:
        return [Finding("note", f"{1 - share:.0%} of the drive lies outside the map", "there it cannot vote")]
    return []


def _on_ground(T: F64, point_map: PointMap, depth_m: float | None) -> list[F64]:
    """The prior's pose; and that pose over the map's ground, where the prior's height is far off it."""
    height = float(heights_over_ground(point_map, T[None, :3, 3])[0])
    if depth_m is None or not np.isfinite(height) or abs(height - depth_m) < 1.0:
        return [T]
    return [T, from_xyz_rpy(0, 0, depth_m - height) @ T]


def _searched(
    search: GlobalSearch,
    around: MapWindow,
    drive: Drive,
    T: F64,
    scans: dict[int, Scan],
    tell: Progress | None,
) -> tuple[list[Place], int]:
    """(the places under the difference that suits most of them, how many scans fit mirrored where none fits so)."""
    chosen = [i for k, i in enumerate(scans) if k % max(1, len(scans) // _SEARCHED) == 0][:_SEARCHED]
    sigma_m = drive.sensor.range_sigma_m
    best: list[Place] = []
    mirrored = 0
    for k, i in enumerate(chosen):
        if tell is not None:
            tell("searching the map", k + 1, len(chosen))
        found = _find(search, scans[i])
        if found is not None:
            D = found @ inverse(T[i])
            places = register_all(around, scans, {j: [D @ T[j]] for j in scans}, sigma_m, None)
            best = max(best, places, key=lambda p: len(fitting(p)))
            if len(fitting(best)) > 0.6 * len(scans):
                return best, 0
        elif _find(search, Scan(scans[i].stamp_ns, scans[i].points * _MIRROR)) is not None:
            mirrored += 1
    return best, mirrored if mirrored >= 2 and len(fitting(best)) < 2 else 0


def _find(search: GlobalSearch, scan: Scan) -> F64 | None:
    try:
        found = search.find(scan)
    except MapvoteError:  # too large to search
        return None
    return None if found is None or found.fit < MIN_FIT else found.T_map_lidar


def _fits_nowhere(places: Sequence[Place]) -> Finding:
    best = max(places, key=lambda p: p.fit)
    what = (
        f"the drive fits the map nowhere: at best to {best.fit:.2f} (scan {best.index}), a place that is the same "
        f"street fits above {MIN_FIT}"
    )
    return Finding("error", what, "is it the map of another street, in another scale or tilt, or all changed?")


def _where_not(places: Sequence[Place], good: Sequence[Place]) -> list[Finding]:
    empty = [p for p in places if p.known < 0.3]
    if empty:
        scans = ", ".join(str(p.index) for p in empty)
        grave: Severity = "error" if len(empty) >= 0.4 * len(places) else "warning"
        what = f"the map holds nothing around {len(empty)} of {len(places)} places looked at (scans {scans})"
        return [Finding(grave, what, "part of the map is missing, or the drive leaves it: there it cannot vote")]
    if len(good) < 0.7 * len(places):
        what = f"scans fit the map at {len(good)} of {len(places)} places only"
        return [Finding("warning", what, "elsewhere the street has changed, or the map is bent")]
    return []


def _differs(d: Difference, drive: Drive) -> list[Finding]:
    """What the difference between prior and map amounts to, with its error."""
    parts, grave = [], 0
    off_m, sigma_m = float(np.linalg.norm(d.offset_m)), drive.prior_sigma_m
    x, y, z = d.offset_m
    if off_m > max(0.15, 0.4 * sigma_m, 3.0 * d.sigma_m):
        parts.append(f"shifted by {off_m:.2f} m (x {x:+.2f}, y {y:+.2f}, z {z:+.2f}; +-{d.sigma_m:.2f})")
        grave = max(grave, 1 + (off_m > max(0.3, 3.0 * sigma_m)))
    for name, value, sigma, least in (
        ("turned about z", d.yaw_deg, d.yaw_sigma_deg, _TURN_DEG),
        ("tilted", d.tilt_deg, d.tilt_sigma_deg, _TILT_DEG),
    ):
        if abs(value) > max(least, 4.0 * sigma):
            parts.append(f"{name} by {value:.2f} deg (+-{sigma:.2f})")
            grave = max(grave, 1 + (abs(value) > 2.0 * least))
    if abs(d.scale - 1.0) > max(_SCALE, 4.0 * d.scale_sigma):
        parts.append(f"scaled by {d.scale:.4f} (+-{d.scale_sigma:.4f})")
        grave = 2
    if not parts:
        what = f"prior and map agree to {off_m:.2f} m and {abs(d.yaw_deg):.2f} deg ({d.places} places)"
        return [Finding("note", what)]
    what = f"the map is {', '.join(parts)} against the prior, at the middle of the drive ({d.places} places)"
    mend = "if the map is right, move the prior by that (--mount for a constant one, CRS and origin for the rest)"
    return [Finding("error" if grave > 1 else "warning", what, mend)]


def _heights(point_map: PointMap, T: F64, drive: Drive) -> list[Finding]:
    """Of the sensor over the map's ground, once the difference is taken out."""
    height = check_heights(point_map, T[:, :3, 3])
    if not np.isfinite(height.median_m):
        return []
    if not -0.5 < height.median_m < 6.0:
        what = f"the sensor is {height.median_m:.1f} m above the map's ground"
        return [Finding("error", what, "the map's ground lies wrong under this drive: build it anew")]
    if abs(height.worst_off_m) > LEVEL_M + 3.0 * drive.prior_sigma_m:
        mend = "if the prior's heights are sound, so much is wrong with the map's ground: build it anew from its drives"
        return [Finding("warning", f"by the prior, {height.complaint}", mend)]
    return [Finding("note", f"by the prior: {height}")]


def check_ground(point_map: PointMap) -> list[Finding]:
    """Does the map's ground lie under the paths that it was made of?"""
    complaints = [check_heights(point_map, path).complaint for path in point_map.driven]
    mend = "build the map anew; where drives run above each other it keeps one level, and the other cannot vote there"
    return [Finding("warning", what, mend) for what in complaints if what]
