"""The frame in which a vehicle's prior poses are, relative to the map: learnt from scans that were localised.

A prior of GNSS is in the map's frame. Odometry is in a frame of its own (REP 105: ``odom``), begins anywhere, and
drifts. Where localised scans lie far off their priors, the rigid motion T_map_prior between the frames is taken from
them, and followed as it drifts: each localised scan moves it by a share of what it is off. A leap of the prior that no
vehicle can drive is a new frame at that moment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapvote.core.geometry import exp, inverse, log, rotation_angle
from mapvote.core.record import record
from mapvote.core.types import F64, PosePrior


@record(votes=True)
@dataclass(frozen=True, slots=True)
class FrameLearning:
    """How the frame of a prior is learnt."""

    far_m: float = 5.0
    """A localised scan at least so far from its prior, beside three sigmas, speaks for a frame of its own, metres."""
    far_rad: float = float(np.radians(8.0))
    """The same for the angle between the two, radians."""
    votes: int = 5
    """Localised scans in turn that must lie far from their priors before a frame of its own is taken."""
    share: float = 0.25
    """Share of the newest difference by which the frame follows its drift."""
    outlier: float = 4.0
    """A difference of more than so many of the usual ones is cut to it, so that one wrong scan moves little."""
    leap_m: float = 3.0
    """A prior that moves so much more than the track between two scans has begun anew, metres."""
    leap_rad: float = float(np.radians(15.0))
    """The same for its angle, radians."""
    drift: float = 0.03
    """Share of the road since the last localised scan by which the prior may be off."""


LEARNING = FrameLearning()


class PriorFrame:
    """T_map_prior of one drive: the identity until localised scans say otherwise."""

    def __init__(self, *, in_map: bool = True, learning: FrameLearning = LEARNING) -> None:
        """``in_map``: the prior is stated to be in the map's frame; else nothing is known of its frame."""
        self.T_map_prior = np.eye(4)
        self.is_own = False
        """Whether the prior is in a frame of its own that has been learnt."""
        self.is_unknown = not in_map
        """Whether nothing is known yet: the prior does not say where the vehicle is."""
        self.sigma_m = 0.0
        """Usual distance between a localised scan and its prior in the map, metres; 0 before any."""
        self.sigma_rad = 0.0
        """The same for the angle."""
        self.begun = 0
        """How often a frame was taken anew: at the start, and after a leap of the prior."""
        self._learning = learning
        self._far = 0
        self._last: F64 | None = None
        """The prior of the last localised scan, in its own frame."""

    def in_map(self, prior: PosePrior) -> PosePrior:
        """The prior in the map's frame, and no surer of itself than the road since the last localised scan allows."""
        if not self.is_own:
            return prior
        road_m = 0.0
        if self._last is not None:
            road_m = float(np.linalg.norm(prior.T_map_lidar[:3, 3] - self._last[:3, 3]))
        sigma_m = max(prior.sigma_m, self.sigma_m) + self._learning.drift * road_m
        T = self.T_map_prior @ prior.T_map_lidar
        return PosePrior(T, sigma_m, max(prior.sigma_rad, self.sigma_rad))

    def is_far(self, prior: PosePrior, T_map_lidar: F64) -> bool:
        """Whether a place in the map is too far from the prior for the prior to be in the frame that is known."""
        if self.is_unknown:
            return True
        off_m, off_rad = distance_to(self.in_map(prior).T_map_lidar, T_map_lidar)
        learning = self._learning
        return bool(off_m > learning.far_m + 3.0 * prior.sigma_m or off_rad > learning.far_rad + 3.0 * prior.sigma_rad)

    def begin(self, prior: PosePrior, T_map_lidar: F64) -> None:
        """The scan of this prior was taken here: the frame is taken from this one scan."""
        self.T_map_prior = T_map_lidar @ inverse(prior.T_map_lidar)
        self.is_own = True
        self.is_unknown = False
        self.sigma_m = 0.0
        self.sigma_rad = 0.0
        self.begun += 1
        self._far = 0
        self._last = prior.T_map_lidar

    def learn(self, prior: PosePrior, T_map_lidar: F64) -> bool:
        """A scan of this prior was localised here for certain. Returns whether a frame of its own was taken now."""
        self._far = self._far + 1 if self.is_far(prior, T_map_lidar) else 0
        if not self.is_own:
            if self._far >= self._learning.votes:
                self.begin(prior, T_map_lidar)
                return True
            return False
        T = self.T_map_prior @ prior.T_map_lidar
        off = log(inverse(T) @ T_map_lidar)
        off_m = float(np.linalg.norm(off[:3]))
        off_rad = float(np.linalg.norm(off[3:]))
        if self.sigma_m:
            off[:3] *= min(1.0, self._learning.outlier * max(self.sigma_m, 0.1) / max(off_m, 1e-9))
            off[3:] *= min(1.0, self._learning.outlier * max(self.sigma_rad, 0.01) / max(off_rad, 1e-9))
        share = self._learning.share
        self.sigma_m = float(np.hypot(np.sqrt(1.0 - share) * self.sigma_m, np.sqrt(share) * off_m))
        self.sigma_rad = float(np.hypot(np.sqrt(1.0 - share) * self.sigma_rad, np.sqrt(share) * off_rad))
        self.T_map_prior = T @ exp(share * off) @ inverse(prior.T_map_lidar)
        self._last = prior.T_map_lidar
        return False

    def leapt(self, prior: PosePrior, T_map_lidar_predicted: F64) -> bool:
        """Whether the prior has begun anew: it lies so far from where the track leads that no vehicle drives there."""
        if not self.is_own:
            return False
        off_m, off_rad = distance_to(self.in_map(prior).T_map_lidar, T_map_lidar_predicted)
        allowed_m = self._learning.leap_m + 3.0 * self.in_map(prior).sigma_m
        return bool(off_m > allowed_m or off_rad > self._learning.leap_rad)

    def told(self) -> str:
        """The frame in figures, for a log."""
        x, y, z = self.T_map_prior[:3, 3]
        yaw_deg = np.degrees(np.arctan2(self.T_map_prior[1, 0], self.T_map_prior[0, 0]))
        return (
            f"x {x:.2f}, y {y:.2f}, z {z:.2f} m, yaw {yaw_deg:.2f} deg "
            f"(+-{self.sigma_m:.2f} m, {np.degrees(self.sigma_rad):.2f} deg)"
        )


def distance_to(T: F64, other: F64) -> tuple[float, float]:
    """Distance, metres, and angle, radians, between two poses (4, 4)."""
    off = inverse(T) @ other
    return float(np.linalg.norm(off[:3, 3])), rotation_angle(off)
