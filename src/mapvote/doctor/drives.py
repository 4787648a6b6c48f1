"""The doctor's round of one drive: cheap looks at every scan, then what registration measures."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from mapvote.core.types import F32, F64, Drive, MapvoteError
from mapvote.doctor.cheap import IN_MAP_FRAME, cheap_checks
from mapvote.doctor.finding import Finding, Progress, in_order
from mapvote.doctor.frames import check_agreement
from mapvote.doctor.looks import Looks, look_at_all
from mapvote.doctor.motion import Run, follow, starts_across, starts_of_runs
from mapvote.doctor.movement import check_scan_motion
from mapvote.doctor.prior import NO_PRIOR
from mapvote.doctor.road import Road, find_road
from mapvote.doctor.scatter import range_scatter_m
from mapvote.doctor.whole import CHAIN_SCANS
from mapvote.formats import open_drive
from mapvote.formats.drives.options import DriveOptions

_ROAD_SCANS = 7
_ROUGH_M = 0.12
_SCATTER_M = 0.25
"""Sound sensors show 0.02 to 0.04 m."""
_HIGHEST_M = 4.5
"""Of a sensor over the road."""


def open_for_examination(path: Path, options: DriveOptions) -> tuple[Drive | None, list[Finding]]:
    """(the drive, what stopped it from opening as it is): a broken prior hides nothing else."""
    try:
        return open_drive(path, **asdict(options)), []
    except MapvoteError as error:
        found = [Finding("error", str(error))]
    try:
        return open_drive(path, **asdict(replace(options, prior="none"))), found
    except MapvoteError:
        return None, found


def examine_drive(
    path: Path, options: DriveOptions | None = None, progress: Progress | None = None
) -> tuple[list[Finding], Drive | None, F64 | None]:
    """(findings, errors first; the drive; its poses as they would be mended), of the drive at ``path``."""
    drive, found = open_for_examination(path, options or DriveOptions())
    if drive is None:
        return found, None, None
    looks = look_at_all(drive, None if progress is None else lambda done, n: progress("looking at scans", done, n))
    more = cheap_checks(drive, looks)
    if found:  # the prior could not be read: that there is none, goes without saying
        more = [f for f in more if f != NO_PRIOR]
    found += more
    T = drive.T_map_lidar_prior
    if IN_MAP_FRAME in found:
        return in_order(found), drive, np.tile(np.eye(4), (len(drive), 1, 1))
    if len(looks.index) > 2:
        more, T = measure(drive, looks, progress)
        found += more
    return in_order(found), drive, T


def measure(drive: Drive, looks: Looks, progress: Progress | None = None) -> tuple[list[Finding], F64 | None]:
    """(what registration finds, the prior as it would be mended)."""
    T = drive.T_map_lidar_prior
    usable = np.flatnonzero(np.isin(np.arange(len(drive)), looks.index))
    some = usable[np.linspace(0, len(usable) - 1, min(len(usable), _ROAD_SCANS)).astype(np.int64)]
    scans = [drive.read_scan(int(i)) for i in some]
    road = find_road([scan.points for scan in scans])
    # Rays of another LiDAR begin elsewhere: beside each other in direction they end on other things.
    scatter_m = float(np.median([range_scatter_m(scan.by_lidar()[0][1].points) for scan in scans]))
    found = _check_ranges(scatter_m) + _check_road(road, scatter_m, T, some.tolist())
    median_m = float(np.median(looks.range_m[:, 1]))
    if not 1.5 <= median_m <= 150.0 or road.up != "+z":
        return found, T  # whatever else seems wrong may be its consequence

    def read(i: int) -> F32:
        return drive.read_scan(int(usable[i])).points

    spread = starts_of_runs(len(usable), None if T is None else T[usable])
    starts = dict.fromkeys([*spread, *starts_across(looks.leaps, len(usable))])
    runs = []
    for k, start in enumerate(starts):
        run = follow(read, int(start), len(usable), road)
        runs.append(Run(usable[run.indices], run.T_first_lidar, run.fit))
        if progress is not None:
            progress("registering scans", k + 1, len(starts))
    unsound = check_scan_motion(drive, runs)
    found += unsound
    runs = runs[: len(spread)]
    if T is None or unsound:  # what the scans do not show, the prior cannot be held against
        return found, T

    def chain() -> Run:
        run = follow(read, 0, len(usable), road, CHAIN_SCANS)
        return Run(usable[run.indices], run.T_first_lidar, run.fit)

    more, mended = check_agreement(drive, T, runs, road, float(np.median(looks.turns)), chain)
    return found + more, mended


def _check_ranges(scatter_m: float) -> list[Finding]:
    if scatter_m <= _SCATTER_M:
        return []
    what = f"ranges scatter by {scatter_m:.2f} m against those of the rays beside them (sound sensors: 0.01 to 0.04 m)"
    mend = "is the sensor calibrated, and does each point carry its own range? Such scans blur the map"
    return [Finding("error" if scatter_m > 2.0 * _SCATTER_M else "warning", what, mend)]


def _check_road(road: Road, scatter_m: float, T: F64 | None, indices: list[int]) -> list[Finding]:
    if road.up == "-z":
        what = f"the sensor is upside down: the road lies {road.depth_m:.1f} m above it (z points down)"
        mend = "negate y and z of every point (or only z, if right and left are right already)"
        return [Finding("error", what, mend)]
    if road.up != "+z":
        what = f"the points' axis {road.up} points up (the road lies {road.depth_m:.1f} m along its opposite), not z"
        mend = "turn the points to x forward, y left, z up (camera axes are x right, y down, z forward)"
        return [Finding("error", what, mend)]
    found = []
    rough = road.scatter_m > _ROUGH_M
    if not road.is_there or (rough and scatter_m <= _SCATTER_M):
        what = f"no road lies below the sensor (the fullest layer holds {road.share:.0%} of the near points"
        what += f", {road.scatter_m:.2f} m thick, its depth +-{road.unsteady_m:.2f} m from scan to scan)"
        mend = "are the lower beams missing, the points cut, or z measured from elsewhere?"
        return [Finding("warning", what, mend)]
    found.append(Finding("note", f"by the scans themselves the sensor stands {road.depth_m:.1f} m over the road"))
    if road.depth_m < 0.5:
        what = f"the road lies only {road.depth_m:.1f} m below the points' origin"
        found.append(Finding("warning", what, "are the points in the vehicle's frame? Give them in the sensor's"))
    if road.depth_m > _HIGHEST_M:
        what = f"the road lies {road.depth_m:.1f} m below the sensor: no vehicle is so high, the scans are too large"
        found.append(Finding("warning", what, f"are the points in feet (then it is {0.3048 * road.depth_m:.1f} m)?"))
    normal = road.normal if T is None else np.mean([T[i, :3, :3] @ road.normal for i in indices], axis=0)
    tilt_deg = float(np.degrees(np.arccos(np.clip(normal[2] / np.linalg.norm(normal), -1.0, 1.0))))
    if T is not None and tilt_deg > 4.0:
        pitch, roll = np.degrees(np.arcsin(-road.normal[0])), np.degrees(np.arcsin(road.normal[1]))
        own = f"in the scans: pitch {pitch:.1f}, roll {roll:.1f}"
        what = f"by prior and scans the road is tilted by {tilt_deg:.1f} deg ({own})"
        mend = "level the points by that, or put the sensor's tilt into the prior's rotations; on a hill all is well"
        found.append(Finding("error" if tilt_deg > 8.0 else "warning", what, mend))
    return found
