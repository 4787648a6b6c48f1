"""How the sensor is mounted by the prior: its poses say which way is up and ahead in the axes of the points.

Roofs, bellies and ceilings carry sensors upside down, on their side and turned. The checks ask for x ahead and z up.
Of a sensor mounted otherwise they get a drive turned so: points C p and poses T C^-1 have the same points in the map.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mapvote.core.types import F64, Drive, Scan
from mapvote.doctor import Finding


@dataclass(frozen=True, slots=True)
class MountRules:
    """What counts as a mount, and as a road below it."""

    usual_deg: float = 20.0
    """A sensor that leans or is turned by no more is looked at in its own axes."""
    lean_deg: float = 30.0
    """A lean by more than this is reported where no road lies below."""
    steady: float = 0.95
    """Length of the mean of unit vectors: up, or ahead, in the axes of the sensor, scan by scan."""
    step_m: float = 1.0
    """Positions so far apart show the way ahead."""
    near_m: float = 15.0
    """The road is looked for in points no farther than this."""
    own_m: float = 2.0
    """Nearer points may be the vehicle's."""
    depth_m: tuple[float, float] = (0.2, 12.0)
    """Of a road below the sensor."""
    bin_m: float = 0.2
    """Thickness of a layer of points."""
    share: float = 0.1
    """Of the near points, in the layer that is the road."""


RULES = MountRules()


@dataclass(frozen=True, slots=True)
class Mount:
    """How a sensor sits by its prior, where that is not as usual."""

    C: F64
    """(4, 4) turns points to x ahead, y left, z up."""
    lean_deg: float
    """Of the sensor's z axis from the vertical."""

    def turned(self, drive: Drive) -> Drive:
        """The same drive, as a sensor in the usual axes would have recorded it."""
        T = drive.T_map_lidar_prior
        return replace(
            drive,
            read_scan=lambda i: _turned(drive.read_scan(i), self.C),
            T_map_lidar_prior=None if T is None else T @ self.C.T,
            T_base_lidar=drive.T_base_lidar @ self.C.T,
        )


def _turned(scan: Scan, C: F64) -> Scan:
    R = C[:3, :3]
    origin = None if scan.origin is None else R @ scan.origin
    others = tuple((start, R @ origin_of) for start, origin_of in scan.others)
    points = np.ascontiguousarray(scan.points @ R.T, dtype=np.float32)
    return replace(scan, points=points, origin=origin, others=others)


def mount_of_prior(T: F64, rules: MountRules = RULES) -> Mount | None:
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
    known = ahead is not None
    if ahead is None:
        ahead = np.eye(3)[int(np.argmin(np.abs(up)))] if abs(up[0]) > 0.7 else np.eye(3)[0]
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    turned_deg = float(np.degrees(np.arccos(np.clip(ahead[0], -1.0, 1.0)))) if known else 0.0
    if lean_deg <= rules.usual_deg and turned_deg <= rules.usual_deg:
        return None
    C = np.eye(4)
    C[:3, :3] = np.array([ahead, np.cross(up, ahead), up])
    return Mount(C, lean_deg)


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


def check_lean(drive: Drive, index: int, rules: MountRules = RULES) -> Iterator[Finding]:
    """Does a road lie below a sensor that leans by the prior? Of scan ``index``; nothing is registered."""
    mount = None if drive.T_map_lidar_prior is None else mount_of_prior(drive.T_map_lidar_prior)
    if mount is None or mount.lean_deg <= rules.lean_deg:
        return
    points = drive.read_scan(index).points @ mount.C[:3, :3].T
    away = np.linalg.norm(points, axis=1)
    heights = points[(away < rules.near_m) & (away > rules.own_m), 2]
    layers = np.bincount(np.floor((heights + rules.near_m) / rules.bin_m).astype(np.int64), minlength=1)
    densest_m = (int(np.argmax(layers)) + 0.5) * rules.bin_m - rules.near_m
    low, high = rules.depth_m
    what = f"the prior tilts the sensor by {mount.lean_deg:.0f} deg"
    if low <= -densest_m <= high and layers.max() >= rules.share * max(len(heights), 1):
        yield Finding("note", f"{what}, and by the points a road lies {-densest_m:.1f} m below it: it is mounted so")
        return
    mend = "is it mounted so? Else mend the prior's rotations: x is forward, z up"
    yield Finding("warning", f"{what}, but no road lies below it then", mend)
