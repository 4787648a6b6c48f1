"""Does the drive lie on the map? Scans along it are registered to the map, and the poses found are compared with the
prior.

Where few scans fit, the map is tried in other scales, in other units, at other places and mirrored.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np

from mapvote.compare.register import register_maps
from mapvote.config import NdtSettings
from mapvote.core.geometry import from_xyz_rpy, inverse
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice
from mapvote.core.point_map import PointMap, cut_tiles
from mapvote.core.record import record
from mapvote.core.sampling import evenly
from mapvote.core.sensor_height import check_heights
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, Drive, MapvoteError, Scan
from mapvote.doctor import Finding, Progress, Severity
from mapvote.doctor.drive_evidence import find_road
from mapvote.doctor.prior import Similarity, fit_similarity
from mapvote.doctor.prior_fit import FEET_M
from mapvote.matching.global_search import GlobalSearch
from mapvote.matching.matcher import likeliest, likelihood_at
from mapvote.matching.ndt_map import MapWindow, NdtMap
from mapvote.matching.ndt_voxels import LEVELS
from mapvote.matching.pose_check import POSE_CHECK, Judge
from mapvote.matching.prepare import deskew, motion_at, solid_sample, thin_for_levels

Step = TypeVar("Step")


@record()
@dataclass(frozen=True, slots=True)
class MapFitRule:
    """Numbers of the comparison of a drive's prior with a map."""

    places: int = 6
    """Scans along the drive that are compared."""
    searched: int = 4
    """Scans that are searched for around the prior."""
    turn_deg: float = 0.5
    """Yaw between prior and map that is reported, degrees."""
    tilt_deg: float = 1.5
    """Tilt between prior and map that is reported, degrees."""
    scale: float = 0.01
    """Deviation of the scale that is reported."""
    position_m: float = 0.03
    """Position error of one registration, metres; it weighs positions against rotations."""
    rotation_rad: float = np.radians(0.15)
    """Rotation error of one registration, radians."""
    points_scale: float = 0.002
    """Error of the scale that points show."""
    shift_sigmas: float = 3.0
    """Standard deviations of the prior, as drive.toml states them, that explain a shift of three axes."""
    turn_sigmas: float = 2.5
    """Standard deviations of the prior that explain a turn."""
    unknown_scale: float = 0.01
    """Error of the scale where points do not show it, as on drives that are too short."""
    ranked: int = 3
    """Guesses that are refined."""
    unit_scans: int = 3
    """Scans registered in another scale or unit, to choose one."""
    sensor_m: float = 2.0
    """Usual height of a sensor over the road, metres."""
    around_m: float = 120.0
    """Surroundings of the drive that are used, metres: the range of its scans, and then some."""
    fewest: int = 1000
    """Points of a map around a drive, at least."""
    least_mps: float = 2.0
    """Mean speed of a drive from which on a shift may be one of time, metres per second."""
    straight: float = 0.9
    """Least share of the way driven that lies between its ends, of a drive whose shift may be one of time."""
    beside: float = 0.25
    """Greatest part of such a shift across the road, as a share of that along it."""
    least_rows: int = 2
    """Rows that a shift of time is at least."""
    scale_step: float = 0.01
    """Step of the scales that are tried: a scan fits at no more than one step beside the right one."""
    scale_steps: int = 9
    """Steps up and down that are tried."""
    grid_m: float = 6.0
    """Half a side of the grid of places around a guess that does not fit, metres; its step is 1 m."""
    grid_deg: float = 3.0
    """Turn to either side that each place of the grid is tried with, degrees."""


MAP_FIT_RULE = MapFitRule()


@dataclass(frozen=True, slots=True)
class Place:
    """One scan at its best pose near a guess."""

    index: int
    T_map_lidar: F64
    fit: float
    """Score of :class:`mapvote.matching.pose_check.Verdict`; 0 where the map has too few points."""
    known: float
    """Share of the scan's points near which the map has anything, at the guess."""

    @property
    def fits(self) -> bool:
        """Whether the scan was taken here."""
        return self.fit >= POSE_CHECK.min_fit


def fitting(places: Sequence[Place]) -> list[Place]:
    """Those where a scan was taken."""
    return [p for p in places if p.fits]


@dataclass(frozen=True)
class MapEvidence:
    """Some scans of a drive on a map, as a prior has them."""

    drive: Drive
    T: F64
    """(n, 4, 4) the prior, metres."""
    point_map: PointMap
    progress: Progress | None = None

    @cached_property
    def scans(self) -> dict[int, Scan]:
        """Along the drive, by their numbers; de-skewed by the prior's motion."""
        out = {}
        for i in evenly(0, len(self.drive) - 1, MAP_FIT_RULE.places).tolist():
            scan = self.drive.read_scan(i)
            points = deskew(scan, motion_at(self.drive.stamps_ns, self.T, i))
            out[i] = Scan(scan.stamp_ns, np.ascontiguousarray(points, dtype=np.float32))
        return out

    def scaled(self, i: int, scale: float) -> F64:
        """The prior's pose (4, 4) of a scan in a map that is so many times as large about the middle of the drive."""
        out = self.T[i].copy()
        middle = self.T[:, :3, 3].mean(axis=0)
        out[:3, 3] = middle + scale * (out[:3, 3] - middle)
        return out

    @cached_property
    def around(self) -> MapWindow:
        return MapWindow(self.point_map)

    def places(
        self, guesses: Mapping[int, Sequence[F64]], around: MapWindow | None = None, scale: float = 1.0
    ) -> list[Place]:
        """The scans of ``guesses``, made ``scale`` times as large, each registered to the map around its guesses."""
        judge = Judge(self.drive.sensor.range_sigma_m)
        points = {i: np.asarray(scale * self.scans[i].points, dtype=np.float32) for i in guesses}
        return [_place_of(around or self.around, i, points[i], guesses[i], judge) for i in guesses]

    def told(self, stage: str, steps: Iterable[Step]) -> Iterator[Step]:
        """The steps, each reported as it begins."""
        every = list(steps)
        for k, step in enumerate(every):
            if self.progress is not None:
                self.progress(stage, k + 1, len(every))
            yield step


def check_on_map(
    drive: Drive, T: F64, point_map: PointMap, progress: Progress | None = None
) -> tuple[list[Finding], F64]:
    """(findings, the poses (n, 4, 4) as they lie on the map), by a prior (n, 4, 4) that suits the scans."""
    e = MapEvidence(drive, T, point_map, progress)
    findings = list(_outside(T, point_map))
    road = find_road([scan.points for scan in e.scans.values()])
    depth_m = road.depth_m if road.up == "+z" and road.is_there else None
    places: list[Place] = []
    for i in e.told("registering to the map", e.scans):
        places += e.places({i: _on_ground(T[i], point_map, depth_m)})
    scale, scale_sigma = _scale_by_points(e, places)
    if abs(scale - 1.0) > 0.5 * MAP_FIT_RULE.scale:
        better = e.places({p.index: [p.T_map_lidar, e.scaled(p.index, scale)] for p in places}, scale=scale)
        if sum(p.fit for p in fitting(better)) > 1.2 * sum(p.fit for p in fitting(places)):
            places = better
        else:
            scale_sigma = float("inf")
    if len(fitting(places)) < 0.5 * len(places):
        unit = in_another_unit(e)
        if unit is not None:
            return [unit], T
        better, mirrored = _searched(e)
        if mirrored:
            problem = f"the map is mirrored against the scans: {mirrored} mirrored scans fit it, unmirrored none"
            return [*findings, Finding("error", problem, "negate y of the map's points, or of the scans'")], T
        places = max(places, better, key=lambda one: len(fitting(one)))
    good = fitting(places)
    if len(good) < 2:
        best = max(places, key=lambda p: p.fit)
        problem = (
            f"the drive fits the map nowhere: the best fit is {best.fit:.2f} (scan {best.index}), and scans of the "
            f"mapped street fit above {POSE_CHECK.min_fit}"
        )
        mend = "is it the map of another street, in another scale or tilt, or all changed?"
        return [*findings, Finding("error", problem, mend)], T
    # Places far apart show the scale as well, but no better than the prior's positions are known.
    fit = fit_similarity(
        np.array([T[p.index] for p in good]),
        np.array([p.T_map_lidar for p in good]),
        position_m=float(np.hypot(MAP_FIT_RULE.position_m, drive.prior_sigma_m)),
        rotation_rad=float(np.hypot(MAP_FIT_RULE.rotation_rad, np.radians(drive.prior_sigma_deg))),
        scale=(scale, scale_sigma) if np.isfinite(scale_sigma) else (1.0, MAP_FIT_RULE.unknown_scale),
    )
    mended = fit.applied(T)
    differs = _differs(fit, len(good), drive)
    return [*findings, *_where_not(places, good), differs, *_heights(point_map, mended, drive)], mended


def _scale_by_points(e: MapEvidence, places: Sequence[Place]) -> tuple[float, float]:
    """(how many times as large as the scans the map is, its standard error), by the points of each scan alone.

    Scans made larger and smaller are registered anew; at the right scale many more of their points agree. A sound scan
    shows it to .0005. Where scans contradict each other, (1, inf).
    """
    step = MAP_FIT_RULE.scale_step
    scales = 1.0 + step * np.arange(-MAP_FIT_RULE.scale_steps, MAP_FIT_RULE.scale_steps + 1)
    peaks = []
    for place in e.told("trying other scales", places):
        ndt_map = e.around(place.T_map_lidar[:3, 3])
        fits = []
        for scale in scales:
            clouds = thin_for_levels(np.asarray(scale * e.scans[place.index].points, dtype=np.float32))
            starts = [place.T_map_lidar]
            if not place.fits:  # it may be elsewhere: where the prior has it, in a map so much larger
                starts.append(e.scaled(place.index, scale))
            poses = [ndt_map.refine(clouds, start).T_map_lidar for start in starts]
            fits.append(max(likelihood_at(ndt_map, clouds[-1], T, -1) for T in poses))
        best = int(np.clip(np.argmax(fits), 1, len(fits) - 2))
        peaks.append(scales[best] + step * peak_of(fits[best - 1], fits[best], fits[best + 1]))
    scale = float(np.median(peaks))
    off = np.abs(np.array(peaks) - scale)
    if (off > 0.5 * step).mean() > 0.5:
        return 1.0, float("inf")
    return scale, max(MAP_FIT_RULE.points_scale, 1.4826 * float(np.median(off)) / np.sqrt(len(peaks)))


def _units() -> list[tuple[str, float, str]]:
    """Units that the map's numbers may have instead of metres: (name, metres, mend)."""
    mend = "multiply the map's points by {:.6g}, then import it (a LAS that names its unit is converted by itself)"
    lengths = {"feet": FEET_M, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254, "kilometres": 1000.0}
    converted = "in metres that were converted as if they were feet"
    return [
        *((f"in {name}", metres, mend.format(metres)) for name, metres in lengths.items()),
        (converted, 1.0 / FEET_M, "import it without converting feet"),
    ]


def in_another_unit(e: MapEvidence) -> Finding | None:
    """The unit of the map, if scans fit it once it is converted to metres about its origin, its middle or the road
    below the middle of the drive; None if none does.

    The map's points are made metres, not the scans feet: voxels have the size that suits points in metres.
    """
    sample = list(e.scans)[:: max(1, len(e.scans) // MAP_FIT_RULE.unit_scans)][: MAP_FIT_RULE.unit_scans]
    centres = np.zeros(3), _middle(e.point_map), e.T[:, :3, 3].mean(axis=0) - [0.0, 0.0, MAP_FIT_RULE.sensor_m]
    for name, in_metres, mend in e.told("trying other units", _units()):
        for centre in centres:
            metres = _in_metres(e.point_map, in_metres, centre, e.T)
            if metres is None:
                continue
            around = MapWindow(metres)
            if 2 * len(fitting(e.places({i: [e.T[i]] for i in sample}, around))) > len(sample):
                fits = len(fitting(e.places({i: [e.T[i]] for i in e.scans}, around)))
                problem = f"the map is {name}: made metres, it fits {fits} of {len(e.scans)} scans checked"
                return Finding("error", problem, mend)
    return None


def _middle(point_map: PointMap) -> F64:
    """The mean of its points."""
    sums = [(tile.points_map.sum(axis=0), len(tile.points)) for tile in point_map.tiles.values()]
    return np.asarray(sum(total for total, _ in sums) / max(1, sum(n for _, n in sums)))


def _in_metres(point_map: PointMap, scale: float, centre: F64, T: F64) -> PointMap | None:
    """Its points around the drive, ``scale`` times as large about ``centre``; None if there are hardly any."""
    low = T[:, :2, 3].min(axis=0) - MAP_FIT_RULE.around_m
    high = T[:, :2, 3].max(axis=0) + MAP_FIT_RULE.around_m
    parts = []
    for tile in point_map.tiles.values():
        points = centre + scale * (tile.points_map - centre)
        parts.append(points[((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)])
    points = np.concatenate([np.empty((0, 3)), *parts])
    if len(points) < MAP_FIT_RULE.fewest:
        return None
    lattice = Lattice()
    tiles = {}
    for index, chosen in cut_tiles(points, lattice):
        empty = Tile.empty(lattice.tile(index))
        tiles[index] = empty.but(points=empty.window.from_map(points[chosen]))
    return PointMap(point_map.map_id, lattice, tiles)


def _searched(e: MapEvidence) -> tuple[list[Place], int]:
    """(the places under the difference that suits most of them, how many scans fit mirrored where none fits so)."""
    search = GlobalSearch(e.point_map, NdtSettings(), e.drive.sensor.range_sigma_m)
    chosen = list(e.scans)[:: max(1, len(e.scans) // MAP_FIT_RULE.searched)][: MAP_FIT_RULE.searched]
    best: list[Place] = []
    mirrored = 0
    mirror = np.array([1.0, -1.0, 1.0], dtype=np.float32)
    for i in e.told("searching the map", chosen):
        scan = e.scans[i]
        T_map_lidar = _find(search, scan)
        if T_map_lidar is not None:
            D = T_map_lidar @ inverse(e.T[i])
            best = max(best, e.places({j: [D @ e.T[j]] for j in e.scans}), key=lambda p: len(fitting(p)))
            if len(fitting(best)) > 0.6 * len(e.scans):
                return best, 0
        elif _find(search, Scan(scan.stamp_ns, scan.points * mirror)) is not None:
            mirrored += 1
    return best, mirrored if mirrored >= 2 and len(fitting(best)) < 2 else 0


def _find(search: GlobalSearch, scan: Scan) -> F64 | None:
    try:
        match = search.find(scan)
    except MapvoteError:  # too large to search
        return None
    return None if match is None or match.fit < POSE_CHECK.min_fit else match.T_map_lidar


def _place_of(around: MapWindow, i: int, points: F32, guesses: Sequence[F64], judge: Judge) -> Place:
    """From the guesses themselves, and from the best of a grid of 6 m and 3 deg around them if none of them fits."""
    clouds = thin_for_levels(points)
    few = solid_sample(points, LEVELS[-1].points_m)
    best = Place(i, guesses[0], 0.0, 0.0)
    for guess in guesses:
        ndt_map = around(guess[:3, 3])
        known_share = _known(ndt_map, clouds[0].T.astype(np.float64), guess)
        if known_share < 0.1:
            best = max(best, Place(i, guess, 0.0, known_share), key=lambda p: p.known)
            continue
        starts = [guess]
        for attempt in range(2):
            for start in starts:
                T = ndt_map.refine(clouds, start).T_map_lidar
                best = max(best, Place(i, T, judge.fit(ndt_map, few, T), known_share), key=lambda p: p.fit)
            if best.fits or attempt:
                break
            starts = likeliest(ndt_map, clouds[0], _grid_around(guess), MAP_FIT_RULE.ranked, 500)
    return best


def _grid_around(guess: F64, rule: MapFitRule = MAP_FIT_RULE) -> list[F64]:
    offsets_m = np.arange(-rule.grid_m, rule.grid_m + 0.1, 1.0)
    yaws = np.radians([0.0, -rule.grid_deg, rule.grid_deg])
    beside = [from_xyz_rpy(x, y, 0.0) @ guess for x in offsets_m for y in offsets_m]
    return [T @ from_xyz_rpy(0, 0, 0, yaw=yaw) for T in beside for yaw in yaws]


def _known(ndt_map: NdtMap, points: F64, T: F64) -> float:
    """Share of the points (n, 3) that fall near anything of the map, whatever it is."""
    grid = ndt_map.levels[0]
    placed = points @ T[:3, :3].T + T[:3, 3]
    cells = np.floor(placed / grid.level.voxel_m).astype(np.int64)[:, :2] - grid.window.lowest[:2]
    columns = np.asarray((grid.window.rows >= 0).any(axis=2))
    inside = ((cells >= 0) & (cells < np.array(columns.shape))).all(axis=1)
    return float(columns[cells[inside, 0], cells[inside, 1]].sum() / len(cells))


def peak_of(before: float, at: float, after: float) -> float:
    """Where the parabola through three values one step apart is highest, in steps, at most one."""
    bend = before - 2.0 * at + after
    return float(np.clip(0.5 * (before - after) / bend, -1.0, 1.0)) if bend < 0 else float(np.sign(after - before))


def _outside(T: F64, point_map: PointMap) -> Iterator[Finding]:
    """How much of the drive lies outside the map's tiles, and how far."""
    windows = [point_map.lattice.tile(t) for t in point_map.tiles]
    side = TILE_CELLS * CELL_SIZE
    low = np.array([[w.x0, w.y0] for w in windows])
    outside_m = np.array(
        [np.linalg.norm(np.maximum(np.maximum(low - p, p - low - side), 0), axis=1).min() for p in T[:, :2, 3]]
    )
    share = float((outside_m == 0).mean())
    if share == 0:
        a = low.min(axis=0)
        b = low.max(axis=0) + side
        problem = (
            f"drive and map do not overlap: the drive starts at ({T[0, 0, 3]:.0f}, {T[0, 1, 3]:.0f}), "
            f"the map covers ({a[0]:.0f}, {a[1]:.0f}) to ({b[0]:.0f}, {b[1]:.0f}), {outside_m.min():.0f} m away"
        )
        yield Finding("error", problem, "give prior and map the same frame and origin (for oxts: origin in drive.toml)")
    elif share < 0.95:
        yield Finding("note", f"{1 - share:.0%} of the drive lies outside the map", "there it cannot vote")


def _on_ground(T: F64, point_map: PointMap, depth_m: float | None) -> list[F64]:
    """The prior's pose; and that pose over the map's ground, where the prior's height is far off it."""
    height = float(T[2, 3] - point_map.ground_under(T[None, :3, 3])[0])
    if depth_m is None or not np.isfinite(height) or abs(height - depth_m) < 1.0:
        return [T]
    return [T, from_xyz_rpy(0, 0, depth_m - height) @ T]


def _where_not(places: Sequence[Place], good: Sequence[Place]) -> Iterator[Finding]:
    empty = [p for p in places if p.known < 0.3]
    if empty:
        scans = ", ".join(str(p.index) for p in empty)
        grave: Severity = "error" if len(empty) >= 0.4 * len(places) else "warning"
        problem = f"the map holds nothing around {len(empty)} of {len(places)} places checked (scans {scans})"
        yield Finding(grave, problem, "part of the map is missing, or the drive leaves it: there it cannot vote")
    elif len(good) < 0.7 * len(places):
        problem = f"scans fit the map at {len(good)} of {len(places)} places only"
        yield Finding("warning", problem, "elsewhere the street has changed, or the map is bent")


def _differs(d: Similarity, places: int, drive: Drive) -> Finding:
    """The difference between prior and map, with its error."""
    off_m = float(np.linalg.norm(d.offset_m))
    sigma_m = drive.prior_sigma_m
    sigma_deg = drive.prior_sigma_deg
    yaw_deg = float(np.degrees(np.arctan2(d.rotation[1, 0], d.rotation[0, 0])))
    tilt_deg = float(np.degrees(np.arccos(np.clip(d.rotation[2, 2], -1.0, 1.0))))
    x, y, z = d.offset_m
    shift = f"shifted by {off_m:.2f} m (x {x:+.2f}, y {y:+.2f}, z {z:+.2f}; +-{d.sigma_m:.2f})"
    yaw = f"turned about z by {yaw_deg:.2f} deg (+-{d.yaw_sigma_deg:.2f})"
    tilt = f"tilted by {tilt_deg:.2f} deg (+-{d.tilt_sigma_deg:.2f})"
    scale = f"scaled by {d.scale:.4f} (+-{d.scale_sigma:.4f})"
    # deviation; least reported; its standard error; the part that the prior's stated errors explain; least error
    rows = [
        (shift, off_m, 0.15, 0.75 * d.sigma_m, MAP_FIT_RULE.shift_sigmas * sigma_m, max(0.3, 4.0 * sigma_m)),
        (
            yaw,
            abs(yaw_deg),
            MAP_FIT_RULE.turn_deg,
            d.yaw_sigma_deg,
            MAP_FIT_RULE.turn_sigmas * sigma_deg,
            2.0 * MAP_FIT_RULE.turn_deg,
        ),
        (
            tilt,
            tilt_deg,
            MAP_FIT_RULE.tilt_deg,
            d.tilt_sigma_deg,
            MAP_FIT_RULE.turn_sigmas * sigma_deg,
            2.0 * MAP_FIT_RULE.tilt_deg,
        ),
        (scale, abs(d.scale - 1.0), MAP_FIT_RULE.scale, d.scale_sigma, 0.0, 0.0),
    ]
    surely = [(words, by, error) for words, by, least, s, within, error in rows if by > max(least, 4.0 * s, within)]
    if not surely:
        problem = f"prior and map agree to {off_m:.2f} m and {abs(yaw_deg):.2f} deg ({places} places)"
        small = ", ".join(words for words, by, least, *_ in rows if by > least)
        more = f"; the map is {small}: no more than prior_sigma_m and prior_sigma_deg explain" if small else ""
        return Finding("note", problem + more)
    parts = ", ".join(words for words, _, _ in surely)
    problem = f"the map is {parts} against the prior, at the middle of the drive ({places} places)"
    along = _as_time(d, drive) if any(words is shift for words, _, _ in surely) else None
    if along is not None:
        problem += f"; that lies along the road: or the prior's rows are {abs(along.late_s):.1f} s {along.word}"
    mend = "if the map is right, move the prior by that (--mount for a constant one, CRS and origin for the rest)"
    if any(words is scale for words, _, _ in surely):
        mend = f"if the map is right, multiply their points by {d.scale:.4f}; else the map's by {1.0 / d.scale:.4f}"
    if along is not None:
        mend += f"; or shift its rows by {along.scans} scans"
    return Finding("error" if any(by > error for _, by, error in surely) else "warning", problem, mend)


class _Along(NamedTuple):
    """A shift along the road, as the time in which the vehicle drives it."""

    late_s: float
    """By how much the prior is late; negative: early."""
    scans: int
    """How many rows later the rows of the scans stand."""

    @property
    def word(self) -> str:
        return "late" if self.late_s > 0.0 else "early"


def _as_time(d: Similarity, drive: Drive, rules: MapFitRule = MAP_FIT_RULE) -> _Along | None:
    """The shift of a prior that drives straight ahead, as a time; None if it does not lie along its way."""
    T = drive.T_map_lidar_prior
    stamps_ns = drive.stamps_ns
    if T is None or len(T) < 3:
        return None
    way = T[-1, :2, 3] - T[0, :2, 3]
    way_m = float(np.linalg.norm(way))
    driven_s = 1e-9 * float(stamps_ns[-1] - stamps_ns[0])
    driven_m = float(np.linalg.norm(np.diff(T[:, :2, 3], axis=0), axis=1).sum())
    ahead_m = float(d.offset_m[:2] @ way) / max(way_m, 1e-6)
    beside_m = abs(float(d.offset_m[0] * way[1] - d.offset_m[1] * way[0])) / max(way_m, 1e-6)
    slow = way_m < rules.least_mps * driven_s
    if slow or way_m < rules.straight * driven_m or beside_m > rules.beside * abs(ahead_m):
        return None
    late_s = ahead_m / (way_m / driven_s)
    rows = round(-late_s / (driven_s / (len(T) - 1)))
    return _Along(late_s, rows) if abs(rows) >= rules.least_rows else None


def _heights(point_map: PointMap, T: F64, drive: Drive) -> Iterator[Finding]:
    """Height of the sensor over the map's ground, once the difference is taken out."""
    height = check_heights(point_map, T[:, :3, 3])
    if not np.isfinite(height.median_m):
        return
    if not -0.5 < height.median_m < 6.0:
        problem = f"the sensor is {height.median_m:.1f} m above the map's ground"
        yield Finding("error", problem, "the map's ground lies wrong under this drive: build it anew")
    elif abs(height.worst_off_m) > height.level_m + 3.0 * drive.prior_sigma_m:
        mend = "if the prior's heights are sound, so much is wrong with the map's ground: build it anew from its drives"
        yield Finding("warning", f"by the prior, {height.complaint}", mend)
    else:
        yield Finding("note", f"by the prior: {height}")


def check_cloud_on_map(point_map: PointMap, cloud: PointMap) -> list[Finding]:
    """Findings on a map or a session's ``cloud`` against another map: its place there, and the part that no rigid
    motion aligns, as `mapvote diff` reports them."""
    try:
        registered = register_maps(point_map, cloud)
    except MapvoteError as error:
        return [Finding("error", f"against the map: {error}")]
    place, agreement = registered.told()[:2]
    mend = "mapvote diff --unbend moves it piece by piece; mapvote vote leaves it out"
    bent = [Finding("warning", f"bent: {part.told()}", mend) for part in registered.bent]
    return [*bent, Finding("note", f"{place}; {agreement}. A is the map, B is this")]
