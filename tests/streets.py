"""A street made of known rectangles, and what a turning sensor that drives through it measures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapvote.core.geometry import exp, from_xyz_rpy, inverse
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, Drive, Scan
from mapvote.matching.prepare import motion_at

LENGTH_M = 45.0


def surface(rng: np.random.Generator, n: int, low: tuple[float, ...], high: tuple[float, ...]) -> F64:
    """Points on an axis-parallel rectangle (one coordinate the same in both corners), with 2 cm noise."""
    return np.asarray(rng.uniform(low, high, (n, 3)) + rng.normal(0, 0.02, (n, 3)))


def street(seed: int, density: float = 1.0, length_m: float = LENGTH_M) -> F64:
    """A road along x from -length to +length between two house fronts with gaps and side walls; poles by one kerb."""
    rng = np.random.default_rng(seed)
    along = density * length_m / LENGTH_M
    pieces = [surface(rng, int(12_000 * along), (-length_m, -12, 0), (length_m, 12, 0))]
    for x in np.arange(-length_m + 5, length_m - 10, 19.0):
        for y in (-12, 12):
            pieces.append(surface(rng, int(1500 * density), (x, y, 0), (x + 14, y, 8)))
            pieces.append(surface(rng, int(400 * density), (x, min(y, 1.5 * y), 0), (x, max(y, 1.5 * y), 8)))
    for x in np.arange(-length_m + 5, length_m, 13.0):
        pole = rng.uniform((0, 0, 0), (2 * np.pi, 1, 6), (int(120 * density), 3))
        pieces.append(np.column_stack([x + 0.15 * np.cos(pole[:, 0]), 7 + 0.15 * np.sin(pole[:, 0]), pole[:, 2]]))
    return np.concatenate(pieces)


def path(n: int, start_x: float = -20.0, speed_mps: float = 10.0, weave_m: float = 1.0) -> F64:
    """(n, 4, 4) poses at 10 Hz of a sensor 1.8 m above the road that weaves between its lanes."""
    x = start_x + 0.1 * speed_mps * np.arange(n)
    yaw = np.arctan(weave_m / 8.0 * np.cos(x / 8.0))
    y = weave_m * np.sin(x / 8.0)
    return np.array([from_xyz_rpy(x[i], y[i], 1.8, 0.0, 0.0, yaw[i]) for i in range(n)])


def sweep(world: F64, T_map_lidar: F64, twist: F64, stamp_ns: int, reach_m: float = 40.0) -> Scan:
    """One revolution, clockwise seen from above, the stamp at its middle: each point as seen at its own moment."""
    near = world[np.linalg.norm(world[:, :2] - T_map_lidar[:2, 3], axis=1) < reach_m]
    T_lidar_map = inverse(T_map_lidar)
    still = near @ T_lidar_map[:3, :3].T + T_lidar_map[:3, 3]
    time_s = -np.arctan2(still[:, 1], still[:, 0]) / (2 * np.pi) * 0.1
    seen = np.empty_like(still)
    order = np.argsort(time_s)
    for piece in np.array_split(order, 60):  # 1.7 ms at a time: 2 cm at 10 m/s
        T = inverse(exp(np.mean(time_s[piece]) * twist)) if len(piece) else np.eye(4)
        seen[piece] = still[piece] @ T[:3, :3].T + T[:3, 3]
    return Scan(stamp_ns, seen.astype(np.float32), time_s.astype(np.float32))


def twist_of(poses: F64, i: int) -> F64:
    """(6,) true motion per second at pose i of a 10 Hz path."""
    return motion_at(np.arange(len(poses)) * 100_000_000, poses, i)


def drive_along(
    poses: F64,
    seed: int,
    prior: F64 | None = None,
    sigma_m: float = 1.0,
    sigma_deg: float = 1.0,
    length_m: float = 45.0,
) -> Drive:
    """A drive along ``poses`` through :func:`street`: every scan is new samples of the same surfaces."""
    stamps = np.arange(1, len(poses) + 1) * 100_000_000

    def read_scan(i: int) -> Scan:
        world = street(1000 * seed + i, 0.6, length_m)
        return sweep(world, poses[i], twist_of(poses, i), int(stamps[i]))

    return Drive(
        path=Path(f"drive_{seed}"),
        vehicle=f"vehicle_{seed}",
        drive_id=f"drive_{seed}",
        sensor=SENSORS["hdl32e"],
        stamps_ns=stamps,
        read_scan=read_scan,
        T_map_lidar_prior=prior,
        prior_sigma_m=sigma_m,
        prior_sigma_deg=sigma_deg,
    )
