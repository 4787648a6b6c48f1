"""The similarity that takes the prior's poses to the map's: shift, turn, tilt and scale, each with its error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize
from scipy.spatial.transform import Rotation

from mapvote.core.types import F64

_POSITION_M, _ROTATION_RAD = 0.03, np.radians(0.15)
"""Errors of one registration; they weigh positions against rotations."""
_SCALE = 0.01
"""Of the scale that points show; it stands where a drive is too short to tell it."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Positions p go to middle + offset + scale R (p - middle), rotations to R times themselves."""

    middle: F64
    """(3,) of the drive, by the prior."""
    offset_m: F64
    """(3,) at the middle."""
    rotation: F64
    """(3, 3)."""
    scale: float
    sigma_m: float
    yaw_sigma_deg: float
    tilt_sigma_deg: float
    scale_sigma: float
    places: int

    @property
    def yaw_deg(self) -> float:
        return float(np.degrees(np.arctan2(self.rotation[1, 0], self.rotation[0, 0])))

    @property
    def tilt_deg(self) -> float:
        return float(np.degrees(np.arccos(np.clip(self.rotation[2, 2], -1.0, 1.0))))

    def applied(self, T: F64) -> F64:
        """The pose (4, 4) as it lies on the map."""
        out = np.eye(4)
        out[:3, :3] = self.rotation @ T[:3, :3]
        out[:3, 3] = self.middle + self.offset_m + self.scale * self.rotation @ (T[:3, 3] - self.middle)
        return out


def difference_of(T_prior: F64, T_map: F64, scale: float = 1.0) -> Difference:
    """Of poses (m, 4, 4) of the same scans, by robust least squares. Errors come from how well the places agree.

    ``scale``: as the points of the scans showed it, to a per cent; places far apart tell it better.
    """
    middle = T_prior[:, :3, 3].mean(axis=0)
    p, q = T_prior[:, :3, 3] - middle, T_map[:, :3, 3] - middle
    turned = Rotation.from_matrix(T_map[:, :3, :3] @ np.swapaxes(T_prior[:, :3, :3], 1, 2))

    def off(x: F64) -> F64:
        R = Rotation.from_rotvec(x[3:6])
        positions = (np.exp(x[6]) * R.apply(p) + x[:3] - q) / _POSITION_M
        rotations = (R.inv() * turned).as_rotvec() / _ROTATION_RAD
        return np.concatenate([positions.ravel(), rotations.ravel(), [(x[6] - np.log(scale)) / _SCALE]])

    start = np.concatenate([q.mean(axis=0), turned.mean().as_rotvec(), [np.log(scale)]])
    found = optimize.least_squares(off, start, loss="soft_l1", f_scale=2.0)
    spread = max(1.0, 1.4826 * float(np.median(np.abs(found.fun))))
    sigma = spread * np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)))
    return Difference(
        middle,
        found.x[:3],
        Rotation.from_rotvec(found.x[3:6]).as_matrix(),
        float(np.exp(found.x[6])),
        float(np.linalg.norm(sigma[:3])),
        float(np.degrees(sigma[5])),
        float(np.degrees(np.linalg.norm(sigma[3:5]))),
        float(sigma[6]),
        len(p),
    )
