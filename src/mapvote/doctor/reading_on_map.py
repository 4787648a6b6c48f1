"""Which of the readings that a drive alone does not tell apart does its map confirm?

A straight drive moves alike under many a mistake. Each reading lays some scans elsewhere in the map: under the right
one they fit there. Mirrored scans are mirrored back before they are registered.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.types import F64, Drive, Scan
from mapvote.doctor import Finding, Progress, Reading
from mapvote.doctor.map_fit import MapEvidence, fitting
from mapvote.doctor.prior import AS_IT_IS


@record()
@dataclass(frozen=True, slots=True)
class ReadingRules:
    """When a map confirms a reading."""

    least_share: float = 0.6
    """Share of the scans checked that must fit under it."""
    clearly: float = 1.25
    """Factor by which the fits of a reading, summed over the scans, are smaller than the best one's if it is ruled
    out."""
    sigmas: float = 3.0
    """Standard deviations of the prior that a reading's poses may be off those found in the map."""
    off_m: float = 0.5
    """Metres that they may be off besides."""


RULES = ReadingRules()


@dataclass(frozen=True, slots=True)
class ReadOnMap:
    """How the scans checked lie on the map under a reading."""

    fit: int
    """How many of them fit it."""
    scans: int
    """How many were checked."""
    total: float
    """The sum of their fits."""
    off_m: float
    """How far those that fit lie from where the reading has them, median; inf if none fits."""


def decided_by_map(
    findings: Sequence[Finding], drive: Drive, point_map: PointMap, progress: Progress | None = None
) -> tuple[list[Finding], F64 | None]:
    """(the findings, those that leave readings open decided where the map tells; the prior (n, 4, 4) under the reading
    that it confirms, None if there is none such)."""
    T = drive.T_map_lidar_prior
    out = list(findings)
    errors = [f for f in out if f.severity == "error"]
    # Each of several errors may hide the effect of the others on the scans.
    if T is None or len(errors) > 1:
        return out, None
    for k, finding in enumerate(out):
        if not finding.readings or (errors and finding is not errors[0]):
            continue
        readings = finding.readings if finding.severity == "error" else (AS_IT_IS, *finding.readings)
        on_map = [_fit_under(reading, drive, T, point_map, progress) for reading in readings]
        best = confirmed(on_map, drive.prior_sigma_m)
        if best is None or readings[best] is AS_IT_IS:
            continue
        reading = readings[best]
        its = on_map[best]
        problem = (
            f"{reading.name}: so {its.fit} of {its.scans} scans checked fit the map, {its.off_m:.1f} m from the prior"
        )
        others = [one for i, one in enumerate(on_map) if i != best]
        if others:
            next_best = max(others, key=lambda one: one.total)
            distance = f", {next_best.off_m:.1f} m from it" if next_best.fit else ""
            problem += f"; read otherwise at best {next_best.fit}{distance}"
        out[k] = Finding("error", problem, reading.mend)
        return out, reading.poses(T)
    return out, None


def _fit_under(reading: Reading, drive: Drive, T: F64, point_map: PointMap, progress: Progress | None) -> ReadOnMap:
    """How the scans lie on the map by poses T (n, 4, 4) under a reading."""
    poses = reading.poses(T)
    if np.linalg.det(poses[0, :3, :3]) < 0.0:
        poses = poses @ np.diag([1.0, -1.0, 1.0, 1.0])
        drive = replace(drive, read_scan=_mirrored(drive))
    evidence = MapEvidence(drive, poses, point_map, progress)
    places = evidence.places({i: [poses[i]] for i in evidence.scans})
    off_m = [float(np.linalg.norm((p.T_map_lidar - poses[p.index])[:3, 3])) for p in fitting(places)]
    median_m = float(np.median(off_m)) if off_m else float("inf")
    return ReadOnMap(len(off_m), len(places), sum(place.fit for place in places), median_m)


def _mirrored(drive: Drive) -> Callable[[int], Scan]:
    def read(i: int) -> Scan:
        scan = drive.read_scan(i)
        mirror = np.diag(np.array([1.0, -1.0, 1.0], dtype=np.float32))
        return replace(scan, points=np.ascontiguousarray(scan.points @ mirror))

    return read


def confirmed(on_map: Sequence[ReadOnMap], sigma_m: float, rules: ReadingRules = RULES) -> int | None:
    """Which reading the map confirms before all others; None if none. The next street may look alike: of readings under
    which the scans fit as well, one counts that has them where the prior's error ``sigma_m`` allows."""
    most = max(one.total for one in on_map)
    left = [
        k
        for k, one in enumerate(on_map)
        if one.fit >= rules.least_share * one.scans and one.total > most / rules.clearly
    ]
    if len(left) > 1:
        left = [k for k in left if on_map[k].off_m <= rules.off_m + rules.sigmas * sigma_m]
    return left[0] if len(left) == 1 else None
