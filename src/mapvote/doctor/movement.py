"""Do the scans move as scans of one drive do, in the order of the files, and not along with the prior?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapvote.core.types import F64, Drive
from mapvote.doctor.finding import Finding
from mapvote.doctor.looks import Looks
from mapvote.doctor.motion import Run, agree_with_time

_FAR_M = 50.0
"""Points in the sensor's frame lie around it: their mean is never so far from the origin."""
_LEAST_FIT = 0.55
"""Sound scans, a step apart, agree in .75 to .95 of their points; scans of different places in .2 to .5."""


def check_scan_motion(drive: Drive, runs: Sequence[Run]) -> list[Finding]:
    """Do consecutive scans fit each other, and follow each other as a vehicle moves?"""
    fit = float(np.median([np.median(run.fit[1:]) for run in runs]))
    broken = [run for run in runs if np.median(run.fit[1:]) < _LEAST_FIT]
    mend = "are the files in order of time (names, times.txt), of one drive, and whole?"
    if len(broken) > 0.5 * len(runs):
        what = f"scans do not fit those before them: {fit:.0%} of the points agree, of sound drives 75 to 95 %"
        return [Finding("error", what, mend)]
    leaps = np.concatenate([~agree_with_time(run, drive.stamps_ns) for run in runs])
    if len(leaps) and leaps.mean() > 0.25:
        what = f"the vehicle would brake or start as none can in {leaps.mean():.0%} of the steps"
        return [Finding("error", f"the scans leap: they are out of order, or their times are wrong ({what})", mend)]
    speed = [run.length_m / (1e-9 * float(np.diff(drive.stamps_ns[run.indices[[0, -1]]])[0])) for run in runs]
    if np.median(speed) > 70.0:
        what = f"by scans and times the vehicle drives at {np.median(speed):.0f} m/s"
        return [Finding("error", what, "check the times (seconds), and that the points are metres")]
    if broken:
        first, last = broken[0].indices[[0, -1]]
        what = f"scans {first} to {last} do not fit each other ({len(broken)} of {len(runs)} places looked at)"
        return [Finding("error", what, mend)]
    return []


def in_map_frame(T: F64, looks: Looks) -> bool:
    """Whether the points lie around the prior, or move along with it: then they are in the map's frame already."""
    away_m = float(np.median(np.linalg.norm(T[looks.index, :3, 3], axis=1)))
    off_m = float(np.median(np.linalg.norm(looks.mean - T[looks.index, :3, 3], axis=1)))
    if away_m > _FAR_M and off_m < 0.5 * away_m:
        return True
    p, centre = T[looks.index, :2, 3], looks.mean[:, :2]
    spread = p - p.mean(axis=0)
    if len(p) < 5 or np.linalg.norm(p.max(axis=0) - p.min(axis=0)) < 8.0:
        return False
    slope = float((spread * (centre - centre.mean(axis=0))).sum() / (spread**2).sum())
    off = np.linalg.norm((centre - centre.mean(axis=0)) - spread, axis=1)
    return 0.8 < slope < 1.2 and float(np.median(off)) < 0.4 * float(np.median(np.linalg.norm(spread, axis=1)))
