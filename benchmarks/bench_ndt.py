"""NDT against small_gicp's VGICP, call by call in one interleaved run: milliseconds, their ratio, and the errors.

    python benchmarks/bench_ndt.py [SIMULATED_FOLDER]

SIMULATED_FOLDER is what ``mapvote simulate`` wrote; without one the scenario ``corner`` is simulated first. Both get
the same map (built by our SLAM from the surveys), the same de-skewed scans, and the same guess 0.3 m and 0.5 deg off.
A call is everything from the raw scan on: thinning or preprocessing included, building the target not. One thread.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import small_gicp

from mapvote.core.geometry import from_xyz_rpy, inverse, rotation_angle
from mapvote.core.types import F64
from mapvote.formats import open_drive, read_T_map_lidar
from mapvote.localisation.map_window import window_points
from mapvote.localisation.ndt import CENTRAL_M, build_ndt, register
from mapvote.localisation.prepare import deskew, motion_at
from mapvote.slam.build import build_map
from mapvote_lab.simulation import simulate


def vgicp(target: small_gicp.GaussianVoxelMap, points: F64, guess: F64) -> F64:
    """small_gicp as its documentation advises: 0.5 m down-sampling, covariances of 10 neighbours, 1 m voxels."""
    source, _ = small_gicp.preprocess_points(points, downsampling_resolution=0.5, num_neighbors=10, num_threads=1)
    result = small_gicp.align(target, source, guess, num_threads=1, max_iterations=30)
    return np.asarray(result.T_target_source)


def main(folder: Path) -> None:
    point_map, _ = build_map([open_drive(path) for path in sorted(folder.glob("survey_*"))])
    drive = open_drive(folder / "v1")
    truth = read_T_map_lidar(folder / "truth" / "v1" / "poses.txt", folder / "v1")
    rng = np.random.default_rng(1)
    milliseconds: dict[str, list[float]] = {"ndt": [], "vgicp": []}
    shifts: dict[str, list[float]] = {"ndt": [], "vgicp": []}
    turns: dict[str, list[float]] = {"ndt": [], "vgicp": []}
    # Coordinates near zero for both: VGICP's voxels hold float32 offsets.
    middle = truth[len(truth) // 2, :3, 3]
    points = window_points(point_map, middle)
    ndt_map = build_ndt(points, middle)
    cloud, _ = small_gicp.preprocess_points(points, downsampling_resolution=0.3, num_neighbors=10, num_threads=1)
    target = small_gicp.GaussianVoxelMap(1.0)
    target.insert(cloud)
    near = np.flatnonzero(np.abs(truth[:, :3, 3] - middle).max(axis=1) < CENTRAL_M)
    for k, i in enumerate([near[0], *near]):  # the first call only warms up
        scan = drive.read_scan(int(i))
        scan_points = deskew(scan, motion_at(drive.stamps_ns, truth, int(i)))
        scan_points_f64 = scan_points.astype(np.float64)
        way, yaw = rng.uniform(0, 2 * np.pi), np.radians(rng.choice([-0.5, 0.5]))
        guess = truth[i] @ from_xyz_rpy(0.3 * np.cos(way), 0.3 * np.sin(way), 0, 0, 0, yaw)
        for name in ("ndt", "vgicp") if k % 2 else ("vgicp", "ndt"):
            start = time.perf_counter()
            if name == "ndt":
                T = register(ndt_map, scan_points, guess, first_level=1).T_map_lidar
            else:
                T = vgicp(target, scan_points_f64, guess)
            elapsed = 1e3 * (time.perf_counter() - start)
            if k:
                milliseconds[name].append(elapsed)
                shifts[name].append(float(np.linalg.norm(T[:3, 3] - truth[i, :3, 3])))
                turns[name].append(float(np.degrees(rotation_angle(inverse(truth[i]) @ T))))
    print(f"{len(near)} scans of about {len(scan_points)} points, map of {len(points)} points")
    for name, ms in milliseconds.items():
        print(
            f"{name:6s} median {np.median(ms):6.1f} ms  90 % {np.quantile(ms, 0.9):6.1f} ms   error median "
            f"{np.median(shifts[name]):.3f} m {np.median(turns[name]):.3f} deg, most {max(shifts[name]):.3f} m"
        )
    ratio = np.median(np.array(milliseconds["vgicp"]) / np.array(milliseconds["ndt"]))
    print(f"VGICP takes {ratio:.2f} times as long as NDT (median over scans of the ratio on the same scan)")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as scratch:
            simulate("corner", Path(scratch) / "corner", seed=1)
            main(Path(scratch) / "corner")
