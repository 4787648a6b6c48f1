"""Every matcher of the table on one recorded drive: the map holds every other scan, the scans between are localised.

    python benchmarks/matchers.py ../shared/data/kitti/2011_09_26_0001 --matchers ndt,vgicp

The map lies at the poses of poses.txt, which also score. Priors are those of the drive. Prints a line per matcher:
scans, lost, median and worst error, CPU per scan.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from mapvote.config import Settings
from mapvote.core.geometry import transform
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.types import F64, Drive, PosePrior
from mapvote.formats import open_drive
from mapvote.matching.localiser import Localiser
from mapvote.matching.odometry import Fix
from mapvote.matching.prepare import deskew, motion_at


def map_of_every_other(drive: Drive, T_map_lidar: F64) -> PointMap:
    """The points of scans 0, 2, 4 .. at their reference poses, one per .2 m."""
    clouds = []
    for i in range(0, len(drive), 2):
        points = deskew(drive.read_scan(i), motion_at(drive.stamps_ns, T_map_lidar, i))
        near = np.linalg.norm(points, axis=1) < 60.0
        clouds.append(transform(T_map_lidar[i], points[near].astype(np.float64)))
    points = np.concatenate(clouds)
    _, first = np.unique(np.floor(points / 0.2).astype(np.int64), axis=0, return_index=True)
    return map_from_points(points[first])


def localised(drive: Drive, point_map: PointMap, matcher: str) -> tuple[list[Fix], float]:
    """The fixes of scans 1, 3, 5 .., and CPU milliseconds per scan without reading."""
    settings = Settings.model_validate({"ndt": {"matcher": matcher}})
    localiser = Localiser(point_map, settings, drive.sensor)
    assert drive.T_map_lidar_prior is not None
    fixes: list[Fix] = []
    seconds = 0.0
    for i in range(1, len(drive), 2):
        scan = drive.read_scan(i)
        prior = PosePrior(drive.T_map_lidar_prior[i], drive.prior_sigma_m, float(np.radians(drive.prior_sigma_deg)))
        start = time.process_time()
        fixes += localiser.push(scan, prior)
        seconds += time.process_time() - start
    start = time.process_time()
    fixes += localiser.flush()
    seconds += time.process_time() - start
    return fixes, 1000.0 * seconds / len(fixes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--matchers", default="ndt,vgicp")
    chosen = parser.parse_args()
    drive = open_drive(chosen.drive)
    T_map_lidar = np.loadtxt(chosen.drive / "poses.txt").reshape(-1, 3, 4)
    T_map_lidar = np.concatenate([T_map_lidar, np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(T_map_lidar), 1, 1))], axis=1)
    point_map = map_of_every_other(drive, T_map_lidar)
    print("| Matcher | Scans | Lost | Median, m | Worst, m | CPU, ms a scan |")
    print("|---|---|---|---|---|---|")
    for matcher in chosen.matchers.split(","):
        localised(drive, point_map, matcher)  # compiles
        fixes, milliseconds = localised(drive, point_map, matcher)
        positions = np.array([fix.registration.T_map_lidar[:3, 3] for fix in fixes])
        trusted = np.array([fix.trusted for fix in fixes])
        off_m = np.linalg.norm(positions - T_map_lidar[1::2, :3, 3], axis=1)[trusted]
        lost = int((~trusted).sum())
        print(
            f"| {matcher} | {len(fixes)} | {lost} | {np.median(off_m):.3f} | {off_m.max():.3f} | {milliseconds:.0f} |"
        )


if __name__ == "__main__":
    main()
