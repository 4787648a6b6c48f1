"""The similarity that takes one set of poses to another: shift, rotation, scale and a turn of the sensor.

One robust fit serves the prior against a chain of scans and the prior against a map (Umeyama, PAMI 1991, gives the same
for positions without outliers).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from mapvote.core.types import F64


@dataclass(frozen=True, slots=True)
class Similarity:
    """Positions p go to middle + offset + scale R (p - middle); a rotation Q goes to R Q own."""

    middle: F64
    """(3,) mean of the positions that were fitted."""
    offset_m: F64
    """(3,) at the middle."""
    rotation: F64
    """(3, 3) R."""
    scale: float
    own_deg: tuple[float, float]
    """(yaw, pitch) of ``own``: by which the sensors of both sets are turned against each other; 0 if not fitted."""
    off_m: F64
    """(n, 3) what is left of each position."""
    sigma_m: float
    yaw_sigma_deg: float
    tilt_sigma_deg: float
    scale_sigma: float
    """Standard errors by how well the poses agree. Poses that err alike for seconds make them too small."""

    @property
    def yaw_deg(self) -> float:
        return float(np.degrees(np.arctan2(self.rotation[1, 0], self.rotation[0, 0])))

    @property
    def tilt_deg(self) -> float:
        return float(np.degrees(np.arccos(np.clip(self.rotation[2, 2], -1.0, 1.0))))

    @property
    def rms_m(self) -> float:
        """Root mean square of what is left of the positions."""
        return float(np.sqrt((self.off_m**2).sum(axis=1).mean()))

    def applied(self, T: F64) -> F64:
        """Poses (n, 4, 4) of the first set as the second has them."""
        out = np.tile(np.eye(4), (len(T), 1, 1))
        yaw, pitch = np.radians(self.own_deg)
        own = scipy.spatial.transform.Rotation.from_euler("zy", [yaw, pitch]).as_matrix()
        out[:, :3, :3] = self.rotation @ T[:, :3, :3] @ own
        out[:, :3, 3] = self.middle + self.offset_m + self.scale * (T[:, :3, 3] - self.middle) @ self.rotation.T
        return out


def fit_similarity(
    T_from: F64,
    T_to: F64,
    *,
    position_m: float,
    rotation_rad: float,
    scale: tuple[float, float] | None = None,
    own_turn: bool = False,
) -> Similarity:
    """The similarity from poses (n, 4, 4) to poses (n, 4, 4) of the same scans, by robust least squares.

    ``position_m`` and ``rotation_rad``: errors of a pose; what is off by more than two of them counts less.
    ``scale``: (value, standard error) as known before. ``own_turn``: also fit the yaw and pitch by which the sensors of
    both sets are turned against each other; this needs a drive that moves.
    """
    Rotation = scipy.spatial.transform.Rotation
    middle = T_from[:, :3, 3].mean(axis=0)
    p, q = T_from[:, :3, 3] - middle, T_to[:, :3, 3] - T_to[:, :3, 3].mean(axis=0)
    apart = T_to[:, :3, 3].mean(axis=0) - middle
    R_from, R_to = Rotation.from_matrix(T_from[:, :3, :3]), Rotation.from_matrix(T_to[:, :3, :3])
    known, sigma_known = scale or (1.0, np.inf)

    def moved(x: F64) -> F64:
        return np.asarray(np.exp(x[6]) * Rotation.from_rotvec(x[3:6]).apply(p) + x[:3] - q)

    def off(x: F64) -> F64:
        rotated = Rotation.from_rotvec(x[3:6]) * R_from
        if own_turn:
            rotated = rotated * Rotation.from_euler("zy", x[7:])
        rotations = (rotated.inv() * R_to).as_rotvec() / rotation_rad
        return np.concatenate(
            [(moved(x) / position_m).ravel(), rotations.ravel(), [(x[6] - np.log(known)) / sigma_known]]
        )

    turned = (R_to * R_from.inv()).mean().as_rotvec()
    start = np.concatenate([np.zeros(3), turned, [np.log(known)], np.zeros(2 if own_turn else 0)])
    found = scipy.optimize.least_squares(off, start, loss="soft_l1", f_scale=2.0, max_nfev=100)
    x = found.x
    spread = max(1.0, 1.4826 * float(np.median(np.abs(found.fun))))
    sigma = spread * np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)))
    return Similarity(
        middle=middle,
        offset_m=apart + x[:3],
        rotation=Rotation.from_rotvec(x[3:6]).as_matrix(),
        scale=float(np.exp(x[6])),
        own_deg=(float(np.degrees(x[7])), float(np.degrees(x[8]))) if own_turn else (0.0, 0.0),
        off_m=moved(x),
        sigma_m=float(np.linalg.norm(sigma[:3])),
        yaw_sigma_deg=float(np.degrees(sigma[5])),
        tilt_sigma_deg=float(np.degrees(np.linalg.norm(sigma[3:5]))),
        scale_sigma=float(sigma[6]),
    )
