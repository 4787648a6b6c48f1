"""What drives are put through that they did not meet when they were recorded: to see what the method can bear, and
which of its stages holds it back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.point_map import PointMap
from mapvote.core.tile import Tile
from mapvote.core.types import F64, I64, Bool, Drive, Scan
from mapvote.localisation.localiser import Localise
from mapvote.localisation.ndt import PosePrior
from mapvote.localisation.odometry import Fix
from mapvote.perception.frontend import Movers
from mapvote_lab.evaluation.truths import Truth
from mapvote_lab.simulation.scenario import load_scenario
from mapvote_lab.simulation.world import make_world

NOISE_MEMORY_S = 10.0
"""Correlation time of the pose noise: as that of the simulator's priors, long against the passing of a house."""


@dataclass(frozen=True, slots=True)
class Conditions:
    """The default is nothing: everything as recorded, and as the method finds it."""

    scans: str | None = None
    """Which scans of every drive, surveys and vehicles, are there at all: "::5" makes 2 Hz of 10 Hz."""
    true_poses: bool = False
    """Oracle: surveys and vehicles know where they are."""
    true_moving: bool = False
    """Oracle: vehicles know which points hit moving bodies (the first map is still made by our own removal)."""
    true_ground: bool = False
    """Oracle: the first map knows the height of the ground everywhere."""
    noise_m: float = 0.0
    noise_deg: float = 0.0
    """Standard deviations of AR(1) errors added to the vehicles' poses, on each axis."""
    noise_told: bool = False
    """The noise is added to the covariance too: the vehicle knows of it."""


class Shaken:
    """``localise`` with noise added to the poses it finds; its own search goes on undisturbed.

    ``stamps_ns`` (n,) of every scan that will come; ``seed`` decides the noise.
    """

    def __init__(self, localise: Localise, stamps_ns: I64, conditions: Conditions, seed: tuple[int, ...]) -> None:
        self._localise, self._told = localise, conditions.noise_told
        self._sigma = np.repeat([conditions.noise_m, float(np.radians(conditions.noise_deg))], 3)
        errors = ar1(stamps_ns, self._sigma, np.random.default_rng(seed))
        self._error_at = {int(stamp): error for stamp, error in zip(stamps_ns, errors, strict=True)}

    def push(self, scan: Scan, prior: PosePrior | None) -> list[Fix]:
        return [self._shake(fix) for fix in self._localise.push(scan, prior)]

    def flush(self) -> list[Fix]:
        return [self._shake(fix) for fix in self._localise.flush()]

    def _shake(self, fix: Fix) -> Fix:
        error = self._error_at[fix.scan.stamp_ns]
        T_map_lidar = fix.registration.T_map_lidar.copy()
        T_map_lidar[:3, :3] = T_map_lidar[:3, :3] @ from_xyz_rpy(0, 0, 0, *error[3:])[:3, :3]
        T_map_lidar[:3, 3] += error[:3]
        covariance = fix.registration.covariance + (np.diag(self._sigma**2) if self._told else 0.0)
        return replace(fix, registration=replace(fix.registration, T_map_lidar=T_map_lidar, covariance=covariance))


def ar1(stamps_ns: I64, sigma: F64, rng: np.random.Generator) -> F64:
    """(n, k) errors at ``stamps_ns`` (n,), first-order autoregressive, stationary with deviations ``sigma`` (k,)."""
    kicks = rng.normal(size=(len(stamps_ns), len(sigma))) * sigma
    out = kicks.copy()
    for i in range(1, len(stamps_ns)):
        memory = np.exp(-1e-9 * float(stamps_ns[i] - stamps_ns[i - 1]) / NOISE_MEMORY_S)
        out[i] = memory * out[i - 1] + np.sqrt(1.0 - memory**2) * kicks[i]
    return out


class TrueMovers(Movers):
    """The simulator's own word on which points move, instead of the filter."""

    def __init__(self, truth: Truth, whole: Drive) -> None:
        """``whole``: the drive with all of its scans, whose numbers the truth goes by."""
        self._truth, self._name = truth, whole.path.name
        self._number = {int(stamp): i for i, stamp in enumerate(whole.stamps_ns)}

    def push(self, points_map: F64, origin_map: F64, obstacle: Bool, stamp_ns: int) -> list[Bool]:
        moving = self._truth.moving(self._name, self._number[stamp_ns])
        if len(moving) != len(points_map):
            raise ValueError(f"{self._name}: {len(points_map)} points, but the truth labels {len(moving)}")
        return [moving]

    def flush(self) -> list[Bool]:
        return []


def with_true_ground(point_map: PointMap, scenario: str, seed: int, overrides: Mapping[str, Any]) -> PointMap:
    """``point_map`` with the simulated terrain's height in every cell of every tile. Points stay as they are."""
    terrain = make_world(load_scenario(scenario, overrides), seed).terrain
    tiles: dict[tuple[int, int], Tile] = {}
    for index, tile in point_map.tiles.items():
        x, y = point_map.lattice.tile(index).centres()
        height = terrain.height(x[None, :], y[:, None]).astype(np.float32)
        tiles[index] = replace(tile, ground_z=height)
    return replace(point_map, tiles=tiles)
