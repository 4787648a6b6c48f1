"""What is wrong with this drive, and how to mend it: a list of findings, each with its reason."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from mapvote.core.point_map import PointMap
from mapvote.core.types import MapvoteError, Scan
from mapvote.formats import open_drive
from mapvote.formats.doctor.basics import check_prior, check_scans, check_times
from mapvote.formats.doctor.finding import Finding
from mapvote.formats.doctor.frames import UPS, check_frames, check_up, up_axis
from mapvote.formats.doctor.overlap import check_ground, check_overlap
from mapvote.formats.drives.options import DriveOptions

__all__ = ["Finding", "examine"]


def examine(
    path: Path, options: DriveOptions | None = None, point_map: PointMap | None = None, samples: int = 12
) -> list[Finding]:
    """Everything the doctor finds in the drive at ``path``; errors first. Reads ``samples`` scans and some pairs."""
    options = options or DriveOptions()
    found: list[Finding] = []
    try:
        drive = open_drive(path, **asdict(options))
    except MapvoteError as error:
        found.append(Finding("error", str(error)))
        try:  # a broken prior hides nothing else
            drive = open_drive(path, **asdict(replace(options, prior="none")))
        except MapvoteError:
            return found
    found += [] if point_map is None else check_ground(point_map)
    found += check_times(drive)
    if drive.T_map_lidar_prior is not None:
        found += check_prior(drive)
    elif not found:
        mend = "write prior.txt (3 x 4 rows T_map_lidar), or expect to be asked for the first pose"
        found.append(Finding("warning", "no prior: the vehicle must find itself in the map", mend))
    scans: dict[int, Scan] = {}
    refused: list[str] = []
    for i in np.unique(np.linspace(0, len(drive) - 1, samples).astype(int)).tolist():
        try:
            scans[i] = drive.read_scan(i)
        except MapvoteError as error:
            refused.append(str(error))
    if refused:
        others = f" (and {len(refused) - 1} more of {samples} scans looked at)" if len(refused) > 1 else ""
        found.append(Finding("error", refused[0] + others))
    if scans:
        found += check_scans(drive, list(scans.values()))
        up, depth_m = up_axis([s.points for s in scans.values()])
        found += check_up(up, depth_m)
        if up == "+z":
            found.append(Finding("note", f"by the scans themselves the sensor stands {depth_m:.1f} m over the road"))
        # With another axis up, whatever else seems wrong may be its consequence.
        if up == "+z" and drive.T_map_lidar_prior is not None and len(drive) > 1:
            found += check_frames(drive, drive.T_map_lidar_prior, UPS[up], depth_m)
            if point_map is not None:
                found += check_overlap(drive.T_map_lidar_prior, scans, point_map, drive.prior_sigma_m)
    order = {"error": 0, "warning": 1, "note": 2}
    return sorted(found, key=lambda f: order[f.severity])
