"""The real street: KITTI drive 0001 as map and as three vehicles, by alternating blocks of scans (METHOD 4).

The street did not change between the blocks, so every change found is false, unless it moved. The scans are of one
pass: same viewpoints a second or two apart, same parked cars. All figures here are therefore a lower bound of what
another day would show. ``poses.txt``, the reference trajectory, is read by this module alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from mapvote.config import Settings, VotingSettings
from mapvote.core.ballot import Ballot
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.types import F64, I64, U8, Bool, CellState, Drive, PointMap, Scan
from mapvote.evaluation.cases import column_cases, fuse_case, paper_cases
from mapvote.evaluation.evaluate import error_summary
from mapvote.evaluation.injection import inject, score_injection
from mapvote.evaluation.metrics import classes_of, determined, ratio
from mapvote.evaluation.truth import pose_errors, rigid_between
from mapvote.formats import open_drive
from mapvote.formats.poses import read_poses
from mapvote.mapping import build_map
from mapvote.vehicle import Vehicle

MAP_SCANS = "0:12,25:37"
VEHICLE_BLOCKS = ((12, 25), (37, 50))
VEHICLES = 3
DRAWS = 3
INJECTED = 10
_MOVER_CELLS = 2
"""Cells around a point called moving that count as a mover's."""
_NAMES = ("1", "5", "1 column", "columns")


@dataclass(frozen=True)
class Street:
    """The map of the other blocks, the vehicles' drives, and the reference trajectory carried into the map's frame."""

    point_map: PointMap
    map_drive: Drive
    drives: tuple[Drive, ...]
    T_map_reference: tuple[F64, ...]
    """(n, 4, 4) of each vehicle's scans."""


def street(folder: Path, settings: Settings, beams32: bool = False) -> Street:
    """Map and vehicles from one drive folder that has ``poses.txt``."""
    map_drive = open_drive(folder, scans=MAP_SCANS)
    point_map, report = build_map([map_drive], settings)
    reference = read_poses(folder / "poses.txt")
    mapped = np.concatenate([np.arange(*(int(v) for v in part.split(":"))) for part in MAP_SCANS.split(",")])
    T_map_world = rigid_between(report.tracks[0].T_map_lidar, reference[mapped])
    drives, T_reference = [], []
    for k in range(VEHICLES):
        scans = ",".join(f"{first + k}:{last}:{VEHICLES}" for first, last in VEHICLE_BLOCKS)
        drive = open_drive(folder, scans=scans, vehicle=f"v{k + 1}")
        drives.append(thinned(drive) if beams32 else drive)
        rows = np.concatenate([np.arange(first + k, last, VEHICLES) for first, last in VEHICLE_BLOCKS])
        T_reference.append(T_map_world @ reference[rows])
    return Street(point_map, map_drive, tuple(drives), tuple(T_reference))


def thinned(drive: Drive) -> Drive:
    """Every second beam of the drive's sensor, by the elevation of each point."""
    beams = np.array(drive.sensor.elevations_deg)
    order = np.argsort(beams)
    edges = 0.5 * (beams[order][1:] + beams[order][:-1])

    def read(i: int) -> Scan:
        scan = drive.read_scan(i)
        p = scan.points.astype(np.float64)
        elevation = np.degrees(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])))
        kept = order[np.searchsorted(edges, elevation)] % 2 == 0
        return replace(
            scan,
            points=scan.points[kept],
            time_s=None if scan.time_s is None else scan.time_s[kept],
            intensity=None if scan.intensity is None else scan.intensity[kept],
        )

    sensor = replace(drive.sensor, name=f"{drive.sensor.name}-half", elevations_deg=tuple(beams[::2].tolist()))
    return replace(drive, sensor=sensor, read_scan=read)


def disturbed(drive: Drive, metres: float, degrees: float, seed: int) -> Drive:
    """The drive with each prior pose moved by ``metres`` in a random direction and turned by +-``degrees`` of yaw."""
    assert drive.T_map_lidar_prior is not None
    rng = np.random.default_rng(seed)
    T = drive.T_map_lidar_prior.copy()
    for i in range(len(T)):
        angle, turn = rng.uniform(0.0, 2.0 * np.pi), np.radians(degrees) * rng.choice([-1.0, 1.0])
        T[i] = T[i] @ from_xyz_rpy(metres * np.cos(angle), metres * np.sin(angle), 0.0, yaw=turn)
    return replace(drive, T_map_lidar_prior=T)


@dataclass(frozen=True)
class Run:
    """Three vehicles in one map."""

    ballots: Mapping[str, list[Ballot]]
    T_found: list[F64]
    """(n, 4, 4) a vehicle, NaN where it abstained."""
    movers: list[F64]
    """Points (n, 3) that each vehicle's filter called moving, map metres."""


def drive_all(
    point_map: PointMap, drives: Sequence[Drive], voters: Mapping[str, VotingSettings], settings: Settings,
    *, first_pose_only: bool = False,
) -> Run:  # fmt: skip
    """Every vehicle over its scans, in ``point_map``."""
    ballots: dict[str, list[Ballot]] = {name: [] for name in voters}
    found, movers = [], []
    for drive in drives:
        moved: list[F64] = []

        def watch(points_map: F64, origin_map: F64, obstacle: Bool, moving: Bool, into: list[F64] = moved) -> None:
            into.append(points_map[moving])

        vehicle = Vehicle(
            drive.vehicle, drive.sensor, point_map, settings, drive_id=drive.drive_id, voters=list(voters.values()),
            watch=watch, prior_sigma_m=drive.prior_sigma_m, prior_sigma_deg=drive.prior_sigma_deg,
        )  # fmt: skip
        for i, scan in enumerate(drive):
            known = drive.T_map_lidar_prior is not None and (i == 0 or not first_pose_only)
            vehicle.observe(scan, drive.T_map_lidar_prior[i] if known and drive.T_map_lidar_prior is not None else None)
        T = np.array(vehicle.report.T_map_lidar)
        T[vehicle.report.lost] = np.nan
        found.append(T)
        for name, voting in voters.items():
            ballots[name].append(vehicle.ballot(voting))
        movers.append(np.concatenate([np.zeros((0, 3)), *moved]))
    return Run(ballots, found, movers)


def voters_of(settings: Settings) -> dict[str, tuple[VotingSettings, int]]:
    """The votes that are compared, each with its quorum."""
    every = {**paper_cases(settings), **column_cases(settings)}
    return {name: (every[name].voting, every[name].min_votes) for name in _NAMES}


def localise_real(place: Street, settings: Settings, seed: int = 1) -> dict[str, Any]:
    """Errors against the reference with prior.txt, with it disturbed by 0.5 m and 2 deg, with the first pose only."""
    voting = {"1": voters_of(settings)["1"][0]}
    noisy = [disturbed(d, 0.5, 2.0, seed + i) for i, d in enumerate(place.drives)]
    runs = {
        "prior.txt": (place.drives, False),
        "disturbed by 0.5 m, 2 deg": (noisy, False),
        "first pose only": (place.drives, True),
    }
    truth = np.concatenate(place.T_map_reference)
    out = {}
    for name, (drives, first_only) in runs.items():
        run = drive_all(place.point_map, drives, voting, settings, first_pose_only=first_only)
        priors = np.concatenate([d.T_map_lidar_prior for d in drives if d.T_map_lidar_prior is not None])
        out[name] = {
            **error_summary(np.concatenate(run.T_found), truth),
            "prior_median_m": float(np.median(pose_errors(priors, truth)[0])),
        }
    return out


def window_of(place: Street) -> Grid:
    """The window that holds every vehicle's local grids."""
    positions = np.concatenate(place.T_map_reference)[:, :2, 3]
    rows, cols = place.point_map.lattice.cells_of(positions)
    half = round(40.0 / CELL_SIZE)
    row0, col0 = int(rows.min()) - half, int(cols.min()) - half
    return Grid(place.point_map.lattice, row0, col0, int(rows.max()) + half - row0, int(cols.max()) + half - col0)


def mover_cells(movers: Sequence[F64], window: Grid) -> Bool:
    """(rows, cols) cells on or beside a point that some vehicle called moving."""
    cells = np.zeros(window.shape, dtype=np.bool_)
    for points in movers:
        rows, cols, inside = window.indices_of(points)
        cells[rows[inside], cols[inside]] = True
    return ndimage.binary_dilation(cells, structure=np.ones((3, 3)), iterations=_MOVER_CELLS)


@dataclass(frozen=True)
class FalseChange:
    """A connected group of cells decided as changed on a street that did not change."""

    state: int
    area_m2: float
    x: float
    y: float
    distance_m: float
    """To the nearest pose of a vehicle."""
    moving: bool
    """It touches what a vehicle called moving."""
    points_in_map: int


def false_changes(states: U8, moving: Bool, counts: I64, window: Grid, positions: F64) -> list[FalseChange]:
    """Largest first. ``counts`` (rows, cols): the map's obstacle points; ``positions`` (n, 2) of the vehicles."""
    out = []
    for value, state in ((1, CellState.CHANGED_OCCUPIED), (2, CellState.CHANGED_EMPTY)):
        labels, n = ndimage.label(classes_of(states) == value, structure=np.ones((3, 3)))
        for k, where in enumerate(ndimage.find_objects(labels)[:n], start=1):
            mine = labels[where] == k
            row, col = (float(v.mean()) for v in np.nonzero(mine))
            x = window.x0 + (where[1].start + col + 0.5) * CELL_SIZE
            y = window.y0 + (where[0].start + row + 0.5) * CELL_SIZE
            distance = float(np.linalg.norm(positions - (x, y), axis=1).min())
            touches, points = bool((mine & moving[where]).any()), int(counts[where][mine].sum())
            area = float(mine.sum() * CELL_SIZE**2)
            out.append(FalseChange(int(state), area, x, y, distance, touches, points))
    return sorted(out, key=lambda change: (-change.area_m2, change.x, change.y))


def unchanged_street(place: Street, settings: Settings, run: Run, voters: Mapping[str, Any]) -> dict[str, Any]:
    """Share of determined cells decided as changed where nothing changed, movers counted apart, for every voter."""
    window = window_of(place)
    moving = mover_cells(run.movers, window)
    out = {}
    for name, (_, min_votes) in voters.items():
        outcome = fuse_case(place.point_map, run.ballots[name], min_votes, settings.fuse, window)
        changed, known = classes_of(outcome.states) > 0, determined(outcome.states)
        out[name] = {
            "determined_cells": int(known.sum()),
            "false_share_movers_apart": ratio(np.count_nonzero(changed & ~moving), np.count_nonzero(known & ~moving)),
            "false_share_with_movers": ratio(np.count_nonzero(changed), np.count_nonzero(known)),
            "states": outcome.states,
        }
    return out


def injected_changes(
    place: Street, settings: Settings, voters: Mapping[str, Any], seen: Bool, told: Callable[[int], None] | None = None
) -> dict[str, Any]:
    """Recall and precision on injected objects, mean and worst of three random draws, for every voter."""
    window = window_of(place)
    draws: dict[str, list[dict[str, float]]] = {name: [] for name in voters}
    for draw in range(DRAWS):
        rng = np.random.default_rng([draw, 7])
        other_map, objects = inject(place.point_map, window, seen, INJECTED, rng)
        run = drive_all(other_map, place.drives, {name: v for name, (v, _) in voters.items()}, settings)
        for name, (_, min_votes) in voters.items():
            outcome = fuse_case(other_map, run.ballots[name], min_votes, settings.fuse, window)
            draws[name].append(score_injection(outcome.states, objects))
        if told:
            told(draw + 1)
    return {
        name: {
            key: {"mean": float(np.mean([s[key] for s in scores])), "worst": float(min(s[key] for s in scores))}
            for key in scores[0]
        }
        for name, scores in draws.items()
    }
