"""How far a wrong prior leads a vehicle astray: fixes that are wrong and trusted, and right ones that abstain.

    python benchmarks/trust.py [--kitti ../shared/data/kitti] [--sim terrace:2 street:2] [--every 2]

KITTI drives are localised in the map of their own other blocks, at the reference poses; simulated vehicles in the map
that our SLAM makes of the surveys, by the true poses in that map's frame. Right is within 0.3 m and 1 deg. Priors are
the true ones, late, moved, drifting, turned, of another street or none; all claim 1 m and 1 deg.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mapvote.config import Settings
from mapvote.core.geometry import from_xyz_rpy, interpolate, inverse, rotation_angle
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, Drive
from mapvote.formats import open_drive, read_T_map_lidar
from mapvote.localisation.localiser import Localiser
from mapvote.localisation.ndt import PosePrior
from mapvote.slam.build import build_map
from mapvote_lab.evaluation.scoring.scene_truth import rigid_between
from mapvote_lab.simulation import simulate

SETTINGS = Settings()
Case = tuple[PointMap, Drive, F64]
"""A map, a drive through it, and where in the map (n, 4, 4) its scans were taken."""


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


def run(cases: list[Case], name: str) -> tuple[int, int, int, int, float]:
    """(scans, wrong and trusted, right and abstained, wrong, CPU ms a scan)."""
    counts, start = np.zeros(4, dtype=np.int64), time.process_time()
    for point_map, drive, T in cases:
        believed = priors(drive, T)[name]
        localiser = Localiser(point_map, SETTINGS, drive.sensor)
        fixes = []
        for i, scan in enumerate(drive):
            prior = None if believed is None else PosePrior(believed[i], 1.0, np.radians(1.0))
            fixes += localiser.push(scan, prior)
        fixes += localiser.flush()
        for fix, true in zip(fixes, T, strict=True):
            off = inverse(true) @ fix.registration.T_map_lidar
            right = np.linalg.norm(off[:3, 3]) < 0.3 and rotation_angle(off) < np.radians(1.0)
            counts += [
                1,
                fix.trusted and not right,
                right and not fix.trusted,
                not right,
            ]
    n, astray, shy, wrong = counts.tolist()
    return n, astray, shy, wrong, 1e3 * (time.process_time() - start) / n


def kitti(folder: Path, block: int = 10, first: int = 0) -> list[Case]:
    """Every other block of a drive as map, from the ``first`` on, the others driven as they are (10 Hz)."""
    n = len(open_drive(folder))
    starts = range(0, n, block)
    mapped = [i for s in starts[first::2] for i in range(s, min(s + block, n))]
    survey = open_drive(folder, scans=",".join(f"{s}:{min(s + block, n)}" for s in starts[first::2]))
    point_map, built = build_map([survey], SETTINGS)
    reference = read_T_map_lidar(folder / "poses.txt", folder)
    T = rigid_between(built.tracks[0].T_map_lidar, reference[mapped]) @ reference
    return [
        (
            point_map,
            open_drive(folder, scans=f"{s}:{min(s + block, n)}"),
            T[s : s + block],
        )
        for s in starts[1 - first :: 2]
    ]


def simulated(scenario: str, seed: int, every: int) -> Iterator[Case]:
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "out"
        simulate(scenario, out, seed=seed, workers=1, overrides={"vehicles": 1})
        names = sorted(path.name for path in out.glob("survey_*"))
        point_map, built = build_map([open_drive(out / name, scans="::2") for name in names], SETTINGS)
        true = np.concatenate([read_T_map_lidar(out / "truth" / name / "poses.txt", out / name)[::2] for name in names])
        T_map_truth = rigid_between(np.concatenate([t.T_map_lidar for t in built.tracks]), true)
        there = T_map_truth @ read_T_map_lidar(out / "truth" / "v1" / "poses.txt", out / "v1")
        yield point_map, open_drive(out / "v1", scans=f"::{every}"), there[::every]


def table(title: str, cases: list[Case]) -> None:
    print(f"\n| {title} | scans | wrong and trusted | right and abstained | wrong | CPU, ms a scan |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name in priors(cases[0][1], cases[0][2]):
        n, astray, shy, wrong, ms = run(cases, name)
        print(f"| {name} | {n} | {astray} | {shy} | {wrong} | {ms:.0f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kitti", type=Path)
    parser.add_argument("--sim", nargs="*", default=[], metavar="SCENARIO:SEED")
    parser.add_argument(
        "--every",
        type=int,
        default=2,
        help="of a simulated vehicle one scan in so many",
    )
    arguments = parser.parse_args()
    for folder in sorted(arguments.kitti.glob("*")) if arguments.kitti else ():
        table(f"KITTI {folder.name}", kitti(folder))
    for scene in arguments.sim:
        scenario, seed = scene.rsplit(":", 1)
        for case in simulated(scenario, int(seed), arguments.every):
            table(f"{scenario}, seed {seed}", [case])


if __name__ == "__main__":
    main()
