"""Do the times of points, as they were read, straighten the scans? A map tells: bent scans fit it worse.

At 10 m/s a scan that is not de-skewed is bent by a metre. Whoever reads it as motion-compensated votes walls away that
stand. Nothing in a file tells that its points are compensated, or that its times run backwards. So some scans along the
drive are registered once more, each with other times: none, and those of a sensor that spins clockwise or
counter-clockwise. None of 8 scans of a simulated street at 11 m/s fits better than with its own times: compensated
points fit .04 to .08 worse with times from azimuths, others as much better.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.sampling import evenly
from mapvote.core.types import F32, F64, I64, Drive, MapvoteError, Scan
from mapvote.doctor import Finding
from mapvote.formats.drives.point_fields import spinning_time_s
from mapvote.matching.ndt_map import MapWindow
from mapvote.matching.ndt_voxels import LEVELS
from mapvote.matching.prepare import Sample, motion_at


@record()
@dataclass(frozen=True, slots=True)
class BentScans:
    """Numbers of the check that points have the times as read."""

    scans: int = 8
    """Scans that are registered again, evenly along the drive."""
    least_scans: int = 4
    """Least number of scans for a verdict."""
    least_speed_mps: float = 3.0
    """Scans of a slower sensor are not used, metres per second: they hardly bend."""
    unsteady_mps: float = 1.5
    """Scans whose speeds over two steps and over six differ by more are not used, metres per second."""
    better: float = 1.02
    """Least ratio of the median score with other times to that with the times as read."""
    share: float = 0.75
    """Least share of the scans that must fit better."""


BENT_SCANS = BentScans()
_AS_READ, _NONE, _CLOCKWISE, _COUNTER = "as read", "none", "clockwise", "counter-clockwise"


def window_for(point_map: PointMap, localised: bool) -> MapWindow:
    """The map as scans are registered in it once more: by the finest level alone if their poses are ``localised``."""
    return MapWindow(point_map, LEVELS[-1:] if localised else LEVELS)


def check_bent(drive: Drive, T_map_lidar: Sequence[F64], around: MapWindow) -> Iterator[Finding]:
    """Other times of points that fit the map clearly better than those of the drive. ``T_map_lidar``: poses of its
    scans, (4, 4) each, localised or of a prior, which may be off by a metre; ``around``: :func:`window_for` them."""
    poses = np.array(T_map_lidar)
    stamps_ns = drive.stamps_ns[: len(poses)]
    if len(poses) < 3:
        return
    scores: dict[str, list[float]] = {}
    times = None
    for i in evenly(1, len(poses) - 2, BENT_SCANS.scans).tolist():
        twist = _steady_motion(stamps_ns, poses, i)
        if twist is None:
            continue
        try:
            scan = drive.read_scan(i)
        except MapvoteError:  # its own finding
            continue
        if scan.others or not drive.sensor.rings:
            return
        times = scan.times or times
        ndt_map = around(poses[i, :3, 3])
        for name, time_s in _readings(scan, drive).items():
            clouds = Sample(replace(scan, time_s=time_s)).clouds(twist)
            score = ndt_map.refine(clouds, poses[i]).score
            scores.setdefault(name, []).append(score)
    best = _best(scores)
    if best is not None:
        how = "none" if times is None else times.how
        yield _finding(best, how, np.array(scores[_AS_READ]), np.array(scores[best]))


def _steady_motion(stamps_ns: I64, poses: F64, i: int) -> F64 | None:
    """(6,) motion per second at scan i; None if it is slow, or changes so much that the poses seem to jump."""
    twist = motion_at(stamps_ns, poses, i)
    span = slice(max(i - 3, 0), i + 4, 3)
    longer = motion_at(stamps_ns[span], poses[span], 1)
    slow = np.linalg.norm(twist[:3]) < BENT_SCANS.least_speed_mps
    return None if slow or np.linalg.norm(twist[:3] - longer[:3]) > BENT_SCANS.unsteady_mps else twist


def _readings(scan: Scan, drive: Drive) -> dict[str, F32 | None]:
    """Times (n,) of the points by the name of each reading."""
    turned = spinning_time_s(scan.points, drive.sensor.rate_hz)
    out = {_AS_READ: scan.time_s, _CLOCKWISE: turned, _COUNTER: -turned}
    return out if scan.time_s is None else {**out, _NONE: None}


def _best(scores: dict[str, list[float]]) -> str | None:
    """The reading that fits clearly better than the one as read, if any does."""
    if len(scores.get(_AS_READ, ())) < BENT_SCANS.least_scans:
        return None
    as_read = np.array(scores[_AS_READ])
    better = {}
    for name, fits in scores.items():
        ratio = np.array(fits) / np.maximum(as_read, 1e-6)
        if np.median(ratio) > BENT_SCANS.better and (ratio > 1.0).mean() >= BENT_SCANS.share:
            better[name] = float(np.median(ratio))
    return max(better, key=lambda name: better[name]) if better else None


def _finding(best: str, how: str, as_read: F64, fits: F64) -> Finding:
    """The finding in words: a warning if the user stated the times."""
    shown = f"{(fits > as_read).sum()} of {len(fits)} scans fit the map better ({np.median(fits):.2f}, as read "
    shown += f"{np.median(as_read):.2f})"
    if best == _NONE:
        problem = f"the points are motion-compensated already: without their times {shown}"
        return Finding("error", problem, "set motion_compensated = true in drive.toml")
    problem = f"the points are not motion-compensated: with times of a sensor that spins {best} {shown}"
    if how == "field":
        problem = f"the times of points do not belong to them: with times of a sensor that spins {best} {shown}"
    field = 'time_field = "none" and ' if how == "field" else ""
    spin = "" if best == _CLOCKWISE else ", and clockwise = false in its table [sensor]"
    return Finding("error", problem, f"set {field}motion_compensated = false in drive.toml{spin}")
