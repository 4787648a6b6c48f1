"""A first map from ordinary GNSS: a simulated street with a bend, priors that err alike for a while, and jump.

    python benchmarks/survey_gnss.py [--length 1200] [--seeds 1 2] [--kitti ../shared/data/kitti/2011_09_26_0001]

Where the survey's scans are put, against the truth: rigidly aligned to it (the shape of the map) and as they are (its
place). Beside the place: how far off the true shape is when it is laid on these priors, and the bound: what the best
unbiased estimate errs by in the mean (rms; Cramer-Rao) that knows the true shape and how errors are correlated.
Only the first pass of ``mapvote build`` is run, which places the scans.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np

from mapvote.config import Settings
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F32, F64, Drive, Scan
from mapvote.formats import open_drive
from mapvote.slam.pose_graph_all import settle
from mapvote.slam.prior_alignment import fit_to_priors
from mapvote.slam.surveyor import Surveyor
from mapvote_lab.evaluation.scoring.truth import rigid_between
from mapvote_lab.simulation.lidar import Caster, measure, sweep
from mapvote_lab.simulation.routes import make_routes
from mapvote_lab.simulation.scenario import load_scenario
from mapvote_lab.simulation.world import make_world

RATE_HZ = 5.0
SIGMA_M, MEMORY_S = 1.5, 20.0
TURN_RAD, RADIUS_M = np.radians(70.0), 90.0


class Bend:
    """A straight street bent to the left in its middle: along x becomes along an arc."""

    def __init__(self, axis_y: float, length_m: float) -> None:
        self.axis_y = axis_y
        s = np.arange(-200.0, length_m + 200.0, 0.25)
        self.heading_at = np.clip((s - 0.5 * length_m) / RADIUS_M, 0.0, TURN_RAD)
        step = 0.25 * np.stack([np.cos(self.heading_at), np.sin(self.heading_at)], axis=1)
        self.s, self.xy = s, np.cumsum(step, axis=0)

    def points(self, xyz: F64) -> tuple[F64, F64]:
        """(n, 3) bent, and the heading (n,) of the street there."""
        heading = np.interp(xyz[:, 0], self.s, self.heading_at)
        x, y = np.interp(xyz[:, 0], self.s, self.xy[:, 0]), np.interp(xyz[:, 0], self.s, self.xy[:, 1])
        v = xyz[:, 1] - self.axis_y
        return np.stack([x - v * np.sin(heading), y + v * np.cos(heading), xyz[:, 2]], axis=1), heading

    def poses(self, T: F64) -> F64:
        """(n, 4, 4) bent."""
        out = T.copy()
        out[:, :3, 3], heading = self.points(T[:, :3, 3])
        turn = np.array([from_xyz_rpy(0, 0, 0, 0, 0, h)[:3, :3] for h in heading])
        out[:, :3, :3] = turn @ T[:, :3, :3]
        return out


def gnss(T_true: F64, seed: int, sigma_m: float = SIGMA_M, memory_s: float = MEMORY_S) -> F64:
    """Priors (n, 4, 4): positions off by ``sigma_m`` in the plane for ``memory_s``, 2 % outliers, heading 2 deg off at
    the start."""
    rng = np.random.default_rng([seed, 99])
    n, memory = len(T_true), np.exp(-1.0 / RATE_HZ / memory_s)
    each = sigma_m / np.sqrt(2.0) * np.array([1.0, 1.0, 1.5])
    error = rng.normal(size=(n, 3)) * each
    for i in range(1, n):
        error[i] = memory * error[i - 1] + np.sqrt(1.0 - memory**2) * error[i]
    wild = rng.uniform(size=n) < 0.02
    error[wild] += rng.normal(size=(int(wild.sum()), 3)) * 20.0
    yaw = np.radians(2.0) * np.exp(-np.arange(n) / RATE_HZ / 30.0) + np.radians(0.3) * rng.normal(size=n)
    out = np.array([T @ from_xyz_rpy(0, 0, 0, 0, 0, a) for T, a in zip(T_true, yaw, strict=True)])
    out[:, :3, 3] = T_true[:, :3, 3] + error
    return out


def bent_drives(length_m: float, seed: int) -> tuple[list[Drive], list[F64]]:
    """The survey's drives, there and back, and their true poses. Scans are cast when they are read."""
    scenario = load_scenario(
        "street", {"length_m": length_m, "rate_hz": RATE_HZ, "changes": [], "clutter": {"gantry_m": []}}
    )
    world = make_world(scenario, seed)
    bend = Bend(world.terrain.axis_y, length_m)
    triangles, owners = world.mesh(world.standing(None))
    bent = bend.points(triangles.reshape(-1, 3).astype(np.float64))[0].reshape(-1, 3, 3).astype(np.float32)
    caster, sensor = Caster(bent, owners), SENSORS["hdl32e"]
    drives, truths = [], []
    for number, route in enumerate(make_routes(scenario, world.terrain, seed)[:2]):
        true = bend.poses(route.poses(route.time_s))

        def read_scan(i: int, route=route, number: int = number) -> Scan:  # type: ignore[no-untyped-def]
            rng = np.random.default_rng([seed, number, i])
            rays = sweep(sensor, lambda t: bend.poses(route.poses(t)), i / RATE_HZ, rng.uniform(), True)
            ranges, _, cosine = caster.cast(rays.origins, rays.directions)
            noisy, kept = measure(sensor, ranges, cosine, rng)
            azimuth = np.arctan2(rays.directions_lidar[kept, 1], rays.directions_lidar[kept, 0])
            points: F32 = noisy[kept, None] * rays.directions_lidar[kept]
            return Scan(int(route.stamps_ns[i]), points, (-azimuth / (2 * np.pi) / sensor.rate_hz).astype(np.float32))

        drives.append(
            Drive(
                Path(route.name), route.name, "d", sensor, route.stamps_ns, read_scan,
                gnss(true, 10 * seed + number), prior_sigma_m=1.5, prior_sigma_deg=2.0,
            )
        )  # fmt: skip
        truths.append(true)
    return drives, truths


def rms(a: F64, b: F64) -> float:
    return float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1))))


def bound(truths: list[F64]) -> float:
    """Metres, rms over all scans: of the best estimate of turn and shift from first-order Markov errors."""
    memory, middle = np.exp(-1.0 / RATE_HZ / MEMORY_S), np.concatenate(truths)[:, :2, 3].mean(axis=0)

    def moved_by(T: F64) -> F64:
        """(n, 2, 3) how a position moves with shift and turn about the middle."""
        d = T[:, :2, 3] - middle
        J = np.zeros((len(T), 2, 3))
        J[:, 0, 0] = J[:, 1, 1] = 1.0
        J[:, 0, 2], J[:, 1, 2] = -d[:, 1], d[:, 0]
        return J

    information = np.zeros((3, 3))
    for T in truths:
        white = moved_by(T)
        white[1:] = (white[1:] - memory * white[:-1]) / np.sqrt(1.0 - memory**2)
        white = white.reshape(-1, 3) / (SIGMA_M / np.sqrt(2.0))
        information += white.T @ white
    J = np.concatenate([moved_by(T) for T in truths])
    return float(np.sqrt(np.einsum("nij,jk,nik->n", J, np.linalg.inv(information), J).mean()))


def place(drives: list[Drive]) -> tuple[list[F64], list[F64], float, float]:
    """(poses, sigmas, share registered, seconds) of the survey."""
    start = time.process_time()
    surveyor = Surveyor(Settings())
    found = [surveyor.follow(drive, lambda: None) for drive in drives]
    settled = settle(drives, found)
    registered = float(np.mean(np.concatenate([one.registered for one in found])))
    return settled.T_map_lidar, settled.sigma_m, registered, time.process_time() - start


def report(name: str, drives: list[Drive], truths: list[F64]) -> None:
    poses, sigmas, registered, seconds = place(drives)
    found, true = np.concatenate(poses), np.concatenate(truths)
    T = rigid_between(found, true)
    rigid = (T @ true)[:, :3, 3]
    told = np.concatenate([d.T_map_lidar_prior for d in drives if d.T_map_lidar_prior is not None])[:, :3, 3]
    best = fit_to_priors(true[:, :3, 3], told, 1.5)
    floor = rms(true[:, :2, 3] @ best[:2, :2].T + best[:2, 3], true[:, :2, 3])
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"| {name} | {registered:.1%} | {rms(rigid, found[:, :3, 3]):.3f} | {rms(true[:, :2, 3], found[:, :2, 3]):.2f} "
        f"| {floor:.2f} | {bound(truths):.2f} | {np.median(np.concatenate(sigmas)):.2f} "
        f"| {seconds:.0f} s, {memory:.1f} GB |",
        flush=True,
    )


def kitti(folder: Path) -> None:
    drive = open_drive(folder)
    assert drive.T_map_lidar_prior is not None
    poses, _, registered, _ = place([drive])
    told = drive.T_map_lidar_prior[:, :3, 3]
    T = rigid_between(poses[0], drive.T_map_lidar_prior)
    laid = rms((T @ drive.T_map_lidar_prior)[:, :3, 3], poses[0][:, :3, 3])
    print(
        f"KITTI {folder.name}: {registered:.0%} registered, {rms(poses[0][:, :3, 3], told):.3f} m rms off its priors "
        f"as they are, {laid:.3f} m after the best rigid fit"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--length", type=float, default=1200.0)
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--kitti", type=Path)
    parser.add_argument("--both", action="store_true", help="also there and back")
    arguments = parser.parse_args()
    if arguments.kitti:
        kitti(arguments.kitti)
    print("| survey | registered | rigid, m rms | place, m rms | true shape on these priors | bound | sigma, m | CPU |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for seed in arguments.seeds:
        drives, truths = bent_drives(arguments.length, seed)
        report(f"one drive, seed {seed}", drives[:1], truths[:1])
        if arguments.both:
            report(f"there and back, seed {seed}", drives, truths)


if __name__ == "__main__":
    main()
