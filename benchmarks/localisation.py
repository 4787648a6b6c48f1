"""Localisation in a simulated street, in the map that our own SLAM built: errors, abstentions, honesty, wrong starts.

    python benchmarks/localisation.py paper:4 street:2       simulate SCENARIO:SEED, build, drive, report
    python benchmarks/localisation.py --folder SIMULATED     the same on what ``mapvote simulate`` wrote

Errors are taken twice: against the truth as it is, and in the map's frame (the surveys' trajectory rigidly aligned to
the truth first), because a vote only needs the map. Abstentions count as failures. NEES is the normalised squared
error, 6 if covariances are right. The wrong starts are 1 m in a random direction and 3 deg in yaw off the truth.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from mapvote.config import Settings
from mapvote.core.geometry import exp, inverse, log, rotation_angle
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64
from mapvote.formats import open_drive, read_T_map_lidar
from mapvote.localisation.map_window import MapWindow
from mapvote.localisation.ndt import PosePrior, register
from mapvote.localisation.odometry import Tracker
from mapvote.localisation.prepare import deskew, motion_at
from mapvote.slam.build import build_map
from mapvote_lab.simulation import simulate

SETTINGS = Settings()


def truth_of(folder: Path, name: str) -> F64:
    return read_T_map_lidar(folder / "truth" / name / "poses.txt", folder / name)


def map_offset(found: F64, true: F64) -> F64:
    """(4, 4) T_truth_map: the mean rotation first (chordal), then the mean shift that is left."""
    U, _, Vt = np.linalg.svd(np.einsum("nij,nkj->ik", true[:, :3, :3], found[:, :3, :3]))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    T[:3, 3] = true[:, :3, 3].mean(axis=0) - T[:3, :3] @ found[:, :3, 3].mean(axis=0)
    return T


def pose_error(T: F64, true: F64) -> F64:
    """(6,) (rho, phi) in map axes, as Registration.covariance has it."""
    turn = np.eye(4)
    turn[:3, :3] = T[:3, :3] @ true[:3, :3].T
    return np.r_[T[:3, 3] - true[:3, 3], log(turn)[3:]]


def tell(name: str, errors: F64, trusted: F64) -> None:
    shift = np.where(trusted, np.linalg.norm(errors[:, :3], axis=1), np.inf)
    turn = np.degrees(np.linalg.norm(errors[:, 3:], axis=1))
    far = float(np.quantile(shift, 0.99))
    middle = f"median {np.median(shift):.3f} m {np.median(turn):.3f} deg"
    print(f"  {name:22s} {middle}   99 % {far:.3f} m   below 0.2 m {np.mean(shift < 0.2):.4f}")


def drives(folder: Path, point_map: PointMap, T_truth_map: F64, prior_only_once: bool) -> None:
    raw, in_map, trusted, nees, ms = [], [], [], [], []
    for path in sorted(folder.glob("v*")):
        drive, true = open_drive(path), truth_of(folder, path.name)
        assert drive.T_map_lidar_prior is not None
        tracker = Tracker(MapWindow(point_map), SETTINGS.ndt)
        for i, scan in enumerate(drive):
            prior = PosePrior(drive.T_map_lidar_prior[i], drive.prior_sigma_m, np.radians(drive.prior_sigma_deg))
            start = time.perf_counter()
            fix = tracker.localise(scan, None if prior_only_once and i else prior)
            ms.append(1e3 * (time.perf_counter() - start))
            raw.append(pose_error(fix.registration.T_map_lidar, true[i]))
            in_map.append(pose_error(T_truth_map @ fix.registration.T_map_lidar, true[i]))
            trusted.append(fix.trusted)
            nees.append(in_map[-1] @ np.linalg.solve(fix.registration.covariance, in_map[-1]))
    print(f" {'prior for the first scan only' if prior_only_once else 'prior with every scan'}: {len(ms)} scans")
    tell("against the truth", np.array(raw), np.array(trusted))
    tell("in the map's frame", np.array(in_map), np.array(trusted))
    print(f"  coverage {np.mean(trusted):.4f}   NEES mean {np.mean(nees):.1f}   {np.median(ms):.1f} ms a scan (median)")


def starts(folder: Path, point_map: PointMap, T_truth_map: F64, count: int = 300) -> None:
    rng = np.random.default_rng(7)
    names = [path.name for path in sorted(folder.glob("v*"))]
    found = []
    for _ in range(count):
        name = names[int(rng.integers(len(names)))]
        drive, true = open_drive(folder / name), inverse(T_truth_map) @ truth_of(folder, name)
        i = int(rng.integers(1, len(drive) - 1))
        way, yaw = rng.uniform(0, 2 * np.pi), np.radians(3.0) * rng.choice([-1.0, 1.0])
        guess = true[i].copy()
        guess[:3, :3] = exp([0, 0, 0, 0, 0, yaw])[:3, :3] @ guess[:3, :3]
        guess[:3, 3] += [np.cos(way), np.sin(way), 0.0]
        points = deskew(drive.read_scan(i), motion_at(drive.stamps_ns, true, i))
        result = register(MapWindow(point_map)(guess[:3, 3]), points, guess)
        found.append(float(np.linalg.norm(result.T_map_lidar[:3, 3] - true[i, :3, 3])) < 0.2)
    print(f" {count} starts 1 m / 3 deg off: {np.mean(found):.3f} end within 0.2 m")


def report(folder: Path) -> None:
    surveys = [open_drive(path) for path in sorted(folder.glob("survey_*"))]
    start = time.perf_counter()
    point_map, built = build_map(surveys, SETTINGS)
    seconds = time.perf_counter() - start
    found = np.concatenate([track.T_map_lidar for track in built.tracks])
    true = np.concatenate([truth_of(folder, path.name) for path in sorted(folder.glob("survey_*"))])
    T_truth_map = map_offset(found, true)
    away = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1)
    turn = np.degrees(rotation_angle(T_truth_map))
    shift = found[:, :3, 3].mean(axis=0) - true[:, :3, 3].mean(axis=0)
    print(f" map of {len(found)} scans built in {seconds:.0f} s; survey poses off the truth by {np.median(away):.3f} m")
    print(
        f" (median), {away.max():.3f} m (most); as a whole shifted by {np.round(shift, 3)} m, turned by {turn:.3f} deg"
    )
    drives(folder, point_map, T_truth_map, prior_only_once=False)
    drives(folder, point_map, T_truth_map, prior_only_once=True)
    starts(folder, point_map, T_truth_map)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENARIO:SEED")
    parser.add_argument("--folder", type=Path, action="append", default=[])
    options = parser.parse_args()
    for folder in options.folder:
        print(folder)
        report(folder)
    for scene in options.scenes:
        scenario, seed = scene.rsplit(":", 1)
        with tempfile.TemporaryDirectory() as scratch:
            simulate(scenario, Path(scratch) / "out", seed=int(seed))
            print(scene)
            report(Path(scratch) / "out")


if __name__ == "__main__":
    main()
