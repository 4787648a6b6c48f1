"""A real street, driven once, that did not change (paper VI asks for it).

The map comes from alternating blocks of a drive's scans, three vehicles from the blocks between, every third scan
each. All is still one pass: same viewpoints, same parked cars, minutes at most between map and vote. What is
measured here is a lower bound of what a fleet meets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from mapvote.codec.ballot import Ballot
from mapvote.config import Settings
from mapvote.core.geometry import exp, transform
from mapvote.core.grid import CELL_SIZE, Grid, window_around
from mapvote.core.point_map import PointMap
from mapvote.core.reference import LocalMap
from mapvote.core.types import F64, I64, U8, Bool, CellState, Drive, MapvoteError, Scan
from mapvote.evaluation.experiments.cases import Case, fuse_case
from mapvote.evaluation.experiments.shared_pass import SharedPass
from mapvote.evaluation.scoring.cells import determined, ratio
from mapvote.evaluation.scoring.truth import pose_errors, rigid_between
from mapvote.formats import open_drive, read_T_map_lidar
from mapvote.localisation.ndt import PosePrior
from mapvote.localisation.tracker import GivenPoses
from mapvote.perception.frontend import DriveReport, Frontend, Observation
from mapvote.perception.moving_objects import MovingFilter
from mapvote.perception.raycast import find_obstacles
from mapvote.slam.build import build_map

VEHICLES = 3
Disturb = Callable[[Drive], Drive]


def split(n: int, block: int) -> tuple[str, list[str]]:
    """(``--scans`` of the map, of each vehicle) for a drive of ``n`` scans: blocks in turn, every third scan each."""
    starts = range(0, n, block)
    if len(starts) < 2:
        raise MapvoteError(f"{n} scans are too few for blocks of {block}: choose smaller blocks")
    mapped = ",".join(f"{s}:{min(s + block, n)}" for s in starts[::2])
    return mapped, [
        ",".join(f"{s + k}:{min(s + block, n)}:{VEHICLES}" for s in starts[1::2] if s + k < min(s + block, n))
        for k in range(VEHICLES)
    ]


def as_given(drive: Drive) -> Drive:
    """The prior as recorded."""
    return drive


def disturbed(drive: Drive, sigma_m: float = 0.5, sigma_deg: float = 2.0, seed: int = 0) -> Drive:
    """The prior with an independent error per scan: ``sigma_m`` in x and y, ``sigma_deg`` in yaw (normal)."""
    if drive.T_map_lidar_prior is None:
        raise MapvoteError(f"{drive.path}: has no prior to disturb")
    rng = np.random.default_rng([seed, *drive.vehicle.encode()])
    off = np.zeros((len(drive), 6))
    off[:, :2] = rng.normal(0.0, sigma_m, (len(drive), 2))
    off[:, 5] = rng.normal(0.0, np.radians(sigma_deg), len(drive))
    worse = np.array([T @ exp(xi) for T, xi in zip(drive.T_map_lidar_prior, off, strict=True)])
    return replace(drive, T_map_lidar_prior=worse, prior_sigma_m=2 * sigma_m, prior_sigma_deg=2 * sigma_deg)


def every_other_beam(drive: Drive) -> Drive:
    """The drive as a sensor with half the beams would have seen it; points are matched to the nearest beam."""
    elevations = np.sort(np.asarray(drive.sensor.elevations_deg))
    sensor = replace(drive.sensor, elevations_deg=tuple(elevations[::-1][::2].tolist()))

    def read_scan(i: int) -> Scan:
        scan = drive.read_scan(i)
        flat = np.hypot(scan.points[:, 0], scan.points[:, 1])
        elevation = np.degrees(np.arctan2(scan.points[:, 2], flat))
        above = np.searchsorted(elevations, elevation).clip(1, len(elevations) - 1)
        nearest = above - (elevation - elevations[above - 1] < elevations[above] - elevation)
        keep = (len(elevations) - 1 - nearest) % 2 == 0
        return replace(
            scan,
            points=scan.points[keep],
            time_s=None if scan.time_s is None else scan.time_s[keep],
            intensity=None if scan.intensity is None else scan.intensity[keep],
        )

    return replace(drive, sensor=sensor, read_scan=read_scan)


@dataclass(frozen=True)
class RealRun:
    """One drive against the map of its other blocks."""

    point_map: PointMap
    grid: Grid
    states: Mapping[str, U8]
    """Decided by each case, over ``grid``."""
    movers: Bool
    """Cells in or next to which something moved, by the filter on the map's and the vehicles' scans."""
    reached: Bool
    """Cells in which a scan of some vehicle met something above the ground, at the reference poses."""
    reports: Sequence[DriveReport]
    error_m: F64
    """Of every scan that was localised, against the reference in the map's frame."""
    error_deg: F64
    prior_error_m: F64
    scans: int

    def changed_share(self, case: str, *, with_movers: bool) -> float:
        """Share of determined cells decided as changed, on a street where nothing changed."""
        scored = determined(self.states[case]) & (np.ones_like(self.movers) if with_movers else ~self.movers)
        return ratio(np.count_nonzero(changed(self.states[case]) & scored), np.count_nonzero(scored))


def changed(states: U8) -> Bool:
    """Cells decided changed, either way."""
    return (states == CellState.CHANGED_OCCUPIED) | (states == CellState.CHANGED_EMPTY)


def run_real(
    folder: Path,
    cases: Sequence[Case],
    settings: Settings,
    *,
    block: int = 12,
    change_prior: Disturb = as_given,
    first_pose_only: bool = False,
    thin: bool = False,
    edit: Callable[[PointMap, Grid, Bool], PointMap] | None = None,
) -> RealRun:
    """Map from every other block of the drive at ``folder``, three vehicles from the rest, every case decided.

    ``edit(map, window, movers)`` changes the finished map (injected changes); ``poses.txt`` is read for scoring only.
    """
    n = len(open_drive(folder))
    mapped, voting = split(n, block)
    survey = open_drive(folder, scans=mapped)
    point_map, built = build_map([survey], settings)
    reference = read_T_map_lidar(folder / "poses.txt", folder)
    T_map_world = rigid_between(built.tracks[0].T_map_lidar, reference[_indices(mapped, n)])

    grid = _window(point_map, reference)
    movers = _moving_cells(survey, built.tracks[0].T_map_lidar, point_map, grid, settings)
    point_map = edit(point_map, grid, movers) if edit else point_map
    reached = np.zeros(grid.shape, dtype=np.bool_)
    ballots: dict[str, list[Ballot]] = {case.name: [] for case in cases}
    reports, metres, degrees, prior_metres = [], [], [], []
    for k, scans in enumerate(voting):
        drive = open_drive(folder, scans=scans, vehicle=f"v{k + 1}")
        T_true = T_map_world @ reference[_indices(scans, n)]
        drive = change_prior(every_other_beam(drive) if thin else drive)
        vehicle = SharedPass(drive, point_map, settings, cases)
        for i, scan in enumerate(drive):
            known = i == 0 or not first_pose_only
            _note_movers(vehicle.observe(scan, PosePrior.of(drive, i) if known else None), grid, movers)
        _note_movers(vehicle.finish(), grid, movers)
        reached |= _reached_cells(drive, T_true, point_map, grid, settings.voting.window_m)
        for case in cases:
            ballots[case.name].append(vehicle.ballot(case))
        there = np.setdiff1d(np.arange(len(drive)), vehicle.report.lost)
        off_m, off_rad = pose_errors(np.array(vehicle.report.T_map_lidar)[there], T_true[there])
        reports.append(vehicle.report)
        metres.append(off_m)
        degrees.append(np.degrees(off_rad))
        if drive.T_map_lidar_prior is not None:
            prior_metres.append(pose_errors(drive.T_map_lidar_prior, T_true)[0])
    states = {
        case.name: fuse_case(point_map, ballots[case.name], case.min_votes, settings.fuse, grid).states
        for case in cases
    }
    return RealRun(
        point_map, grid, states, ndimage.binary_dilation(movers, np.ones((3, 3))), reached, reports,
        np.concatenate(metres), np.concatenate(degrees), np.concatenate(prior_metres), sum(r.scans for r in reports),
    )  # fmt: skip


def _moving_cells(survey: Drive, T_map_lidar: F64, point_map: PointMap, grid: Grid, settings: Settings) -> Bool:
    """Cells in which something moved while the map was made."""
    cells = np.zeros(grid.shape, dtype=np.bool_)
    frontend = Frontend(
        GivenPoses(survey.stamps_ns, T_map_lidar),
        MovingFilter(survey.sensor, settings.moving),
        LocalMap(point_map, 2.0 * settings.mapping.reach_m),
    )
    for scan in survey:
        _note_movers(frontend.observe(scan), grid, cells)
    _note_movers(frontend.finish(), grid, cells)
    return cells


def _note_movers(observations: list[Observation], grid: Grid, cells: Bool) -> None:
    """Mark the ``cells`` (rows, cols of ``grid``) in which the filter found moving points."""
    for seen in observations:
        rows, cols, inside = grid.indices_of(seen.scan.points_map[seen.moving])
        cells[rows[inside], cols[inside]] = True


def _reached_cells(drive: Drive, T_map_lidar: F64, point_map: PointMap, grid: Grid, window_m: float) -> Bool:
    """Cells in which a scan of ``drive`` met something above the ground, no farther off than a vehicle looks."""
    reached = np.zeros(grid.shape, dtype=np.bool_)
    surroundings = LocalMap(point_map, window_m)
    for scan, T in zip(drive, T_map_lidar, strict=True):
        points = transform(T, scan.points)
        rows, cols, inside = grid.indices_of(points[find_obstacles(points, surroundings.at(T[:3, 3])[0])[0]])
        reached[rows[inside], cols[inside]] = True
    return reached


def _indices(scans: str, n: int) -> I64:
    """The indices that a ``--scans`` text selects of ``n``."""
    return np.concatenate([np.arange(n)[slice(*map(int, part.split(":")))] for part in scans.split(",")])


def _window(point_map: PointMap, reference: F64) -> Grid:
    """The window around the whole drive in which cells are counted: 40 m to every side, as a vehicle sees."""
    ends = [window_around(point_map.lattice, T[0, 3], T[1, 3], 80.0) for T in reference]
    window = ends[0]
    for end in ends[1:]:
        window = window.union(end)
    return window


@dataclass(frozen=True, slots=True)
class FalseChange:
    """One connected group of cells decided changed though nothing changed."""

    kind: str
    x: float
    y: float
    m2: float
    on_mover: bool


def largest_false_changes(run: RealRun, case: str, most: int = 10) -> list[FalseChange]:
    """The largest groups, 8-connected, one class each, largest first."""
    out = []
    x, y = run.grid.centres()
    for state in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        label, count = ndimage.label(run.states[case] == state, structure=np.ones((3, 3)))
        for k in range(1, count + 1):
            rows, cols = np.nonzero(label == k)
            out.append(
                FalseChange(
                    state.name.lower(), round(float(x[cols].mean()), 1), round(float(y[rows].mean()), 1),
                    round(len(rows) * CELL_SIZE**2, 2), bool(run.movers[rows, cols].mean() >= 0.5),
                )
            )  # fmt: skip
    return sorted(out, key=lambda f: (-f.m2, f.x, f.y))[:most]
