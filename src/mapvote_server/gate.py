"""The localisation gate: a version in which vehicles would localise worse is not published.

It needs a reference drive: scans with rough poses, recorded recently, whose vehicle did not vote. Every scan is
localised in the old map and in the new one from the same initial guesses, and the results are compared in pairs.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import scipy
import structlog

from mapvote.config import GateSettings, NdtSettings
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.grid import CELL_SIZE
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.sampling import evenly
from mapvote.core.types import F32, F64, Drive, MapvoteError
from mapvote.formats import open_drive
from mapvote.formats.listing import below
from mapvote.matching.ndt_map import MapWindow
from mapvote.matching.prepare import deskew, thin_for_levels, twist_between
from mapvote.shapes.change_objects import changed_cells
from mapvote_server.store.policy import GatePolicy
from mapvote_server.store.publish import Gate

Verdict = Literal["pass", "hold", "abstain"]


@record()
@dataclass(frozen=True, slots=True)
class GateRule:
    """Numbers of the comparison of two map versions by the localisation of drives."""

    reach_m: float = 50.0
    """Distance from every change beyond which scans are left out, metres."""
    most_scans: int = 60
    """Scans compared at most, spread evenly."""
    min_scans: int = 20
    """Scans near a change below which the gate abstains: the t distribution's bound is then wider than any
    tolerance."""
    block_scans: int = 5
    """Neighbouring scans that count as one observation: at 10 Hz they see the same surfaces."""
    start_m: float = 0.3
    """Distance of the initial guesses from the prior pose, metres."""
    scatter_m: float = 1.0
    """Upper bound of :attr:`Localised.scatter_m`, metres."""


GATE_RULE = GateRule()
_START_ANGLES = np.radians([90.0, 210.0, 330.0])


@dataclass(frozen=True, slots=True)
class Localised:
    """One scan in one map."""

    score: float
    """NDT score of the best of the poses found, in [0, 1]."""
    inlier_share: float
    """Its inlier share."""
    scatter_m: float
    """RMS distance of the poses found from all guesses to their mean: how well the map determines the pose."""
    found: float
    """1 if a vehicle would accept the best pose, else 0."""


@dataclass(frozen=True, slots=True)
class Measure:
    """One figure of the old map beside the same of the new one, over all scans compared."""

    name: str
    old: float
    new: float
    gain: float
    """Mean of the pairs' differences; positive where the new map is better."""
    uncertainty: float
    """Half width of the one-sided 95 % confidence bound of ``gain``, over blocks of neighbouring scans."""
    tolerance: float

    def __str__(self) -> str:
        return (
            f"{self.name} {self.old:.3f} -> {self.new:.3f} "
            f"(gain {self.gain:+.3f} +- {self.uncertainty:.3f}, tolerated {-self.tolerance:+.3f})"
        )


def gate_by(ndt: NdtSettings, drives: str) -> Gate:
    """The gate of the policy's reference drive, which lies below the folder ``drives`` ("": there is none); an
    abstention lets the version through. MapvoteError if the drive is missing."""

    def reasons(policy: GatePolicy, old: PointMap, new: PointMap) -> Sequence[str]:
        settings = GateSettings.model_validate(policy.model_dump(exclude={"drive"}))
        verdict, reason = gate(old, new, _gate_drive(drives, policy.drive), settings, ndt)
        structlog.get_logger("mapvote").info("gate", verdict=verdict, reasons=reason)
        return reason if verdict == "hold" else []

    return reasons


def _gate_drive(drives: str, name: str) -> Drive:
    """The drive of this name below a folder. MapvoteError does not tell where that folder lies."""
    if not drives:
        raise MapvoteError(
            f"the policy judges versions by the drive {name}, and no folder of gate drives is stated here: start with "
            "--gate-drives DIR, or [server] gate_drives"
        )
    try:
        return open_drive(below(Path(drives), name, Path("gate.drive")))
    except MapvoteError as error:
        said = str(error).replace(f"{Path(drives)}{os.sep}", "")
        raise MapvoteError(f"gate.drive = {name}, below the folder of gate drives: {said}") from None


def gate(
    old: PointMap, new: PointMap, drive: Drive, settings: GateSettings, ndt: NdtSettings
) -> tuple[Verdict, list[str]]:
    """Localise a reference drive in both maps: "pass" only if the new one is at least as good within tolerance, "hold"
    if it is worse, "abstain" if this drive does not decide; and the reasons.

    ``drive`` needs prior poses in the map's frame, good to a metre or two. MapvoteError if it has none, or if the maps
    are not two versions of one map.
    """
    if old.map_id != new.map_id or old.lattice != new.lattice:
        raise MapvoteError(f"gate: {old.map_id!r} and {new.map_id!r} are not versions of one map")
    if drive.T_map_lidar_prior is None:
        raise MapvoteError(f"{drive.path}: the gate needs a drive with prior poses (prior.txt, or --prior FILE)")
    near = scans_near(old, new, drive.T_map_lidar_prior, GATE_RULE.reach_m)
    chosen = near[evenly(0, len(near) - 1, min(len(near), GATE_RULE.most_scans))]
    if len(chosen) < GATE_RULE.min_scans:
        reason = (
            f"only {len(near)} of {len(drive)} scans of {drive.vehicle}/{drive.drive_id} were taken within "
            f"{GATE_RULE.reach_m:g} m of what changed; the gate needs {GATE_RULE.min_scans}"
        )
        return "abstain", [reason]
    return pass_or_hold(compare(localise_in_both(old, new, drive, [int(i) for i in chosen], ndt), settings))


def scans_near(old: PointMap, new: PointMap, T_map_lidar_prior: F64, reach_m: float) -> np.ndarray:
    """Indices (k,) of the poses (n, 4, 4) within ``reach_m`` of a cell whose points differ between the maps."""
    differing = [
        changed_cells(old.tile(index), new.tile(index))
        for index in sorted(old.tiles.keys() | new.tiles.keys())
        if old.tiles.get(index) is not new.tiles.get(index)
    ]
    rows = np.concatenate([np.zeros(0), *[cells.rows for cells in differing]])
    cols = np.concatenate([np.zeros(0), *[cells.cols for cells in differing]])
    if not len(rows):
        return np.zeros(0, dtype=np.int64)
    middles = np.stack([cols + 0.5, rows + 0.5], axis=1) * CELL_SIZE + np.array([old.lattice.x0, old.lattice.y0])
    distance, _ = scipy.spatial.cKDTree(middles).query(T_map_lidar_prior[:, :2, 3], distance_upper_bound=reach_m)
    return np.flatnonzero(np.isfinite(distance))


def localise_in_both(
    old: PointMap, new: PointMap, drive: Drive, scans: Sequence[int], ndt: NdtSettings
) -> list[tuple[Localised, Localised]]:
    """(in the old map, in the new map) of each scan, de-skewed by the motion of the prior poses."""
    assert drive.T_map_lidar_prior is not None
    windows = MapWindow(old), MapWindow(new)
    pairs = []
    for i in scans:
        clouds = thin_for_levels(deskew(drive.read_scan(i), _prior_twist(drive, i)))
        prior = drive.T_map_lidar_prior[i]
        guesses = [
            prior @ from_xyz_rpy(GATE_RULE.start_m * np.cos(a), GATE_RULE.start_m * np.sin(a), 0.0, 0.0, 0.0, 0.0)
            for a in _START_ANGLES
        ]
        in_old, in_new = (_localise(window, clouds, prior, guesses, ndt) for window in windows)
        pairs.append((in_old, in_new))
    return pairs


def compare(pairs: Sequence[tuple[Localised, Localised]], settings: GateSettings) -> tuple[Measure, ...]:
    """Every figure with its gain and uncertainty. Errors of neighbouring scans are correlated: the spread is that of
    blocks."""
    kinds = (
        ("share of scans localised", "found", 1.0, settings.tolerance_found),
        ("inlier share", "inlier_share", 1.0, settings.tolerance_inlier_share),
        ("score", "score", 1.0, settings.tolerance_score),
        ("scatter in metres", "scatter_m", -1.0, settings.tolerance_scatter_m),
    )
    out = []
    for name, field, sign, tolerance in kinds:
        olds, news = (np.array([getattr(pair[side], field) for pair in pairs]) for side in (0, 1))
        blocks = np.array([b.mean() for b in np.array_split(sign * (news - olds), len(pairs) // GATE_RULE.block_scans)])
        spread = float(blocks.std(ddof=1)) / np.sqrt(len(blocks))
        uncertainty = float(scipy.special.stdtrit(len(blocks) - 1, 0.95)) * spread
        gain = float(sign * (news.mean() - olds.mean()))
        out.append(Measure(name, float(olds.mean()), float(news.mean()), gain, float(uncertainty), tolerance))
    return tuple(out)


def pass_or_hold(measures: Sequence[Measure]) -> tuple[Verdict, list[str]]:
    """hold if any figure is worse than tolerated; pass if none can be, even at its lower bound; else abstain."""
    worse = [str(m) for m in measures if m.gain < -m.tolerance]
    if worse:
        return "hold", [f"vehicles would localise worse: {text}" for text in worse]
    unsure = [str(m) for m in measures if not m.gain - m.uncertainty >= -m.tolerance]
    if unsure:
        return "abstain", [f"the scans leave open whether this got worse: {text}" for text in unsure]
    return "pass", [str(m) for m in measures]


def _localise(window: MapWindow, clouds: list[F32], prior: F64, guesses: list[F64], ndt: NdtSettings) -> Localised:
    ndt_map = window(prior[:3, 3])
    registrations = [ndt_map.refine(clouds, guess) for guess in guesses]
    best = max(registrations, key=lambda registration: registration.score)
    positions = np.array([registration.T_map_lidar[:3, 3] for registration in registrations])
    scatter = float(np.sqrt(((positions - positions.mean(axis=0)) ** 2).sum(axis=1).mean()))
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(best.covariance[:3, :3])[-1]))
    trusted = best.inlier_share >= ndt.min_inlier_share and sigma_m <= ndt.max_sigma_m
    return Localised(best.score, best.inlier_share, min(scatter, GATE_RULE.scatter_m), float(trusted))


def _prior_twist(drive: Drive, i: int) -> F64:
    """(6,) motion per second in the lidar frame around scan i, from the prior poses."""
    assert drive.T_map_lidar_prior is not None
    first = max(i - 1, 0)
    last = min(i + 1, len(drive) - 1)
    seconds = 1e-9 * float(drive.stamps_ns[last] - drive.stamps_ns[first])
    if first == last or seconds <= 0:
        return np.zeros(6)
    return twist_between(drive.T_map_lidar_prior[first], drive.T_map_lidar_prior[last], seconds)
