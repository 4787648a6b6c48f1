"""Localisation, in the map that our own SLAM built: errors, honesty, wrong starts, and priors that lead astray.

    python benchmarks/localisation.py paper:4 street:2                            errors of simulated vehicles
    python benchmarks/localisation.py --priors terrace:2 --kitti ../shared/data/kitti     one table for each street

Errors are those in the map's frame (the surveys' trajectory rigidly aligned to the truth), because a vote only needs
the map. Abstentions count as failures. NEES is the normalised squared error, 6 if covariances are right. The wrong
starts are 1 m in a random direction and 3 deg in yaw off the truth. With ``--priors`` a fix is right within 0.3 m and
1 deg, and a vehicle's prior is the true one, late, moved, drifting, turned, of another street or none; all claim 1 m
and 1 deg. KITTI drives are localised in the map of their own other blocks, at the reference poses.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from mapvote.config import Settings
from mapvote.core.geometry import exp, from_xyz_rpy, interpolate, inverse, log, rotation_angle
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Drive
from mapvote.formats import open_drive, read_T_map_lidar
from mapvote.localisation.localiser import Localiser
from mapvote.localisation.map_window import MapWindow
from mapvote.localisation.ndt import PosePrior, refine, thin_for_levels
from mapvote.localisation.odometry import Tracker
from mapvote.localisation.prepare import deskew, motion_at
from mapvote.slam.build import build_map
from mapvote_lab.evaluation.truths import rigid_between
from mapvote_lab.simulation import simulate

SETTINGS = Settings()
Case = tuple[PointMap, Drive, F64]
"""A map, a drive through it, and where in the map (n, 4, 4) its scans were taken."""


def simulated(scene: str, every: int = 1) -> Iterator[Case]:
    """The vehicles of ``SCENARIO:SEED`` in the map of its surveys."""
    scenario, seed = scene.rsplit(":", 1)
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "out"
        simulate(scenario, out, seed=int(seed), workers=1)

        def truth_of(folder: Path) -> F64:
            return read_T_map_lidar(out / "truth" / folder.name / "poses.txt", folder)

        surveys = sorted(out.glob("survey_*"))
        point_map, built = build_map([open_drive(folder) for folder in surveys], SETTINGS)
        found, true = (np.concatenate(T) for T in ([t.T_map_lidar for t in built.tracks], map(truth_of, surveys)))
        T_map_truth = rigid_between(found, true)
        for folder in sorted(out.glob("v[0-9]*")):
            yield point_map, open_drive(folder, scans=f"::{every}"), (T_map_truth @ truth_of(folder))[::every]


def kitti(folder: Path, block: int = 10) -> Iterator[Case]:
    """Every other block of a drive as map, the others driven as they are (10 Hz)."""
    n = len(open_drive(folder))
    starts = range(0, n, block)
    mapped = [i for s in starts[::2] for i in range(s, min(s + block, n))]
    survey = open_drive(folder, scans=",".join(f"{s}:{min(s + block, n)}" for s in starts[::2]))
    point_map, built = build_map([survey], SETTINGS)
    reference = read_T_map_lidar(folder / "poses.txt", folder)
    T = rigid_between(built.tracks[0].T_map_lidar, reference[mapped]) @ reference
    for s in starts[1::2]:
        yield point_map, open_drive(folder, scans=f"{s}:{min(s + block, n)}"), T[s : s + block]


def pose_error(T: F64, true: F64) -> F64:
    """(6,) (rho, phi) in map axes, as Registration.covariance has it."""
    turn = np.eye(4)
    turn[:3, :3] = T[:3, :3] @ true[:3, :3].T
    return np.r_[T[:3, 3] - true[:3, 3], log(turn)[3:]]


def errors(cases: Sequence[Case]) -> None:
    """Print how far fixes lie off, how honest they are of it, and how many wrong starts end at the truth."""
    off, trusted, nees, start = [], [], [], time.process_time()
    for point_map, drive, T in cases:
        tracker = Tracker(MapWindow(point_map), SETTINGS.ndt)
        for i, scan in enumerate(drive):
            fix = tracker.localise(scan, PosePrior.of(drive, i))
            off.append(pose_error(fix.registration.T_map_lidar, T[i]))
            trusted.append(fix.trusted)
            nees.append(off[-1] @ np.linalg.solve(fix.registration.covariance, off[-1]))
    ms = 1e3 * (time.process_time() - start) / len(off)
    shift = np.where(trusted, np.linalg.norm(np.array(off)[:, :3], axis=1), np.inf)
    turn = np.degrees(np.linalg.norm(np.array(off)[:, 3:], axis=1))
    print(f" {len(off)} scans: median {np.median(shift):.3f} m {np.median(turn):.3f} deg, 99 % "
          f"{np.quantile(shift, 0.99):.3f} m, below .2 m {np.mean(shift < 0.2):.4f}, coverage {np.mean(trusted):.4f}, "
          f"NEES {np.mean(nees):.1f}, {ms:.1f} ms of CPU a scan")  # fmt: skip
    print(f" {np.mean([start for case in cases for start in starts(*case)]):.3f} of wrong starts end within .2 m")


def starts(point_map: PointMap, drive: Drive, T: F64, count: int = 100) -> list[bool]:
    """Which registrations from 1 m and 3 deg off the truth end within .2 m of it."""
    rng, found = np.random.default_rng(7), []
    for i in rng.integers(1, len(drive) - 1, count):
        way, yaw = rng.uniform(0, 2 * np.pi), np.radians(3.0) * rng.choice([-1.0, 1.0])
        guess = T[i].copy()
        guess[:3, :3] = exp([0, 0, 0, 0, 0, yaw])[:3, :3] @ guess[:3, :3]
        guess[:3, 3] += [np.cos(way), np.sin(way), 0.0]
        points = deskew(drive.read_scan(int(i)), motion_at(drive.stamps_ns, T, int(i)))
        result = refine(MapWindow(point_map)(guess[:3, 3]), thin_for_levels(points), guess)
        found.append(float(np.linalg.norm(result.T_map_lidar[:3, 3] - T[i, :3, 3])) < 0.2)
    return found


def late(drive: Drive, T: F64, seconds: float) -> F64:
    """What a vehicle believes whose prior is late by so much."""
    at = 1e-9 * (drive.stamps_ns - drive.stamps_ns[0]).astype(np.float64)
    out = []
    for t in at - seconds:
        j = int(np.clip(np.searchsorted(at, t) - 1, 0, len(at) - 2))
        out.append(interpolate(T[j], T[j + 1], (t - at[j]) / (at[j + 1] - at[j])))
    return np.array(out)


def priors(drive: Drive, T: F64) -> dict[str, F64 | None]:
    """(n, 4, 4) by name."""

    def moved(x: float, y: float = 0.0, yaw_deg: float = 0.0) -> F64:
        return np.array([pose @ from_xyz_rpy(x, y, 0, 0, 0, np.radians(yaw_deg)) for pose in T])

    drift = np.array([pose @ from_xyz_rpy(12.0 * i / len(T), 0, 0) for i, pose in enumerate(T)])
    return {
        "right": T,
        **{f"late {s} s": late(drive, T, s) for s in (0.2, 0.5, 1.0, 2.0)},
        "3 m ahead": moved(3.0), "10 m behind": moved(-10.0), "10 m aside": moved(0.0, 10.0),
        "another street": moved(0.0, 60.0), "drifts to 12 m": drift, "turned 90 deg": moved(0.0, 0.0, 90.0),
        "turned 180 deg": moved(0.0, 0.0, 180.0), "none": None,
    }  # fmt: skip


def trust(title: str, cases: Sequence[Case]) -> None:
    """Print, by prior, how often a wrong fix is trusted and a right one abstains."""
    print(f"\n| {title} | scans | wrong and trusted | right and abstained | wrong |\n|---|---|---|---|---|")
    for name in priors(*cases[0][1:]):
        counts = np.zeros(4, dtype=np.int64)
        for point_map, drive, T in cases:
            believed, localiser = priors(drive, T)[name], Localiser(point_map, SETTINGS, drive.sensor)
            sure = (1.0, float(np.radians(1.0)))
            told = [None] * len(T) if believed is None else [PosePrior(T_b, *sure) for T_b in believed]
            fixes = [fix for scan, prior in zip(drive, told, strict=True) for fix in localiser.push(scan, prior)]
            for fix, true in zip([*fixes, *localiser.flush()], T, strict=True):
                off = inverse(true) @ fix.registration.T_map_lidar
                right = np.linalg.norm(off[:3, 3]) < 0.3 and rotation_angle(off) < np.radians(1.0)
                counts += [1, fix.trusted and not right, right and not fix.trusted, not right]
        print(f"| {name} | {' | '.join(map(str, counts))} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENARIO:SEED")
    parser.add_argument("--priors", nargs="*", default=[], metavar="SCENARIO:SEED")
    parser.add_argument("--kitti", type=Path)
    asked = parser.parse_args()
    for scene in asked.scenes:
        print(scene)
        errors(list(simulated(scene)))
    for folder in sorted(asked.kitti.glob("*")) if asked.kitti else ():
        trust(f"KITTI {folder.name}", list(kitti(folder)))
    for scene in asked.priors:
        trust(scene, [next(simulated(scene, every=2))])


if __name__ == "__main__":
    main()
