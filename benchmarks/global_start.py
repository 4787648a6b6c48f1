"""Finding a vehicle anywhere in a map, without any prior: one scan at a time, any heading.

    python benchmarks/global_start.py [--streets 5] [--starts 300] [--first 0] [--kitti ../shared/data/kitti]

Simulated: bent streets of 1.2 km of other seeds side by side, a square kilometre with five; each is mapped by scans at
their true places, one way, and driven by another vehicle, the other way. A start is one of its scans, de-skewed by
nobody, turned by any angle. KITTI: every scan in the map of the other blocks. Right is within 0.3 m and 1 deg (a single
scan of a moving sensor: 0.5 m), trusted what the vehicle would go on from. CPU seconds of one core; the first search,
which lays the map out, is not counted.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapvote.config import Settings
from mapvote.core.geometry import from_xyz_rpy, inverse, rotation_angle, transform
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.types import F64, Scan
from mapvote.core.voxels import thin
from mapvote.localisation.global_search import GlobalSearch
from mapvote.localisation.pose_check import MIN_FIT, MIN_LEAD
from mapvote.localisation.prepare import deskew, motion_at
from survey_gnss import bent_drives
from trust import kitti

SETTINGS = Settings()
APART_M = 130.0
LENGTH_M = 1200.0
EVERY = 3
"""Scans, 6.6 m apart."""
Start = tuple[Scan, F64]
"""A scan and where it was taken."""


def streets(count: int) -> tuple[PointMap, list[tuple[int, int]]]:
    """The map of ``count`` streets, and the (street, scan) that may be starts."""
    clouds, roads, starts = [], [], []
    for k in range(count):
        (there, back), (T_there, _) = bent_drives(LENGTH_M, 21 + k)
        aside = from_xyz_rpy(0.0, APART_M * k, 0.0)
        for i in range(0, len(there), EVERY):
            points = deskew(there.read_scan(i), motion_at(there.stamps_ns, T_there, i))
            clouds.append(transform(aside @ T_there[i], points[thin(points, 0.3)]))
        roads.append((aside @ T_there)[:, :3, 3] - [0.0, 0.0, 1.9])
        starts += [(k, i) for i in range(len(back))]
    cloud = np.concatenate(clouds)
    return map_from_points(cloud[thin(cloud, 0.3)], road=np.concatenate(roads)), starts


def simulated_starts(chosen: list[tuple[int, int]], rng: np.random.Generator) -> Iterator[Start]:
    """The scans of these (street, scan), each turned by any angle."""
    for k in sorted({k for k, _ in chosen}):
        (_, back), (_, T_back) = bent_drives(LENGTH_M, 21 + k)
        for i in [i for street, i in chosen if street == k]:
            turn = from_xyz_rpy(0.0, 0.0, 0.0, yaw=rng.uniform(-np.pi, np.pi))
            scan = back.read_scan(i)
            turned = replace(scan, points=transform(turn, scan.points).astype(np.float32))
            yield turned, from_xyz_rpy(0.0, APART_M * k, 0.0) @ T_back[i] @ inverse(turn)


def measure(name: str, point_map: PointMap, starts: Iterator[Start], range_sigma_m: float, near_m: float) -> None:
    """One row: how many were found, trusted, wrong; error and time."""
    search = GlobalSearch(point_map, SETTINGS.ndt, range_sigma_m)
    right, trusted, astray, seconds, off_m = 0, 0, 0, [], []
    n = 0
    for n, (scan, true) in enumerate(starts, 1):
        if n == 1:
            search.find(scan)
        began = time.process_time()
        found = search.find(scan)
        seconds.append(time.process_time() - began)
        if found is None:
            continue
        off = inverse(true) @ found.T_map_lidar
        is_right = np.linalg.norm(off[:3, 3]) < near_m and rotation_angle(off) < np.radians(1.0)
        believed = found.fit >= MIN_FIT and found.lead >= MIN_LEAD
        right += bool(is_right and believed)
        trusted += believed
        astray += bool(believed and not is_right)
        off_m += [float(np.linalg.norm(off[:3, 3]))] if is_right else []
    windows = [tile.window for tile in point_map.tiles.values()]
    wide = max(w.x0 for w in windows) - min(w.x0 for w in windows) + 76.8
    high = max(w.y0 for w in windows) - min(w.y0 for w in windows) + 76.8
    print(
        f"| {name} | {1e-6 * wide * high:.2f} km² | {n} | {right} | {astray} | {n - trusted} | "
        f"{np.median(off_m or [np.nan]):.2f} | {np.median(seconds):.1f} | {max(seconds):.1f} |", flush=True,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--streets", type=int, default=0)
    parser.add_argument("--starts", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="of the 300 starts, to go on in slices")
    parser.add_argument("--kitti", type=Path)
    arguments = parser.parse_args()
    print("| map | box | starts | right and trusted | wrong and trusted | abstained | error, m | CPU, s | most |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    if arguments.kitti:
        for folder in sorted(arguments.kitti.glob("*")):
            for cases, odd in ((kitti(folder), "other"), (kitti(folder, first=1), "mapped")):
                point_map = cases[0][0]
                starts = ((drive.read_scan(i), T[i]) for _, drive, T in cases for i in range(len(drive)))
                measure(f"KITTI {folder.name}, {odd} blocks", point_map, starts, cases[0][1].sensor.range_sigma_m, 0.3)
    if arguments.streets:
        point_map, every = streets(arguments.streets)
        rng = np.random.default_rng(5)
        order = rng.permutation(len(every))[arguments.first : arguments.first + arguments.starts]
        chosen = [every[k] for k in order.tolist()]
        measure(f"{arguments.streets} streets", point_map, simulated_starts(chosen, rng), 0.02, 0.5)


if __name__ == "__main__":
    main()
