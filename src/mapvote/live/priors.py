"""The prior of a scan by odometry or fixes: the last poses, and the last fixes of a receiver."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from mapvote.core.mount import Mount
from mapvote.core.record import record
from mapvote.core.types import F64, MapvoteError, PosePrior
from mapvote.formats.drives.fixes import Fixes, prior_at
from mapvote.formats.drives.trajectory import sorted_trajectory
from mapvote.formats.geo.frame import MapFrame


@record()
@dataclass(frozen=True, slots=True)
class PriorMemory:
    """Which poses of odometry are kept."""

    poses: int = 20_000
    """Poses that are kept at most."""
    around: int = 8
    """Poses before and after a scan that are looked at: one of each is needed where no two have the same time."""
    past_ns: int = 3 * 10**9
    """Poses so much older than the oldest scan that waits are dropped, nanoseconds."""
    back_ns: int = 10**9
    """A stamp so much before the last one: the clock has jumped, nanoseconds."""
    near_jump_ns: int = 10 * 10**9
    """After a jump of the LiDAR's clock, poses so near to the new time are kept, nanoseconds."""


PRIOR_MEMORY = PriorMemory()


class Priors:
    """The last poses and fixes of one vehicle."""

    def __init__(self, memory: PriorMemory = PRIOR_MEMORY) -> None:
        self._memory = memory
        self._poses: deque[tuple[int, F64]] = deque(maxlen=memory.poses)
        self.fixes = Fixes()
        """The last fixes of a receiver; none where odometry says where the vehicle is."""

    def add(self, time_ns: int, T_map_base: F64) -> float:
        """One pose of odometry, in any order. Returns the seconds by which its clock jumped back; 0 if it did not."""
        back_s = 0.0
        if self._poses and time_ns < self._poses[-1][0] - self._memory.back_ns:
            back_s = 1e-9 * (self._poses[-1][0] - time_ns)
            self._poses.clear()
        self._poses.append((time_ns, T_map_base))
        return back_s

    def covers(self, stamp_ns: int) -> bool:
        """Whether no later message changes the pose of this time."""
        if len(self.fixes.times_ns):
            return bool(self.fixes.times_ns[-1] >= stamp_ns)
        return len(self._poses) >= 2 and any(time_ns >= stamp_ns for time_ns, _ in reversed(self._poses))

    def forget_before(self, stamp_ns: int) -> None:
        """No scan before this time will ask."""
        while len(self._poses) > 2 and self._poses[1][0] < stamp_ns - self._memory.past_ns:
            self._poses.popleft()

    def jump_to(self, stamp_ns: int) -> None:
        """The clock of the LiDAR jumped to this time: poses of another time are dropped."""
        near = [pose for pose in self._poses if abs(pose[0] - stamp_ns) < self._memory.near_jump_ns]
        self._poses = deque(near, maxlen=self._memory.poses)

    def at(self, stamp_ns: int, T_base_lidar: F64) -> F64 | PosePrior | None:
        """T_map_lidar (4, 4) by odometry, or the prior by fixes; None where neither covers this time.

        ``T_base_lidar`` (4, 4): the LiDAR on what odometry tracks, or from the antenna.
        """
        if len(self.fixes.times_ns):
            return prior_at(self.fixes, stamp_ns, T_base_lidar)
        if len(self._poses) < 2:
            return None
        # Only the poses around this time: odometry may come 200 times a second.
        times_ns = np.array([time_ns for time_ns, _ in self._poses])
        in_order = np.argsort(times_ns, kind="stable")
        after = int(np.searchsorted(times_ns, stamp_ns, sorter=in_order))
        near = in_order[max(0, after - self._memory.around) : after + self._memory.around]
        T = np.stack([self._poses[place][1] for place in near])
        trajectory = sorted_trajectory(times_ns[near], T, of_vehicle=True, frame=MapFrame())
        try:
            return np.asarray(trajectory.at(np.array([stamp_ns]), "odometry")[0] @ T_base_lidar)
        except MapvoteError:
            return None


def pose_in(prior: F64 | PosePrior | None) -> F64 | None:
    """T_map_lidar (4, 4) of a prior, with or without its own standard deviations."""
    return prior.T_map_lidar if isinstance(prior, PosePrior) else prior


def turned_by(prior: F64 | PosePrior | None, mount: Mount | None) -> F64 | PosePrior | None:
    """A prior of scans that are turned upright by ``mount``, as :meth:`mapvote.core.mount.Mount.turned` has it."""
    if prior is None or mount is None:
        return prior
    if isinstance(prior, PosePrior):
        return replace(prior, T_map_lidar=prior.T_map_lidar @ mount.C.T)
    return np.asarray(prior @ mount.C.T)
