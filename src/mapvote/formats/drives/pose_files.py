"""Poses of a drive as files that trajectory tools read (evo: ``evo_traj tum``, ``evo_traj kitti``)."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import scipy

from mapvote.core.types import F64
from mapvote.formats.atomic import write_whole

ENDINGS = ".tum", ".kitti"


def write_trajectory(file: Path, stamps_ns: Sequence[int], T_map_lidar: Sequence[F64], lost: Collection[int]) -> int:
    """Write the poses (4, 4) of a drive's scans in the format that the file's ending names; returns how many.

    ``.tum``: stamp in seconds, x, y, z, qx, qy, qz, qw of every scan but the ``lost`` ones. ``.kitti``: rows of 3 x 4
    without stamps; lost scans keep their row, with the best guess, because rows are counted.
    """
    if file.suffix.lower() == ".kitti":
        lines = [" ".join(f"{number:.9f}" for number in T[:3].ravel()) for T in T_map_lidar]
    else:
        lines = [
            _tum_line(stamp_ns, T)
            for i, (stamp_ns, T) in enumerate(zip(stamps_ns, T_map_lidar, strict=True))
            if i not in lost
        ]
    write_whole(file, "".join(f"{line}\n" for line in lines))
    return len(lines)


def _tum_line(stamp_ns: int, T: F64) -> str:
    numbers = [*T[:3, 3], *scipy.spatial.transform.Rotation.from_matrix(np.asarray(T[:3, :3])).as_quat()]
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d} " + " ".join(f"{number:.9f}" for number in numbers)
