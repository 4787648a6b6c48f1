"""A real court that changed: one reference cloud, three later sessions, three changes that all of them agree on.

There are no scans: they are cast from each session's cloud along a way through the court, as a sensor of 32 beams would
have taken them. A cloud does not know its rays, so a cast ray may cross what the session never measured: a place that
it did not reach, or a crown between whose points there is room. A ray is kept only where the session surveyed all cells
on its way (:func:`_measured_as_far`) and where it passes nothing that stands (:func:`_nearest_beside`). Only the boxes
of the agreed changes are known; any other decided object is compared with what some session's cloud shows by geometry
alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from mapvote.codec.ballot import Ballot
from mapvote.compare.cloud_changes import CLOUD_COMPARISON, CloudChange, Kind, planes_of
from mapvote.compare.session_votes import vote_of_session
from mapvote.config import Settings, choose_case
from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.point_map import PointMap, all_points
from mapvote.core.record import record
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F32, F64, I64, NO_VOTE, U8, Bool, CellState, Drive, MapvoteError, Scan
from mapvote.formats import read_map
from mapvote.fusion.fuse import states_over, update_map
from mapvote.vehicle import vote_drive
from mapvote_lab.evaluation.cases import Case, Progress
from mapvote_lab.evaluation.scores import cells_with, map_obstacles, pieces
from mapvote_lab.evaluation.tables import Sheet

SESSIONS = ("robot1", "robot2", "robot3")
CHANGES: dict[str, tuple[Kind, tuple[float, float, float, float]]] = {
    "car": ("gone", (-4.7, -3.1, -2.6, 2.3)),
    "structure": ("new", (16.3, -31.3, 27.1, -24.7)),
    "thing": ("new", (-6.2, 10.7, -4.4, 13.1)),
}
"""Changes that all sessions agree on: x0, y0, x1, y1 in the reference's metres."""


@record()
@dataclass(frozen=True, slots=True)
class CourtRule:
    """How scans are cast from the court's clouds, and how the decided changes are judged."""

    way: tuple[tuple[float, float], ...] = (
        (2, 44), (2, 20), (2, 2), (10, -6), (14, -22), (22, -20), (20, 0), (18, 20), (12, 40),
    )  # fmt: skip
    """Corners (x, y) of the way over the paved middle of the court, metres."""
    step_m: float = 1.6
    """Distance between the cast scans along the way, metres."""
    sensor_m: float = 1.9
    """Height of the sensor above the ground, metres."""
    disc_m: float = 0.18
    """Diameter of the disc for which each point of a cloud stands, metres."""
    beside_m: float = 0.3
    """A ray passes a thing if one of its points is nearer than this, metres: a voxel."""
    same_thing_m: float = 0.5
    """A ray that ends no farther than this behind a thing it passes belongs to the thing, metres."""
    columns: int = 1125
    """Azimuths of a revolution."""
    stride_m: float = 0.3
    """Distance between the places on a ray where the survey of its cell is looked up, metres."""
    reach_m: float = 70.0
    """Greatest range of a cast ray, metres."""
    margin_m: float = 1.0
    """Points this far outside the box of a known change still belong to it, metres."""
    far_m: float = 0.6
    """Plain cloud-to-cloud: a point farther than this from every point of the other cloud is gone or new, metres."""
    false_m2: float = 2.0
    """A decided object outside the boxes counts from this area, square metres."""
    ended_ns: int = 1_700_000_000_000_000_000
    """Time at which the first session ended, nanoseconds since 1970."""

    @property
    def column_rad(self) -> float:
        """Angle between neighbouring azimuths, radians."""
        return 2.0 * np.pi / self.columns


COURT_RULE = CourtRule()


@dataclass(frozen=True, slots=True)
class CourtScore:
    """Changes that one method published."""

    method: str
    left: int
    """Points of the car that stay, above the ground, of ``before``."""
    before: int
    added: tuple[int, int]
    """Points in the boxes of the structure and of the thing that came."""
    found: int
    """How many of the three changes are found: the car lost half of its points, or 50 points came."""
    elsewhere: tuple[int, int]
    """Points deleted and added outside of the boxes."""
    others: tuple[float, ...]
    """Areas of the objects above 2 m2 outside of the boxes, m2."""
    false: tuple[float, ...]
    """Areas of these objects that no session's cloud shows, m2."""


@dataclass(frozen=True, slots=True)
class Court:
    """The clouds, in one frame."""

    reference: PointMap
    sessions: dict[str, PointMap]

    @classmethod
    def read(cls, folder: Path) -> Court:
        """MapvoteError naming the first file that is missing."""
        for name in ("gtmap", *SESSIONS):
            if not (folder / f"{name}.pcd").is_file():
                raise MapvoteError(f"{folder}: no {name}.pcd; docs/diff.md says where the court's clouds come from")
        return cls(read_map(folder / "gtmap.pcd"), {name: read_map(folder / f"{name}.pcd") for name in SESSIONS})


def evaluate_court(
    court: Court, settings: Settings, cases: Sequence[Case], tell: Progress, rule: CourtRule = COURT_RULE
) -> list[CourtScore]:
    """Scores of every case on cast scans, of the sessions' clouds as ballots, of one of them alone, and of plain
    distances between clouds."""
    surfaces = choose_case(settings, "surfaces")
    as_clouds = []
    shown = list[CloudChange]()
    for k, (name, cloud) in enumerate(court.sessions.items()):
        tell("voting with clouds", k, len(SESSIONS))
        votes = vote_of_session(name, name, court.reference, cloud, surfaces, end_ns=rule.ended_ns + k)
        as_clouds.append(votes.ballot)
        shown += [change for change in votes.changes if change.kind != "not seen"]
    drives = [cast_drive(name, cloud, rule) for name, cloud in court.sessions.items()]
    scores = []
    for k, case in enumerate(cases):
        tell("voting with cast scans", k, len(cases))
        own = settings.model_copy(update={"voting": case.voting, "paper": case.paper})
        ballots = [vote_drive(drive, court.reference, own)[0] for drive in drives]
        scores.append(_fused(f"cast scans, {case.name}", court, ballots, own, max(case.min_votes, 2), shown, rule))
    scores.append(_fused("clouds, surfaces", court, as_clouds, surfaces, 2, shown, rule))
    scores.append(_fused("one cloud alone", court, as_clouds[:1], surfaces, 2, shown, rule))
    scores.append(_by_distance(court, shown, rule))
    return scores


def cast_drive(name: str, cloud: PointMap, rule: CourtRule = COURT_RULE) -> Drive:
    """Scans of an HDL-32E along the way, cast from a session's cloud, wherever it knows the ground; one every
    ``rule.step_m``."""
    # Places along the way, equally far apart.
    points = all_points(cloud)
    standing = map_obstacles(cloud)
    sensor = SENSORS["hdl32e"]
    window = reduce(Grid.union, (cloud.lattice.tile(tile) for tile in cloud.tiles))
    surveyed = _surveyed(cloud, window)
    corners = np.array(rule.way, dtype=np.float64)
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(corners, axis=0).T)))
    at = np.arange(0.0, along[-1], rule.step_m)
    xy = np.column_stack([np.interp(at, along, corners[:, axis]) for axis in (0, 1)])
    poses = []
    scans = []
    # At each place the sensor stands upright over the ground and looks along the way.
    for k, place in enumerate(xy):
        ground = points[np.hypot(*(points[:, :2] - place).T) < 2.5, 2]
        if len(ground) < 20:
            continue
        ahead = xy[min(k + 1, len(xy) - 1)] - xy[max(k - 1, 0)]
        c, s = ahead / np.linalg.norm(ahead)
        T = np.eye(4)
        T[:2, :2] = [[c, -s], [s, c]]
        T[:3, 3] = *place, np.percentile(ground, 10) + rule.sensor_m
        beside = _nearest_beside((standing - T[:3, 3]) @ T[:3, :3], sensor.elevations_deg, rule)
        as_far = _measured_as_far(T, window, surveyed, rule)
        taken = _cast((points - T[:3, 3]) @ T[:3, :3], sensor.elevations_deg, beside, as_far, rule)
        if len(taken) > 2000:
            poses.append(T)
            scans.append(Scan(rule.ended_ns + 100_000_000 * k, taken))
    stamps_ns = np.array([scan.stamp_ns for scan in scans], dtype=np.int64)
    return Drive(
        Path(name), name, name, sensor, stamps_ns, scans.__getitem__, np.array(poses), 0.3, 1.0
    )  # fmt: skip


def _surveyed(cloud: PointMap, window: Grid) -> Bool:
    """(rows, cols) cells within two of one in which the session measured ground or something that stands."""
    planes = planes_of(cloud, window)
    side = 2 * CLOUD_COMPARISON.reach_cells + 1
    return np.asarray(ndimage.maximum_filter(planes.own_ground | planes.stands, side, mode="constant"))


def _measured_as_far(T: F64, window: Grid, surveyed: Bool, rule: CourtRule) -> F64:
    """(columns,) horizontal metres from pose T, in each column of the range image, to the first cell that the session
    did not survey."""
    azimuth = (np.arange(rule.columns) + 0.5) * rule.column_rad - np.pi
    reach = rule.stride_m * np.arange(1, int(rule.reach_m / rule.stride_m) + 1)
    ahead = np.column_stack([np.cos(azimuth), np.sin(azimuth)]) @ T[:2, :2].T
    places = T[:2, 3] + ahead[:, None, :] * reach[None, :, None]
    surveyed_there = window.value_at(surveyed, places.reshape(-1, 2))
    return np.asarray(
        rule.stride_m * (1 + np.logical_and.accumulate(surveyed_there.reshape(rule.columns, -1), axis=1).sum(axis=1))
    )


def _nearest_beside(standing: F64, elevations_deg: Sequence[float], rule: CourtRule) -> F64:
    """(beams, columns) range of the nearest of the ``standing`` points (n, 3), about the sensor, that a ray passes
    within ``rule.beside_m``: the ray may have gone through the thing, between two of its points."""
    reach = np.linalg.norm(standing, axis=1)
    beams = np.sort(np.radians(elevations_deg))
    gap = float(np.median(np.diff(beams)))
    elevation = np.arcsin(standing[:, 2] / np.maximum(reach, 0.1))
    ring = np.round(np.interp(elevation, beams, np.arange(len(beams)))).astype(np.int64)
    near = (reach > 1.5) & (reach < rule.reach_m)
    near &= np.abs(elevation - beams[ring]) < np.maximum(gap, rule.beside_m / np.maximum(reach, 0.1))
    out = np.full((len(beams), rule.columns), np.inf)
    for low, high in pairwise((1.5, 3.0, 6.0, 12.0, 24.0, rule.reach_m)):
        in_shell = near & (reach >= low) & (reach < high)
        image = np.full_like(out, np.inf)
        np.minimum.at(image, (ring[in_shell], _column(standing[in_shell], rule)), reach[in_shell])
        wide = [2 * int(np.ceil(rule.beside_m / (low * step) - 0.5)) + 1 for step in (gap, rule.column_rad)]
        out = np.minimum(out, ndimage.minimum_filter(image, wide, mode=("nearest", "wrap")))
    return out


def _column(points: F64, rule: CourtRule) -> I64:
    return np.floor((np.arctan2(points[:, 1], points[:, 0]) + np.pi) / rule.column_rad).astype(np.int64) % rule.columns


def _cast(points: F64, elevations_deg: Sequence[float], beside: F64, as_far: F64, rule: CourtRule) -> F32:
    """(m, 3) the nearest disc that each ray of a revolution meets, of points (n, 3) about the sensor; without the rays
    that pass something ``beside`` them or end farther than ``as_far``."""
    reach = np.linalg.norm(points, axis=1)
    near = (reach > 1.5) & (reach < rule.reach_m)
    points = points[near]
    reach = reach[near]
    beams = np.sort(np.radians(elevations_deg))
    elevation = np.arcsin(points[:, 2] / reach)
    half = 0.5 * rule.disc_m / reach
    ring = np.clip(np.round(np.interp(elevation, beams, np.arange(len(beams)))).astype(np.int64), 0, len(beams) - 1)
    hit = np.abs(elevation - beams[ring]) < np.maximum(half, 0.0015)
    ring = ring[hit]
    reach = reach[hit]
    half = half[hit]
    points = points[hit]
    col = _column(points, rule)
    image = np.full((len(beams), rule.columns), np.inf)
    wide = np.minimum((half / rule.column_rad).astype(np.int64), 12)
    for j in range(-int(wide.max(initial=0)), int(wide.max(initial=0)) + 1):
        covers = np.abs(j) <= wide
        np.minimum.at(image, (ring[covers], (col[covers] + j) % rule.columns), reach[covers])
    r, c = np.nonzero(np.isfinite(image) & (image < beside + rule.same_thing_m))
    azimuth = (c + 0.5) * rule.column_rad - np.pi
    distance = image[r, c]
    flat = distance * np.cos(beams[r])
    taken = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(beams[r])])
    taken = taken[flat <= as_far[c]]
    return np.asarray(taken + np.random.default_rng(0).normal(0.0, 0.01, taken.shape), dtype=np.float32)


def _fused(
    method: str,
    court: Court,
    ballots: Sequence[Ballot],
    settings: Settings,
    min_votes: int,
    shown: list[CloudChange],
    rule: CourtRule,
) -> CourtScore:
    after, decisions = update_map(court.reference, ballots, settings.fuse.model_copy(update={"min_votes": min_votes}))
    states, grid = states_over(court.reference.lattice, decisions)
    return _score(method, map_obstacles(court.reference), map_obstacles(after), states, grid, shown, rule)


def _by_distance(court: Court, shown: list[CloudChange], rule: CourtRule) -> CourtScore:
    """Plain cloud-to-cloud: a point more than ``rule.far_m`` from every point of the other cloud is gone or new;
    published where two sessions say so of a cell."""
    before = map_obstacles(court.reference)
    reference = all_points(court.reference)
    x = before[:, 0]
    y = before[:, 1]
    corner = court.reference.lattice.cell_of(x.min() - 60, y.min() - 60)
    size = int((np.ptp(y) + 120) / CELL_SIZE), int((np.ptp(x) + 120) / CELL_SIZE)
    grid = Grid(court.reference.lattice, *corner, *size)
    gone, new = np.zeros((2, *grid.shape), dtype=np.int64)
    offered = []

    def far(points: F64, others: F64) -> F64:
        return points[KDTree(others).query(points)[0] > rule.far_m]

    for cloud in court.sessions.values():
        gone += cells_with(far(before, all_points(cloud)), grid)
        came = far(map_obstacles(cloud), reference)
        new += cells_with(came, grid)
        offered.append(came[grid.indices_of(came)[2]])
    states = np.full(grid.shape, NO_VOTE, dtype=np.uint8)
    states[gone >= 2] = CellState.CHANGED_EMPTY
    states[new >= 2] = CellState.CHANGED_OCCUPIED
    kept = before[states[grid.indices_of(before)[:2]] != CellState.CHANGED_EMPTY]
    come = [points[states[grid.indices_of(points)[:2]] == CellState.CHANGED_OCCUPIED] for points in offered]
    return _score("cloud to cloud", before, np.concatenate([kept, *come]), states, grid, shown, rule)


def _in_box(points: F64, box: tuple[float, float, float, float], margin_m: float = 0.0) -> np.ndarray:
    x0, y0, x1, y1 = box
    x = points[:, 0]
    y = points[:, 1]
    return np.asarray((x > x0 - margin_m) & (x < x1 + margin_m) & (y > y0 - margin_m) & (y < y1 + margin_m))


def _score(
    method: str, before: F64, after: F64, states: U8, grid: Grid, shown: list[CloudChange], rule: CourtRule
) -> CourtScore:
    # Points in and outside the boxes of the known changes.
    counts = {n: tuple(int(_in_box(p, box).sum()) for p in (before, after)) for n, (_, box) in CHANGES.items()}
    gone = KDTree(after).query(before)[0] > 1e-6
    come = KDTree(before).query(after)[0] > 1e-6
    boxed = [
        np.logical_or.reduce([_in_box(p, box, rule.margin_m) for _, box in CHANGES.values()]) for p in (before, after)
    ]
    # Decided objects outside the boxes, and those that no session's cloud shows.
    others = []
    false = []
    x, y = grid.centres()
    for kind, state in (("gone", CellState.CHANGED_EMPTY), ("new", CellState.CHANGED_OCCUPIED)):
        for rows, cols in pieces(states == state):
            area_m2 = round(len(rows) * CELL_SIZE**2, 1)
            xy = np.column_stack([x[cols], y[rows]])
            if area_m2 <= rule.false_m2 or any(_in_box(xy, box, rule.margin_m).any() for _, box in CHANGES.values()):
                continue
            others.append(area_m2)
            if not any(one.kind == kind and _in_box(xy, one.box, rule.margin_m).any() for one in shown):
                false.append(area_m2)
    added = (counts["structure"][1] - counts["structure"][0], counts["thing"][1] - counts["thing"][0])
    n_found = int(counts["car"][1] < 0.5 * counts["car"][0]) + sum(more >= 50 for more in added)
    elsewhere = int((gone & ~boxed[0]).sum()), int((come & ~boxed[1]).sum())
    return CourtScore(
        method, counts["car"][1], counts["car"][0], added, n_found, elsewhere, tuple(others), tuple(false)
    )  # fmt: skip


def court_table(scores: Sequence[CourtScore]) -> Sheet:
    """A line a method."""
    headings = (
        "method", "found", "car's points left", "points of structure, thing added", "deleted, added elsewhere",
        "others > 2 m2", "of these no cloud shows",
    )  # fmt: skip
    rows = [
        (
            one.method,
            f"{one.found} of {len(CHANGES)}",
            f"{one.left} of {one.before}",
            f"{one.added[0]}, {one.added[1]}",
            f"{one.elsewhere[0]}, {one.elsewhere[1]}",
            *(f"{len(areas)} ({sum(areas):.0f} m2)" for areas in (one.others, one.false)),
        )
        for one in scores
    ]
    return Sheet("The court at two times", headings, rows)
