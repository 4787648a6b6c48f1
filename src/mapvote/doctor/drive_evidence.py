"""Evidence from comparing the scans of a drive: the road below, the scatter of ranges, the motion of the sensor.

Nothing of the prior is used, not even as a guess: whatever is wrong with it can be measured against this. A run is some
twenty metres of consecutive scans, each registered to those before it: long enough for a few centimetres of error to be
a fraction of a per cent. Each thing is measured once, when a check first asks for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise

import numpy as np
import scipy

from mapvote.core.geometry import exp, from_xyz_rpy, inverse, log, transform, velocity_changes
from mapvote.core.record import record
from mapvote.core.types import F32, F64, I64, Bool, Drive, Registration, Scan
from mapvote.doctor import Finding, Progress
from mapvote.doctor.scans import Looking, Looks
from mapvote.formats.drives.options import source_of_times
from mapvote.matching.matcher import likeliest, likelihood_at
from mapvote.matching.ndt_map import NDT_WINDOW, NdtMap
from mapvote.matching.prepare import thin_for_levels

_UPS = {sign + axis: s * np.eye(3)[k] for k, axis in enumerate("xyz") for sign, s in (("+", 1.0), ("-", -1.0))}
_TURNED_OVER = np.diag([1.0, -1.0, -1.0]).astype(np.float32)


@record()
@dataclass(frozen=True, slots=True)
class RoadPlane:
    """Numbers of the search for the road in the points below the sensor."""

    near_m: float = 15.0
    """Distance from the sensor up to which points are used, metres."""
    road_share: float = 0.1
    """Share of the near points in a plane below which it is no road."""
    unsteady_m: float = 0.3
    """Scatter of the depth from scan to scan from which the plane is no road, metres."""
    thick_m: float = 0.12
    """Distance of a point from the plane up to which it lies in it, metres."""
    depth_m: tuple[float, float] = (0.2, 12.0)
    """Least and largest depth of a road below the sensor, metres."""
    tries: int = 300
    """Planes through three random points that are tried."""
    scans: int = 7
    """Scans in which the road is searched."""
    highest_m: float = 4.5
    """Largest height of a sensor over the road, metres."""


ROAD_PLANE = RoadPlane()


@record()
@dataclass(frozen=True, slots=True)
class RangeScatter:
    """Numbers by which the scatter of ranges is measured."""

    rays: int = 500
    """Rays of a scan that are compared."""
    beside: int = 8
    """Neighbouring rays of each."""
    quarter: float = 0.3186
    """First quartile of a normal distribution's absolute values, standard deviations."""
    nearest_m: float = 3.0
    """Least range that is compared, metres."""
    farthest_m: float = 40.0
    """Largest range that is compared, metres."""
    rough_m: float = 0.12
    """Scatter of points about the road beyond which it is rough, metres."""
    scatter_m: float = 0.25
    """Largest scatter of a sound sensor's ranges, metres: they show 0.02 to 0.04 m."""


RANGE_SCATTER = RangeScatter()


@record()
@dataclass(frozen=True, slots=True)
class RunRule:
    """Numbers of the runs and chains of consecutive scans that are registered to each other."""

    half_window_m: float = 60.0
    """Half the side of the NDT map of a run, metres: its scans reach 50 m."""
    runs: int = 8
    """Runs that are spread over a drive."""
    scans: int = 11
    """Scans of each run."""
    across: int = 2
    """Runs across the places where scans differ most."""
    chain_scans: int = 150
    """Scans of a chain: some 300 m."""
    lost_scans: int = 4
    """Scans up to which a chain was lost at its first step."""
    step_m: float = 2.5
    """Motion between two scans of a run, metres: scans between them are left out."""
    most_step: int = 5
    """Scans to the next one of a run, at most."""
    speeds_m: tuple[float, ...] = (0.0, 0.8, 1.6, 2.6, 3.6, 4.6)
    """Motions from scan to scan that are tried at the start of a run, metres."""
    reach_m: float = 50.0
    """Range up to which points are used, metres."""
    good_fit: float = 0.7
    """Share of inliers from which the motion of the last scans is accepted as the guess."""
    stands_m: float = 0.4
    """Distance from the road beyond which a point stands on it, metres."""
    refined: int = 4
    """Guesses that are refined."""
    least_fit: float = 0.55
    """Share of inliers of a registered scan, at least. Sound scans, a step apart, agree in .75 to .95 of their points;
    scans of different places in .2 to .5."""
    sure_m: float = 0.1
    """Median difference between the steps of a run that is registered forwards and backwards, up to which a sensor
    without rings shows its motion, metres. Sparse scans and cones differ by up to .05 m, a rosette's by .2 m to 5 m."""
    brakes_mps2: float = 8.0
    """Largest acceleration of a vehicle, metres per second squared."""


RUN_RULE = RunRule()


@dataclass(frozen=True, slots=True)
class Road:
    """The plane that most of the low points near the sensor lie in."""

    up: str
    """Which axis of the points points up: "+z" as it should."""
    depth_m: float
    """Normal of the road below the sensor."""
    share: float
    """Share of the points within 15 m that lie within 0.12 m of the plane; below 0.1 it may be no road."""
    normal: F64
    """(3,) of the road, upwards, in the frame of the points."""
    scatter_m: float
    """By how much points near the plane leave it, robust standard deviation."""
    unsteady_m: float = 0.0
    """By how much the depth differs from scan to scan, robust standard deviation."""

    @property
    def is_there(self) -> bool:
        """Whether it can be a road: some points lie in it, and as deep in every scan."""
        return self.share >= ROAD_PLANE.road_share and self.unsteady_m < ROAD_PLANE.unsteady_m

    @property
    def tilt_deg(self) -> float:
        """Rotation of the sensor against the road."""
        return float(np.degrees(np.arccos(np.clip(self.normal @ _UPS[self.up], -1.0, 1.0))))


@dataclass(frozen=True, slots=True)
class Run:
    """Scans of a few seconds, and where the sensor was in the frame of the first."""

    indices: I64
    """(m,) scans of the drive, ascending."""
    T_first_lidar: F64
    """(m, 4, 4)."""
    fit: F64
    """(m,) share of each scan's points that agree with the scans before it; 1 for the first."""

    @property
    def length_m(self) -> float:
        return float(np.linalg.norm(np.diff(self.T_first_lidar[:, :3, 3], axis=0), axis=1).sum())

    @property
    def usual_fit(self) -> float:
        return float(np.median(self.fit[1:]))

    def unbroken(self) -> Run:
        """Up to the first scan that does not fit those before it."""
        bad = np.flatnonzero(self.fit < RUN_RULE.least_fit)
        end = int(bad[0]) if len(bad) else len(self.fit)
        return Run(self.indices[:end], self.T_first_lidar[:end], self.fit[:end])


@dataclass(frozen=True, eq=False)
class DriveEvidence:
    """The evidence for the checks of a drive: scans, road, registrations. Each is computed once, at first use."""

    drive: Drive
    progress: Progress | None = None

    @cached_property
    def looks(self) -> Looks:
        progress = None if self.progress is None else partial(self.progress, "looking at scans")
        return Looking(self.drive).look(range(len(self.drive)), progress)

    @property
    def T(self) -> F64 | None:
        """(n, 4, 4) the prior as it was read."""
        return self.drive.T_map_lidar_prior

    @property
    def readable(self) -> I64:
        """(m,) scans that could be read."""
        return self.looks["index"]

    @cached_property
    def sample(self) -> I64:
        """A few of the readable scans, spread evenly."""
        chosen = np.linspace(0, len(self.readable) - 1, min(len(self.readable), ROAD_PLANE.scans)).astype(np.int64)
        return self.readable[chosen]

    def points(self, i: int) -> F32:
        """(p, 3) of scan i, turned over where the sensor is upside down: other faults show only then."""
        points = self.drive.read_scan(int(i)).points
        return points @ _TURNED_OVER if self.road.up == "-z" else points

    @cached_property
    def _scans(self) -> list[Scan]:
        """Scans of :attr:`sample`, as they are read."""
        return [self.drive.read_scan(int(i)) for i in self.sample]

    @cached_property
    def road(self) -> Road:
        """Times as the points are read."""
        return find_road([scan.points for scan in self._scans])

    @cached_property
    def road_below(self) -> Road:
        """Points turned over where the sensor is upside down."""
        return find_road([scan.points @ _TURNED_OVER for scan in self._scans]) if self.road.up == "-z" else self.road

    @cached_property
    def scatter_m(self) -> float:
        """Scatter of the first LiDAR's ranges: rays of another one begin elsewhere, and end on other objects."""
        return float(np.median([_range_scatter_m(scan.by_lidar()[0][1].points) for scan in self._scans]))

    @property
    def can_be_registered(self) -> bool:
        """Else whatever seems wrong with the motion may be its consequence."""
        return self._is_sound and self._steps_differ_m <= RUN_RULE.sure_m

    @property
    def _is_sound(self) -> bool:
        return len(self.readable) > 2 and 1.5 <= self.looks.median_m <= 150.0 and self.road_below.up == "+z"

    @cached_property
    def _steps_differ_m(self) -> float:
        """Error of the steps from scan to scan, metres, median of the runs; 0 for a sensor with rings, whose scans show
        it by how well they fit."""
        if self.drive.sensor.rings:
            return 0.0
        return float(np.median([self._steps_differ_of(run) for run in self.every_run]))

    @cached_property
    def every_run(self) -> list[Run]:
        """Runs spread over the drive, then those across the places where scans differ most, which show whether the
        scans are in order. Chosen for being odd, the latter are no measure of the prior."""
        n = len(self.readable)
        across = np.argsort(self.looks.leaps, kind="stable")[-RUN_RULE.across :] - RUN_RULE.scans // 2
        odd = np.unique(np.clip(across, 0, max(0, n - RUN_RULE.scans)))
        starts = dict.fromkeys([*self._starts.tolist(), *odd.tolist()])
        runs = []
        for k, start in enumerate(starts):
            runs.append(self._follow(start))
            if self.progress is not None:
                self.progress("registering scans", k + 1, len(starts))
        return runs

    @cached_property
    def runs(self) -> list[Run]:
        """Runs spread over the drive."""
        return self.every_run[: len(self._starts)]

    @cached_property
    def _starts(self) -> I64:
        """First scans of runs spread evenly over the drive, half of them where the prior turns most."""
        n = len(self.readable)
        span = RUN_RULE.scans + 2 * RUN_RULE.most_step
        if n <= span:
            return np.zeros(1, dtype=np.int64)
        even = np.linspace(0, n - span, min(RUN_RULE.runs, max(1, n // RUN_RULE.scans))).astype(np.int64)
        if self.T is None or len(even) < RUN_RULE.runs:
            return np.unique(even)
        R = self.T[self.readable, :3, :3]
        candidates = np.arange(0, n - span, max(1, span // 2))
        turned = [-np.trace(R[i].T @ R[i + span]) for i in candidates]
        most = candidates[np.argsort(np.array(turned), kind="stable")[::-1][: RUN_RULE.runs // 2]]
        return np.unique(np.concatenate([most, even[::2]]))

    @cached_property
    def chain(self) -> Run:
        """A long run, from the first scans that it can begin with: its first step tries every way and speed, and may
        find a wrong one; the next scan then does not fit, though nothing is wrong with the drive."""
        run = self._follow(0, RUN_RULE.chain_scans)
        for start in (RUN_RULE.lost_scans, 2 * RUN_RULE.lost_scans):
            fitting = len(run.unbroken().indices)
            if fitting > RUN_RULE.lost_scans or fitting == len(run.indices):
                break
            run = self._follow(start, RUN_RULE.chain_scans)
        return run

    @cached_property
    def leaps(self) -> list[Finding]:
        """Faults of the scans' own motion; while there is any, a prior cannot be compared with it."""
        if self.can_be_registered:
            return list(_check_motion(self.every_run, self.drive))
        if self._is_sound:
            problem = (
                f"the scans of this sensor do not show its motion: registered forwards and backwards, their steps "
                f"differ by {self._steps_differ_m:.2f} m"
            )
            return [Finding("note", problem, "the order of its scans and its prior are checked on a map alone")]
        return []

    def _follow(self, start: int, scans: int = RUN_RULE.scans) -> Run:
        """The run of at most ``scans`` scans that begins at readable scan ``start``."""
        registering = _Registering(self, start)
        step = 1
        while len(registering.numbers) < scans and registering.numbers[-1] + step < len(self.readable):
            registering.add(registering.numbers[-1] + step)
            step = registering.next_step
        return registering.run()

    def _steps_differ_of(self, run: Run) -> float:
        """By how much the steps of a run differ if it is registered from its last scan to its first one, median: the
        error of the registration, which no fit shows. A pattern that moves with the sensor draws every scan towards
        the one before it."""
        numbers = np.searchsorted(self.readable, run.indices)
        registering = _Registering(self, int(numbers[-1]))
        for number in numbers[-2::-1]:
            registering.add(int(number))
        back = registering.run().T_first_lidar[::-1]
        steps_m = [
            np.array([(inverse(a) @ b)[:3, 3] for a, b in pairwise(T_first_lidar)])
            for T_first_lidar in (run.T_first_lidar, back)
        ]
        return float(np.median(np.linalg.norm(steps_m[0] - steps_m[1], axis=1)))


class _Registering:
    """Scans of a run, each registered to those before it."""

    def __init__(self, evidence: DriveEvidence, first: int) -> None:
        self._evidence = evidence
        self._map = NdtMap(np.zeros(3), numbers=replace(NDT_WINDOW, half_window_m=RUN_RULE.half_window_m))
        self._map.enter(_near(evidence.points(evidence.readable[first])))
        self.numbers = [first]
        """Places among the readable scans, up or down."""
        self._poses = [np.eye(4)]
        self._fits = [1.0]

    def add(self, number: int) -> None:
        """Register the readable scan ``number``."""
        road = self._evidence.road_below
        clouds = thin_for_levels(_near(self._evidence.points(self._evidence.readable[number])))
        registration = _registered(self._map, clouds, _guesses(self.numbers, self._poses, number, _UPS[road.up]), road)
        self.numbers.append(number)
        self._poses.append(registration.T_map_lidar)
        self._fits.append(registration.inlier_share)
        position = registration.T_map_lidar[:3, 3]
        if not self._map.is_central(position):
            self._map.recentre(position)
        self._map.enter(transform(registration.T_map_lidar, clouds[-1].T))

    @property
    def next_step(self) -> int:
        """After how many scans the vehicle has moved on far enough."""
        if len(self.numbers) < 3:
            return 1
        moved_m = float(np.linalg.norm((inverse(self._poses[-2]) @ self._poses[-1])[:3, 3]))
        a_scan_m = moved_m / (self.numbers[-1] - self.numbers[-2])
        return int(np.clip(RUN_RULE.step_m / max(a_scan_m, 0.01), 1, RUN_RULE.most_step))

    def run(self) -> Run:
        """The scans so far."""
        return Run(self._evidence.readable[self.numbers], np.array(self._poses), np.array(self._fits))


def find_road(scans: Sequence[F32]) -> Road:
    """The road that several scans show. Another axis than z must hold half as much again: a wall is no road."""
    near = []
    for scan in scans:
        away = np.linalg.norm(scan, axis=1)
        points = scan[(away < ROAD_PLANE.near_m) & (away > 2.0)].astype(np.float64)
        near.append(points[:: max(1, len(points) // 3000)])
    planes = [_best_planes(points, np.random.default_rng(k)) for k, points in enumerate(near)]
    share = {name: float(np.mean([one[name][0] for one in planes])) for name in _UPS}
    best = max(share, key=lambda name: share[name])
    if share[best] < max(1.5 * share["+z"], ROAD_PLANE.road_share):
        best = "+z"
    fitted = [_fitted(points, *one[best][1:]) for points, one in zip(near, planes, strict=True)]
    normal = np.median([normal for normal, _, _ in fitted], axis=0)
    depth_m, scatter_m = (float(np.median([one[k] for one in fitted])) for k in (1, 2))
    unsteady_m = 1.4826 * float(np.median([abs(depth - depth_m) for _, depth, _ in fitted]))
    return Road(best, depth_m, share[best], normal / np.linalg.norm(normal), scatter_m, unsteady_m)


def _best_planes(points: F64, rng: np.random.Generator) -> dict[str, tuple[float, F64, float]]:
    """For each axis that may point up (share, normal, depth) of the plane below the sensor with most of the points.

    Planes through three points each (Fischler and Bolles, Random Sample Consensus, 1981).
    """
    out: dict[str, tuple[float, F64, float]] = {name: (0.0, up, 0.0) for name, up in _UPS.items()}
    if len(points) < 30:
        return out
    a, b, c = (points[rng.integers(0, len(points), ROAD_PLANE.tries)] for _ in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 1e-3] / length[length > 1e-3, None]
    depth = -np.einsum("ij,ij->i", normals, a[length > 1e-3])
    normals = normals * np.sign(depth)[:, None]
    depth = np.abs(depth)  # towards the sensor
    for normal, d in zip(normals, depth, strict=True):
        axis = int(np.argmax(np.abs(normal)))
        if not ROAD_PLANE.depth_m[0] <= d <= ROAD_PLANE.depth_m[1] or abs(normal[axis]) < np.cos(np.radians(35.0)):
            continue
        share = float((np.abs(points @ normal + d) < ROAD_PLANE.thick_m).mean())
        name = ("+" if normal[axis] > 0 else "-") + "xyz"[axis]
        if share > out[name][0]:
            out[name] = (share, normal, float(d))
    return out


def _fitted(points: F64, normal: F64, depth_m: float) -> tuple[F64, float, float]:
    """(normal, depth, robust scatter) of the plane fitted to the points near a first guess of it, twice."""
    scatter = 0.0
    for _ in range(2):
        p = points[np.abs(points @ normal + depth_m) < 3.0 * ROAD_PLANE.thick_m]
        if len(p) < 50:
            return normal, depth_m, 0.0
        centre = p.mean(axis=0)
        fitted = np.linalg.svd(p - centre, full_matrices=False)[2][2]
        normal = fitted if fitted @ normal > 0 else -fitted
        depth_m = -float(normal @ centre)
        scatter = 1.4826 * float(np.median(np.abs((p - centre) @ normal)))
    return normal, depth_m, scatter


def _range_scatter_m(points: F32) -> float:
    """Standard deviation of a range from the surface that the rays beside it show, metres; 0 for a scan of few points.

    On a plane the inverse range is linear in the direction: it is fitted to the eight nearest directions. Edges and
    leaves scatter without being wrong, so the better quarter of the rays is taken for all.
    """
    length = np.linalg.norm(points, axis=1).astype(np.float64)
    inside = (length > RANGE_SCATTER.nearest_m) & (length < RANGE_SCATTER.farthest_m)
    if inside.sum() < 20 * RANGE_SCATTER.beside:
        return 0.0
    length, direction = length[inside], points[inside] / length[inside, None]
    chosen = np.linspace(0, len(length) - 1, RANGE_SCATTER.rays).astype(np.int64)
    beside = scipy.spatial.cKDTree(direction).query(direction[chosen], k=RANGE_SCATTER.beside + 1)[1][:, 1:]
    plane = np.linalg.pinv(direction[beside]) @ (1.0 / length[beside])[:, :, None]
    inverse_range = (direction[chosen][:, None, :] @ plane)[:, 0, 0]
    off = np.abs(1.0 / np.maximum(inverse_range, 1e-3) - length[chosen])
    return float(np.quantile(off, 0.25)) / RANGE_SCATTER.quarter


def _near(points: F32) -> F32:
    squared = np.einsum("ij,ij->i", points, points)
    middle = np.median(points, axis=0) if np.median(squared) > RUN_RULE.reach_m**2 else np.zeros(3, dtype=np.float32)
    offset = points - middle
    near: F32 = points[np.einsum("ij,ij->i", offset, offset) < RUN_RULE.reach_m**2]
    return near


def _registered(ndt_map: NdtMap, clouds: list[F32], guesses: list[F64], road: Road) -> Registration:
    """From the first guess, if that fits well; else the best of it and the likeliest of all of them.

    Only objects on the road distinguish guesses: the sensor's rings on it fit best where nothing has moved.
    """
    registration = ndt_map.refine(clouds, guesses[0])
    if len(guesses) == 2 and registration.inlier_share >= RUN_RULE.good_fit:
        return registration
    stands = [np.abs(road.normal @ cloud + road.depth_m) > RUN_RULE.stands_m for cloud in clouds]
    standing = [np.ascontiguousarray(cloud[:, high]) for cloud, high in zip(clouds, stands, strict=True)]
    tried = [
        registration,
        *(ndt_map.refine(clouds, guess) for guess in likeliest(ndt_map, standing[0], guesses, RUN_RULE.refined, 800)),
    ]
    return max(tried, key=lambda one: likelihood_at(ndt_map, standing[-1], one.T_map_lidar, -1))


def _guesses(indices: list[int], poses: list[F64], i: int, up: F64) -> list[F64]:
    """Guesses by the motion of the last scans; at the start of a run, every direction and speed that a vehicle may
    have."""
    last = poses[-1]
    if len(poses) > 1:
        a_scan = log(inverse(poses[-2]) @ last) / (indices[-1] - indices[-2])
        return [last @ exp((i - indices[-1]) * a_scan), last]
    across = np.linalg.svd(up[None, :])[2][1:]
    angles = np.arange(16) * (np.pi / 8.0)
    ways = np.cos(angles)[:, None] * across[0] + np.sin(angles)[:, None] * across[1]
    return [from_xyz_rpy(*(speed * way)) for speed in RUN_RULE.speeds_m for way in ways]


def check_ranges(e: DriveEvidence) -> Iterator[Finding]:
    """Do ranges scatter more than a sound sensor's?"""
    if len(e.readable) > 2 and e.scatter_m > RANGE_SCATTER.scatter_m:
        problem = f"ranges scatter by {e.scatter_m:.2f} m against those of the rays beside them"
        problem += " (sound sensors: 0.01 to 0.04 m)"
        mend = "is the sensor calibrated, and does each point carry its own range? Such scans blur the map"
        yield Finding("error" if e.scatter_m > 2.0 * RANGE_SCATTER.scatter_m else "warning", problem, mend)


def check_road(e: DriveEvidence) -> Iterator[Finding]:
    """Does the road lie below the sensor, as deep as a vehicle is high, and level by the prior?"""
    if len(e.readable) <= 2:
        return
    road = e.road
    T = e.T
    if road.up == "-z":
        problem = f"the sensor is upside down: the road lies {road.depth_m:.1f} m above it (z points down)"
        mend = "negate y and z of every point (or only z, if right and left are right already)"
        yield Finding("error", problem, mend)
        return
    if road.up != "+z":
        problem = f"the points' axis {road.up} points up (the road lies {road.depth_m:.1f} m along its opposite), not z"
        mend = "turn the points to x forward, y left, z up (camera axes are x right, y down, z forward)"
        yield Finding("error", problem, mend)
        return
    if not road.is_there or (road.scatter_m > RANGE_SCATTER.rough_m and e.scatter_m <= RANGE_SCATTER.scatter_m):
        problem = f"no road lies below the sensor (the fullest layer holds {road.share:.0%} of the near points"
        problem += f", {road.scatter_m:.2f} m thick, its depth +-{road.unsteady_m:.2f} m from scan to scan)"
        yield Finding("warning", problem, "are the lower beams missing, the points cut, or z measured from elsewhere?")
        return
    yield Finding("note", f"by the scans themselves the sensor stands {road.depth_m:.1f} m over the road")
    if road.depth_m < 0.5:
        problem = f"the road lies only {road.depth_m:.1f} m below the points' origin"
        yield Finding("warning", problem, "are the points in the vehicle's frame? Give them in the sensor's")
    if road.depth_m > ROAD_PLANE.highest_m:
        problem = f"the road lies {road.depth_m:.1f} m below the sensor, as under no vehicle: the scans are too large"
        mend = (
            f"multiply their points by 0.3048 if they are feet (the road then lies {0.3048 * road.depth_m:.1f} m below)"
        )
        yield Finding("warning", problem, mend)
    if T is None:
        return
    normal = np.mean([T[i, :3, :3] @ road.normal for i in e.sample], axis=0)
    tilt_deg = float(np.degrees(np.arccos(np.clip(normal[2] / np.linalg.norm(normal), -1.0, 1.0))))
    if tilt_deg > 4.0:
        pitch = np.degrees(np.arcsin(-road.normal[0]))
        roll = np.degrees(np.arcsin(road.normal[1]))
        problem = f"by prior and scans the road is tilted by {tilt_deg:.1f} deg"
        mend = f"turn the points by {roll:.1f} deg about x and {pitch:.1f} deg about y, which levels the road, "
        mend += "or put the sensor's tilt into the prior's rotations; ignore this on a hill"
        yield Finding("error" if tilt_deg > 8.0 else "warning", problem, mend)


def _check_motion(runs: Sequence[Run], drive: Drive) -> Iterator[Finding]:
    """Do consecutive scans fit each other, and follow each other as a vehicle moves?"""
    stamps_ns = drive.stamps_ns
    times = source_of_times(drive.path)
    broken = [run for run in runs if run.usual_fit < RUN_RULE.least_fit]
    leaps = np.concatenate([~_agree_with_time(run, stamps_ns) for run in runs])
    speed = [run.length_m / (1e-9 * float(np.diff(stamps_ns[run.indices[[0, -1]]])[0])) for run in runs]
    mend = f"are the scans in order of time ({times}), of one drive, and whole?"
    if len(broken) > 0.5 * len(runs):
        fit = float(np.median([run.usual_fit for run in runs]))
        problem = f"scans do not fit those before them: {fit:.0%} of the points agree (sound drives: 75 to 95 %)"
    elif len(leaps) and leaps.mean() > 0.25:
        problem = (
            f"the scans leap: {leaps.mean():.0%} of the steps need an acceleration that no vehicle has. They are out "
            "of order, or their times are wrong"
        )
    elif np.median(speed) > 70.0:
        problem = f"by scans and times the vehicle drives at {np.median(speed):.0f} m/s"
        mend = "check the times (seconds), and that the points are metres"
    elif broken:
        first, last = broken[0].indices[[0, -1]]
        problem = f"scans {first} to {last} do not fit each other ({len(broken)} of {len(runs)} places checked)"
    else:
        return
    yield Finding("error", problem, mend)


def _agree_with_time(run: Run, stamps_ns: I64) -> Bool:
    """(m - 2,) whether the steps of a run follow each other as a vehicle can: no leap of its speed."""
    change_mps, seconds = velocity_changes(run.T_first_lidar[:, :3, 3], stamps_ns[run.indices])
    out: Bool = change_mps < 1.0 + RUN_RULE.brakes_mps2 * seconds
    return out
