"""A real street, driven once, that did not change (paper VI asks for it).

The map comes from alternating blocks of a drive's scans, three vehicles from the blocks between, every third scan
each. All is still one pass: same viewpoints, same parked cars, minutes at most between map and vote. The
measured errors are a lower bound of those that a fleet meets. Edits give the same drive with another sensor, in other
weather, or with worse beliefs about where it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path

import numpy as np
from scipy import ndimage

from mapvote.codec.ballot import Ballot
from mapvote.config import Settings
from mapvote.core.geometry import exp, from_xyz_rpy, transform
from mapvote.core.grid import CELL_SIZE, Grid, window_around
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.reference import LocalMap, reference_window
from mapvote.core.types import F64, I64, NO_VOTE, U8, Bool, CellState, Drive, MapvoteError, PosePrior, Scan
from mapvote.formats import open_drive, read_T_map_lidar
from mapvote.formats.drives.options import parse_scans
from mapvote.matching.localiser import GivenPoses
from mapvote.perception.frontend import DriveReport, Frontend, Observation
from mapvote.perception.moving_objects import MovingFilter
from mapvote.perception.placement import find_obstacles
from mapvote.survey.build import BuildReport, build_map
from mapvote_lab.evaluation.cases import Case, fuse_case
from mapvote_lab.evaluation.scene import SharedPass
from mapvote_lab.evaluation.scores import NEIGHBOURS, cells_with, determined, pieces, ratio
from mapvote_lab.evaluation.truths import pose_errors, rigid_between


@record()
@dataclass(frozen=True, slots=True)
class StreetRule:
    """How a recording becomes a map and voting vehicles, and what its edits do."""

    vehicles: int = 3
    """Vehicles that vote."""
    least_scans: int = 4
    """Least scans of each vehicle: a place counts as found once three scans agree on it."""
    wrong_m: float = 0.5
    """A pose farther off than this is wrong, metres."""
    rain_share: float = 0.1
    """Share of the rays that end on drops in the runs in rain."""
    drops_m: float = 5.0
    """Mean distance of the drops that end a ray, metres beyond the sensor's least range."""


STREET_RULE = StreetRule()
Edit = Callable[[Drive], Drive]
"""Changes a whole recording before any of it is used: what its sensor sees, or what it believes."""


def unedited(recording: Drive) -> Drive:
    """As recorded."""
    return recording


def part_of(recording: Drive, scans: I64, vehicle: str | None = None) -> Drive:
    """These scans (m,) of a recording, in ascending order, driven by ``vehicle``."""
    prior = recording.T_map_lidar_prior
    return replace(
        recording,
        vehicle=vehicle or recording.vehicle,
        stamps_ns=recording.stamps_ns[scans],
        read_scan=lambda i: recording.read_scan(int(scans[i])),
        T_map_lidar_prior=None if prior is None else prior[scans],
    )


def split(n: int, block: int, rule: StreetRule = STREET_RULE) -> tuple[I64, list[I64]]:
    """(scans of the map, of each vehicle) of a recording of ``n``: blocks in turn, every third scan each.

    MapvoteError if that leaves too few to vote.
    """
    blocks = np.arange(n) // block
    mapped = np.flatnonzero(blocks % 2 == 0)
    rest = np.flatnonzero(blocks % 2 == 1)
    needed = rule.least_scans * rule.vehicles
    if len(rest) < needed:
        raise MapvoteError(
            f"blocks of {block} scans leave {len(rest)} of {n} scans to vote, but {needed} are needed; "
            "choose smaller blocks or a longer drive"
        )
    return mapped, [rest[(rest % block) % rule.vehicles == k] for k in range(rule.vehicles)]


@dataclass(frozen=True)
class Street:
    """The map of every other block, and the data by which votes on it are judged."""

    recording: Drive
    point_map: PointMap
    built: BuildReport
    block: int
    voting: Sequence[I64]
    """The scans of each vehicle."""
    T_map_lidar: F64
    """(n, 4, 4) the reference trajectory of the whole recording in the map's frame."""
    grid: Grid
    movers: Bool
    """Cells in which something moved while the map was made."""
    settings: Settings

    @property
    def mapped(self) -> Bool:
        """(rows, cols) cells in which the map holds an obstacle."""
        return np.asarray(reference_window(self.point_map, self.grid).occupied != 0)


@dataclass(frozen=True)
class RealRun:
    """Three vehicles on a street."""

    street: Street
    states: Mapping[str, U8]
    """Decided by each case, over the street's grid."""
    movers: Bool
    """Cells in or next to which something moved, by the filter on the map's and the vehicles' scans."""
    reports: Sequence[DriveReport]
    error_m: F64
    """Error of every scan that was localised, against the reference in the map's frame."""
    prior_error_m: F64
    scans: int

    @property
    def ballots(self) -> int:
        """Vehicles that found themselves at all, and so sent one."""
        return sum(len(report.lost) < report.scans for report in self.reports)

    @property
    def lost_share(self) -> float:
        """Share of the scans that abstained."""
        return 1.0 - len(self.error_m) / self.scans

    def changed_share(self, case: str, *, with_movers: bool, of_mapped: bool = False) -> float:
        """Share of determined cells (of those in which the map holds something) decided as changed, where nothing did.

        With ``of_mapped`` only cells that hold an obstacle in the map are counted, above and below the line.
        """
        scored = determined(self.states[case]) & (np.ones_like(self.movers) if with_movers else ~self.movers)
        scored &= self.street.mapped if of_mapped else np.ones_like(scored)
        return ratio(np.count_nonzero(is_changed(self.states[case]) & scored), np.count_nonzero(scored))

    def figures(self, case: str) -> dict[str, float]:
        """Counts, shares of cells and scans, and errors in metres (0 where no scan was localised)."""
        return {
            "ballots": float(self.ballots),
            "determined_cells": float(np.count_nonzero(determined(self.states[case]))),
            "false_share": self.changed_share(case, with_movers=False),
            "false_share_with_movers": self.changed_share(case, with_movers=True),
            "false_share_of_mapped": self.changed_share(case, with_movers=False, of_mapped=True),
            "lost_share": self.lost_share,
            "wrong_share": float(np.count_nonzero(self.error_m >= STREET_RULE.wrong_m)) / self.scans,
            "median_error_m": float(np.median(self.error_m)) if len(self.error_m) else 0.0,
            "max_error_m": float(self.error_m.max(initial=0.0)),
        }


def is_changed(states: U8) -> Bool:
    """Cells decided changed, either way."""
    return (states == CellState.CHANGED_OCCUPIED) | (states == CellState.CHANGED_EMPTY)


def open_recording(folder: Path, settings: Settings, scans: str | None = None) -> tuple[Drive, F64]:
    """The drive at ``folder`` and where (n, 4, 4) its scans were taken: by ``poses.txt`` where there is one, else by
    SLAM over all that is opened. ``scans``: as ``--scans`` of any verb. MapvoteError if the two do not match.
    """
    whole = open_drive(folder)
    chosen = parse_scans(scans, len(whole), str(folder))
    recording = part_of(whole, chosen)
    file = folder / "poses.txt"
    if not file.is_file():
        return recording, build_map([recording], settings)[1].tracks[0].T_map_lidar
    T = read_T_map_lidar(file, folder)
    if len(T) != len(whole):
        raise MapvoteError(f"{file}: {len(T)} poses for {len(whole)} scans: give a row for every scan")
    return recording, T[chosen]


def lay_street(
    recording: Drive, settings: Settings, reference: F64, *, block: int = 12, survey_edit: Edit = unedited
) -> Street:
    """The map of every other block of a recording; ``reference`` (n, 4, 4) is for scoring only."""
    mapped, voting = split(len(reference), block)
    survey = part_of(survey_edit(recording), mapped)
    point_map, built = build_map([survey], settings)
    T_map_survey = built.tracks[0].T_map_lidar
    T_map_lidar = rigid_between(T_map_survey, reference[mapped]) @ reference
    grid = _window(point_map, T_map_lidar)
    movers = _moving_cells(survey, T_map_survey, point_map, grid, settings)
    return Street(recording, point_map, built, block, voting, T_map_lidar, grid, movers, settings)


def vote_on(street: Street, cases: Sequence[Case], *, edit: Edit = unedited, first_pose_only: bool = False) -> RealRun:
    """Three vehicles drive the street's other blocks; every case is decided."""
    recording = edit(street.recording)
    movers = street.movers.copy()
    ballots: dict[str, list[Ballot]] = {case.name: [] for case in cases}
    reports = []
    metres = []
    prior_metres = []
    for k, scans in enumerate(street.voting):
        drive = part_of(recording, scans, f"v{k + 1}")
        T_true = street.T_map_lidar[scans]
        vehicle = SharedPass(drive, street.point_map, street.settings, cases)
        for i, scan in enumerate(drive):
            with_prior = i == 0 or not first_pose_only
            _note_movers(vehicle.observe(scan, PosePrior.of(drive, i) if with_prior else None), street.grid, movers)
        _note_movers(vehicle.finish(), street.grid, movers)
        there = np.setdiff1d(np.arange(len(drive)), vehicle.report.lost)
        reports.append(vehicle.report)
        if len(there):  # a vehicle that was never localised sends no ballot
            for case in cases:
                ballots[case.name].append(vehicle.ballot(case))
            metres.append(pose_errors(np.array(vehicle.report.T_map_lidar)[there], T_true[there])[0])
        if drive.T_map_lidar_prior is not None:
            prior_metres.append(pose_errors(drive.T_map_lidar_prior, T_true)[0])
    states = {case.name: _decided(street, ballots[case.name], case) for case in cases}
    near_movers = ndimage.binary_dilation(movers, NEIGHBOURS)
    off_m, prior_m = (np.concatenate([np.zeros(0), *parts]) for parts in (metres, prior_metres))
    total = sum(report.scans for report in reports)
    return RealRun(street, states, near_movers, reports, off_m, prior_m, total)


def _decided(street: Street, ballots: list[Ballot], case: Case) -> U8:
    if not ballots:
        return np.full(street.grid.shape, NO_VOTE, dtype=np.uint8)
    fuse = street.settings.fuse.model_copy(update={"min_difference": 0.0})  # they share one drive, and are no copies
    return fuse_case(street.point_map, ballots, case.min_votes, fuse, street.grid).states


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
        cells |= cells_with(seen.scan.points_map[seen.moving], grid)


def met_cells(street: Street, edit: Edit = unedited) -> Bool:
    """(rows, cols) cells in which a vehicle's scan met something above the ground, at the reference poses."""
    met = np.zeros(street.grid.shape, dtype=np.bool_)
    around = LocalMap(street.point_map, street.settings.voting.window_m)
    recording = edit(street.recording)
    for i in np.concatenate(street.voting).tolist():
        T = street.T_map_lidar[i]
        points = transform(T, recording.read_scan(i).points)
        met |= cells_with(points[find_obstacles(points, around.at(T[:3, 3])[0])[0]], street.grid)
    return met


def _window(point_map: PointMap, reference: F64) -> Grid:
    """The window around the whole drive in which cells are counted: 40 m to every side, as a vehicle sees."""
    return reduce(Grid.union, (window_around(point_map.lattice, T[0, 3], T[1, 3], 80.0) for T in reference))


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
    x, y = run.street.grid.centres()
    for state in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        for rows, cols in pieces(run.states[case] == state):
            out.append(
                FalseChange(
                    state.name.lower(), round(float(x[cols].mean()), 1), round(float(y[rows].mean()), 1),
                    round(len(rows) * CELL_SIZE**2, 2), bool(run.movers[rows, cols].mean() >= 0.5),
                )
            )  # fmt: skip
    return sorted(out, key=lambda f: (-f.m2, f.x, f.y))[:most]


def of_points(scan: Scan, keep: Bool) -> Scan:
    """The scan's points of ``keep`` (n,)."""
    return replace(
        scan,
        points=scan.points[keep],
        time_s=None if scan.time_s is None else scan.time_s[keep],
        fields={name: values[keep] for name, values in scan.fields.items()},
    )


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
        return of_points(scan, (len(elevations) - 1 - nearest) % 2 == 0)

    return replace(drive, sensor=sensor, read_scan=read_scan)


def with_fewer_points(share: float) -> Edit:
    """That share of the points is not there, any of them."""

    def edit(drive: Drive) -> Drive:
        def read_scan(i: int) -> Scan:
            scan = drive.read_scan(i)
            return of_points(scan, np.random.default_rng([i, 3]).random(len(scan.points)) >= share)

        return replace(drive, read_scan=read_scan)

    return edit


def in_rain(share: float, drops_m: float = STREET_RULE.drops_m) -> Edit:
    """Rain: that share of the rays ends on a drop near the sensor (exponential, ``drops_m`` in the mean)."""

    def edit(drive: Drive) -> Drive:
        def read_scan(i: int) -> Scan:
            scan = drive.read_scan(i)
            rng = np.random.default_rng([i, 1])
            reach = np.linalg.norm(scan.points, axis=1)
            drop = drive.sensor.min_range_m + rng.exponential(drops_m, len(reach)).astype(np.float32)
            short = np.where((rng.random(len(reach)) < share) & (drop < reach), drop / np.maximum(reach, 1e-3), 1.0)
            return replace(scan, points=(scan.points * short[:, None]).astype(np.float32))

        return replace(drive, read_scan=read_scan)

    return edit


def believing(change: Callable[[F64, F64], F64]) -> Edit:
    """A prior made of ``change(priors (n, 4, 4), seconds since the first scan (n,)) -> (n, 4, 4)``.

    The stated sigmas stay as they are: the vehicle does not know.
    """

    def edit(drive: Drive) -> Drive:
        at_s = 1e-9 * (drive.stamps_ns - drive.stamps_ns[0])
        return replace(drive, T_map_lidar_prior=change(_prior_of(drive), at_s))

    return edit


def without_prior(drive: Drive) -> Drive:
    """The drive without its prior."""
    return replace(drive, T_map_lidar_prior=None)


def late(seconds: float) -> Edit:
    """Where the vehicle was ``seconds`` ago; before the recording it drove on as at its start."""

    def change(T: F64, at_s: F64) -> F64:
        then = at_s - seconds
        out = T[np.abs(at_s[None, :] - then[:, None]).argmin(axis=1)].copy()
        few = min(9, len(T) - 1)
        before = np.minimum(then, 0.0)[:, None] * (T[few] - T[0])[:3, 3] / max(float(at_s[few]), 1e-3)
        out[:, :3, 3] = before + np.column_stack([np.interp(then, at_s, T[:, axis, 3]) for axis in range(3)])
        return out

    return believing(change)


def biased(metres: float) -> Edit:
    """Off by as much all the time, half way between ahead and aside as the drive begins."""
    return believing(lambda T, at_s: _aside(T, np.full(len(T), metres)))


def drifting(metres: float) -> Edit:
    """Right at first, and as far off as that at the end: a heading error that grows."""
    return believing(lambda T, at_s: _aside(T, metres * at_s / max(float(at_s[-1]), 1e-3)))


def of_another_street() -> Edit:
    """The whole track turned by 90 deg about its middle: a street that crosses this one."""

    def change(T: F64, at_s: F64) -> F64:
        x, y, z = T[len(T) // 2, :3, 3].tolist()
        turn = from_xyz_rpy(x, y, z, yaw=0.5 * np.pi) @ from_xyz_rpy(-x, -y, -z)
        return np.asarray(turn @ T)

    return believing(change)


def disturbed(sigma_m: float = 0.5, sigma_deg: float = 2.0) -> Edit:
    """An independent error in every scan, normal in x, y and yaw; the vehicle knows twice as much."""

    def edit(drive: Drive) -> Drive:
        T = _prior_of(drive)
        rng = np.random.default_rng(0)
        off = np.zeros((len(T), 6))
        off[:, :2] = rng.normal(0.0, sigma_m, (len(T), 2))
        off[:, 5] = rng.normal(0.0, np.radians(sigma_deg), len(T))
        worse = np.array([T_map_lidar @ exp(xi) for T_map_lidar, xi in zip(T, off, strict=True)])
        return replace(drive, T_map_lidar_prior=worse, prior_sigma_m=2 * sigma_m, prior_sigma_deg=2 * sigma_deg)

    return edit


def _prior_of(drive: Drive) -> F64:
    if drive.T_map_lidar_prior is None:
        raise MapvoteError(f"{drive.path}: has no prior to change")
    return drive.T_map_lidar_prior


def _aside(T: F64, metres: F64) -> F64:
    """Poses (n, 4, 4) moved by ``metres`` (n,) half way between ahead and aside as the drive begins."""
    ahead = np.arctan2(T[0, 1, 0], T[0, 0, 0]) + 0.25 * np.pi
    out = T.copy()
    out[:, :2, 3] += metres[:, None] * np.array([np.cos(ahead), np.sin(ahead)])
    return out
