"""Does a road lie below a sensor that the prior mounts upside down, or on its side? Nothing is registered."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mapvote.core.mount import mount_of_prior
from mapvote.core.record import record
from mapvote.core.types import Drive
from mapvote.doctor import Finding


@record()
@dataclass(frozen=True, slots=True)
class RoadBelow:
    """Numbers of the search for a road below a sensor that leans."""

    lean_deg: float = 30.0
    """Lean of the sensor above which a road is searched for, degrees."""
    near_m: float = 15.0
    """Greatest range of the points that are used, metres."""
    own_m: float = 2.0
    """Least range of the points that are used, metres: nearer ones may be the vehicle's."""
    depth_m: tuple[float, float] = (0.2, 12.0)
    """Least and greatest depth of a road below the sensor, metres."""
    bin_m: float = 0.2
    """Thickness of a layer of points, metres."""
    share: float = 0.1
    """Least share of the used points in the layer of the road."""


RULES = RoadBelow()


def check_lean(drive: Drive, index: int, rules: RoadBelow = RULES) -> Iterator[Finding]:
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
    problem = f"the prior tilts the sensor by {mount.lean_deg:.0f} deg"
    if low <= -densest_m <= high and layers.max() >= rules.share * max(len(heights), 1):
        yield Finding(
            "note",
            f"{problem}: it is mounted that way, for its points show a road {-densest_m:.1f} m below it",
        )
        return
    mend = "if it is not mounted that way, correct the prior's rotations: x is forward, z up"
    yield Finding("warning", f"{problem}, but the points show no road below it", mend)
