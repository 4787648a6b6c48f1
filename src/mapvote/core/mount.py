"""How the sensor is mounted by the prior: its poses say which way is up and ahead in the axes of the points.

Roofs, bellies and ceilings carry sensors upside down, on their side and turned. Whoever asks for x ahead and z up gets
the drive turned: points C p and poses T C^-1 have the same points in the map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from mapvote.core.geometry import from_xyz_rpy, poses_at
from mapvote.core.record import record
from mapvote.core.types import F64, Drive, Scan


@record()
@dataclass(frozen=True, slots=True)
class MountRules:
    """Numbers by which the mount of a sensor is recognised."""

    usual_deg: float = 20.0
    """Greatest lean or turn of a sensor that is taken in its own axes, degrees."""
    steady: float = 0.95
    """Least length of the mean of unit vectors (up, or ahead, in the sensor's axes) over the scans."""
    step_deg: int = 45
    """Step between the mounts that localisation tells apart, degrees."""
    step_m: float = 1.0
    """Least distance between positions that show the direction of travel, metres."""


MOUNT_RULES = MountRules()


@dataclass(frozen=True, slots=True)
class Mount:
    """How a sensor sits by its prior, where that is not as usual."""

    C: F64
    """(4, 4) turns points to x ahead, y left, z up."""
    lean_deg: float
    """Angle of the sensor's z axis from the vertical."""

    def turned(self, drive: Drive) -> Drive:
        """The same drive, as a sensor in the usual axes would have recorded it."""
        T = drive.T_map_lidar_prior
        return replace(
            drive,
            read_scan=lambda i: self.scan(drive.read_scan(i)),
            T_map_lidar_prior=None if T is None else T @ self.C.T,
            T_base_lidar=drive.T_base_lidar @ self.C.T,
        )

    def scan(self, scan: Scan) -> Scan:
        """A scan in the usual axes."""
        R = self.C[:3, :3]
        origin = None if scan.origin is None else R @ scan.origin
        others = tuple((start, R @ origin_of) for start, origin_of in scan.others)
        points = np.ascontiguousarray(scan.points @ R.T, dtype=np.float32)
        return replace(scan, points=points, origin=origin, others=others)

    def in_steps(self) -> Mount:
        """The mount by roll, pitch and yaw in steps of ``MountRules.step_deg`` that is nearest: a prior knows up and
        ahead to some degrees, and matching takes care of what is left, as of any sensor's."""
        nearest = int(np.argmax(np.einsum("nij,ij->n", _TURNS, self.C[:3, :3])))
        return replace(self, C=poses_at([np.zeros(3)], _TURNS[nearest][None])[0])


def mount_of_prior(T: F64, rules: MountRules = MOUNT_RULES) -> Mount | None:
    """The mount that poses T_map_lidar (n, 4, 4) state; None if it is the usual one, or they state none steadily."""
    # Up in the axes of the sensor: the last row of each rotation.
    ups = T[:, 2, :3]
    up = ups.mean(axis=0)
    length = float(np.linalg.norm(up))
    if length < rules.steady:
        return None
    up = up / length
    lean_deg = float(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0))))
    # Ahead: the way driven, else the axis of the sensor that is most level.
    ahead = _ahead(T, rules)
    moves = ahead is not None
    if ahead is None:
        ahead = np.eye(3)[int(np.argmin(np.abs(up)))] if abs(up[0]) > 0.7 else np.eye(3)[0]
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    turned_deg = float(np.degrees(np.arccos(np.clip(ahead[0], -1.0, 1.0)))) if moves else 0.0
    if lean_deg <= rules.usual_deg and turned_deg <= rules.usual_deg:
        return None
    C = np.eye(4)
    C[:3, :3] = np.array([ahead, np.cross(up, ahead), up])
    return Mount(C, lean_deg)


def mount_of_base(T_base_lidar: F64, rules: MountRules = MOUNT_RULES) -> Mount | None:
    """The mount of a LiDAR at T_base_lidar (4, 4) on a vehicle with x ahead and z up; None if it is the usual one."""
    R = T_base_lidar[:3, :3]
    lean_deg = float(np.degrees(np.arccos(np.clip(R[2, 2], -1.0, 1.0))))
    turned_deg = float(np.degrees(np.arctan2(R[1, 0], R[0, 0])))
    if lean_deg <= rules.usual_deg and abs(turned_deg) <= rules.usual_deg:
        return None
    C = np.eye(4)
    C[:3, :3] = R
    return Mount(C, lean_deg)


def mount_of_drive(drive: Drive) -> Mount | None:
    """The mount that the prior of a drive states, where that knows no attitude its T_base_lidar; None if usual."""
    if drive.T_map_lidar_prior is not None and drive.prior_sigmas is None:
        return mount_of_prior(drive.T_map_lidar_prior)
    return mount_of_base(drive.T_base_lidar)


def _rotations(step_deg: int) -> F64:
    """(n, 3, 3) rotations by roll, pitch and yaw in steps about each axis, and their inverses. Quarter turns are exact:
    they round nothing, in whatever order matrices are multiplied."""
    angles = np.radians(np.arange(0, 360, step_deg)).tolist()
    poses = [from_xyz_rpy(0.0, 0.0, 0.0, *rpy) for rpy in product(angles, repeat=3)]
    rotations = np.array(poses)[:, :3, :3]
    whole = np.round(rotations)
    rotations = np.where(np.abs(rotations - whole) < 1e-9, whole, rotations)
    return np.concatenate([rotations, rotations.swapaxes(1, 2)])


_TURNS = _rotations(MOUNT_RULES.step_deg)


def _ahead(T: F64, rules: MountRules) -> F64 | None:
    """(3,) the way driven in the axes of the sensor; None if it stands, or drives no steady way."""
    p = T[:, :3, 3]
    driven_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    after = np.searchsorted(driven_m, driven_m + rules.step_m)
    first = np.flatnonzero(after < len(T))
    if not len(first):
        return None
    ways = np.einsum("nji,nj->ni", T[first, :3, :3], p[after[first]] - p[first])
    length = np.linalg.norm(ways, axis=1)
    ways = ways[length > 1e-6] / length[length > 1e-6, None]
    mean = ways.mean(axis=0) if len(ways) else np.zeros(3)
    return mean if np.linalg.norm(mean) > rules.steady else None
