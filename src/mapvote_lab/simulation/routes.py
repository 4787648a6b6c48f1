"""How vehicles move through the street, and what they believe about it (docs/decisions/truth.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.record import record
from mapvote.core.types import F64, I64
from mapvote_lab.simulation.scenario import LANES, Scenario
from mapvote_lab.simulation.world import Terrain


@record()
@dataclass(frozen=True, slots=True)
class DrivePlan:
    """When the simulated drives start, and how their poses err."""

    rtk_sigma_m: float = 0.02
    """Standard deviation of a survey's positions, metres: RTK."""
    rtk_sigma_deg: float = 0.05
    """Standard deviation of a survey's angles, degrees."""
    memory_s: float = 10.0
    """Correlation time of errors of priors, seconds: long against the passing of a house."""
    first_s: int = 1_756_720_800
    """Start of the first survey, seconds since 1970: 2025-09-01 10:00 UTC."""
    surveys_apart_s: int = 1_200
    """Time from the start of one survey to the next, seconds."""
    votes_after_s: int = 30 * 86_400
    """Time from the first survey to the first voting vehicle, seconds."""
    votes_apart_s: int = 5_400
    """Time from the start of one voting vehicle to the next, seconds."""


DRIVE_PLAN = DrivePlan()


def ar1(step_s: F64, sigma: F64, rng: np.random.Generator, memory_s: float = DRIVE_PLAN.memory_s) -> F64:
    """(n, k) first-order autoregressive errors ``step_s`` (n - 1,) apart, stationary with deviations ``sigma`` (k,)."""
    kicks = rng.normal(size=(len(step_s) + 1, len(sigma))) * sigma
    out = kicks.copy()
    for i, memory in enumerate(np.exp(-step_s / memory_s), 1):
        out[i] = memory * out[i - 1] + np.sqrt(1.0 - memory**2) * kicks[i]
    return out


def erring(T: F64, error: F64) -> F64:
    """T (4, 4) moved by ``error`` (6,): metres along the map's axes, and roll, pitch, yaw about its own."""
    out = T.copy()
    out[:3, :3] = T[:3, :3] @ from_xyz_rpy(0, 0, 0, *error[3:])[:3, :3]
    out[:3, 3] += error[:3]
    return out


@dataclass(frozen=True)
class Route:
    """One drive through the street: a lane at an almost constant speed, swaying as vehicles do."""

    name: str
    vehicle: int | None
    """Which voting vehicle (from 0); None for a survey."""
    lane: str
    start_ns: int
    scans: int
    rate_hz: float
    speed: float
    length: float
    mount_height_m: float
    sway: F64
    """(5,) seeded phases."""
    prior_sigma_m: float
    prior_sigma_deg: float
    terrain: Terrain

    @property
    def time_s(self) -> F64:
        """(scans,) stamps from the start of the drive."""
        return np.arange(self.scans) / self.rate_hz

    @property
    def stamps_ns(self) -> I64:
        """(scans,) stamps."""
        return self.start_ns + np.round(self.time_s * 10**9).astype(np.int64)

    def poses(self, time_s: F64) -> F64:
        """T_map_lidar (n, 4, 4) at any times (n,) from the start of the drive."""
        direction, offset = LANES[self.lane]
        p = self.sway
        along = self.speed * time_s + 1.2 * (np.sin(0.23 * time_s + p[0]) - np.sin(p[0]))
        aside = 0.18 * np.sin(0.55 * time_s + p[1])
        tilt = 0.18 * 0.55 * np.cos(0.55 * time_s + p[1]) / self.speed
        x = along if direction > 0 else self.length - along
        y = self.terrain.axis_y + offset + direction * aside
        yaw = tilt + (0.0 if direction > 0 else np.pi)
        c = np.cos(yaw)
        s = np.sin(yaw)
        ahead = self.terrain.height(x + 1.4 * c, y + 1.4 * s), self.terrain.height(x - 1.4 * c, y - 1.4 * s)
        across = self.terrain.height(x - 0.8 * s, y + 0.8 * c), self.terrain.height(x + 0.8 * s, y - 0.8 * c)
        pitch = -np.arctan2(ahead[0] - ahead[1], 2.8) + np.radians(0.12) * np.sin(7.5 * time_s + p[2])
        roll = np.arctan2(across[0] - across[1], 1.6) + np.radians(0.10) * np.sin(5.9 * time_s + p[3])
        height = 0.25 * sum(ahead + across) + 0.008 * np.sin(8.3 * time_s + p[4])
        T = from_xyz_rpy(x, y, height, roll, pitch, yaw)
        T[:, :3, 3] += self.mount_height_m * T[:, :3, 2]
        return T

    def priors(self, rng: np.random.Generator) -> F64:
        """(scans, 4, 4) poses that the vehicle believes at the stamps: the truth with a smooth AR(1) error."""
        tilt = self.prior_sigma_deg if self.vehicle is None else 0.3 * self.prior_sigma_deg
        sigma = np.array([*[self.prior_sigma_m] * 3, *np.radians([tilt, tilt, self.prior_sigma_deg])])
        errors = ar1(np.full(self.scans - 1, 1.0 / self.rate_hz), sigma, rng)
        return np.array([erring(T, error) for T, error in zip(self.poses(self.time_s), errors, strict=True)])


def make_routes(scenario: Scenario, terrain: Terrain, seed: int, plan: DrivePlan = DRIVE_PLAN) -> list[Route]:
    """Surveys first, then the voting vehicles, each at its own hour."""
    # Length and number of scans are the same for all drives.
    speed = scenario.speed_kmh / 3.6
    scans = int(scenario.length_m / speed * scenario.rate_hz + 1e-6) + 1
    routes = []
    lanes = scenario.vehicle_lanes
    # (name, number of the voting vehicle, lane)
    drives: list[tuple[str, int | None, str]] = [
        (f"survey_{i + 1}", None, lane) for i, lane in enumerate(scenario.surveys)
    ]
    drives += [(f"v{i + 1}", i, lanes[i % len(lanes)]) for i in range(scenario.vehicles)]
    for index, (name, vehicle, lane) in enumerate(drives):
        rng = np.random.default_rng([seed, 3, index])
        survey = vehicle is None
        after_s = index * plan.surveys_apart_s if survey else plan.votes_after_s + index * plan.votes_apart_s
        routes.append(
            Route(
                name=name,
                vehicle=vehicle,
                lane=lane,
                start_ns=(plan.first_s + after_s) * 10**9,
                scans=scans,
                rate_hz=scenario.rate_hz,
                speed=speed,
                length=scenario.length_m,
                mount_height_m=scenario.mount_height_m,
                sway=rng.uniform(0, 2 * np.pi, 5),
                prior_sigma_m=plan.rtk_sigma_m if survey else round(rng.uniform(0.3, 1.0), 2),
                prior_sigma_deg=plan.rtk_sigma_deg if survey else 1.0,
                terrain=terrain,
            )
        )
    return routes
