"""Wrong frames, named by trial: which reading of the poses or axes makes scans of one drive fit each other best?

Nothing here needs a map. Two scans a few metres apart, laid into one frame by the prior, share their walls; if the
prior is read wrongly they do not, and the reading under which they do is the diagnosis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapvote.core import geometry
from mapvote.core.types import F32, F64, I64, Drive, MapvoteError
from mapvote.core.voxels import voxel_downsample, voxel_keys
from mapvote.formats.doctor.finding import Finding

UPS = {
    "+x": np.array([1.0, 0, 0]),
    "-x": np.array([-1.0, 0, 0]),
    "+y": np.array([0, 1.0, 0]),
    "-y": np.array([0, -1.0, 0]),
    "+z": np.array([0, 0, 1.0]),
    "-z": np.array([0, 0, -1.0]),
}
CAMERA_TO_LIDAR = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From x right, y down, z forward to x forward, y left, z up."""
VOXEL_M = 0.5
_RANGE_M = 40.0
_ROAD_SHARE = 0.1
"""A layer with fewer of a scan's near points than this is no road."""


def ground_share(points: F32, up: F64) -> tuple[float, float]:
    """(share, depth): the share of near points in the fullest 0.2 m layer 0.6-4 m below the sensor, and its depth."""
    p = points.astype(np.float64)
    near = p[np.linalg.norm(p, axis=1) < 25.0]
    depth, edges = np.histogram(-(near @ up), bins=17, range=(0.6, 4.0))
    best = int(np.argmax(depth))
    return float(depth[best]) / max(len(near), 1), float(edges[best] + 0.1)


def up_axis(scans: list[F32]) -> tuple[str, float]:
    """The axis that points up in these scans ("+z" as it should), by the road below the sensor, and the road's depth.

    "+z" unless another axis has half as much again: a wall beside a lane is no road.
    """
    share = {name: float(np.mean([ground_share(s, up)[0] for s in scans])) for name, up in UPS.items()}
    best = max(share, key=lambda name: share[name])
    if share[best] < max(1.5 * share["+z"], _ROAD_SHARE):
        best = "+z"
    return best, float(np.median([ground_share(s, UPS[best])[1] for s in scans]))


@dataclass(frozen=True, slots=True)
class Reading:
    """One way to read a drive: what is wrong if it fits best, and how to mend it."""

    name: str
    mend: str
    poses: Callable[[F64], F64] = lambda T: T
    points: Callable[[F64], F64] = lambda p: p


def _scaled(factor: float) -> Callable[[F64], F64]:
    def read(T: F64) -> F64:
        out = T.copy()
        out[:3, 3] *= factor
        return out

    return read


def _transposed(T: F64) -> F64:
    out = T.copy()
    out[:3, :3] = T[:3, :3].T
    return out


def _compass(T: F64) -> F64:
    yaw = np.arctan2(T[1, 0], T[0, 0])
    return geometry.from_xyz_rpy(T[0, 3], T[1, 3], T[2, 3], yaw=np.pi / 2 - yaw)


AS_IT_IS = Reading("as it is", "")
READINGS = (
    AS_IT_IS,
    Reading(
        "the prior holds inverse poses (T_lidar_map)", "write T_map_lidar, the inverse of each matrix", geometry.inverse
    ),
    Reading(
        "the prior is in camera axes (x right, y down, z forward)",
        "put KITTI's calib.txt into the drive, or write T_map_lidar",
        lambda T: CAMERA_TO_LIDAR @ T @ CAMERA_TO_LIDAR.T,
    ),
    Reading(
        "the prior's rotations are transposed (or its angles clockwise)", "transpose the 3 x 3 rotations", _transposed
    ),
    Reading("the prior's heading is a compass bearing (0 north, clockwise)", "use yaw = 90 deg - bearing", _compass),
    Reading("the prior's positions are in millimetres", "divide its positions by 1000", _scaled(1e-3)),
    Reading("the prior's positions are in centimetres", "divide its positions by 100", _scaled(1e-2)),
    Reading("the prior's positions are in kilometres", "multiply its positions by 1000", _scaled(1e3)),
    Reading(
        "the scans are left-handed (y to the right)",
        "negate y of every point",
        points=lambda p: p * np.array([1.0, -1.0, 1.0]),
    ),
    Reading(
        "the scans face backwards (x to the rear)",
        "turn T_base_lidar or the points by 180 deg about z",
        points=lambda p: p * np.array([-1.0, -1.0, 1.0]),
    ),
)


def structure(points: F32, up: F64, depth_m: float) -> F64:
    """The points (m, 3) of a scan that tell places apart: within 40 m, above the road, one per 0.25 m."""
    p = points.astype(np.float64)
    distance = np.linalg.norm(p, axis=1)
    p = p[(distance > 3.0) & (distance < _RANGE_M) & (p @ up > 0.6 - depth_m)]
    return p[voxel_downsample(p, 0.25)]


def fit(pairs: list[tuple[F64, F64, F64, F64]], reading: Reading) -> float:
    """Mean share of the second scan's structure that falls into 0.5 m voxels of the first's, under ``reading``.

    ``pairs``: (points a, T_map_a, points b, T_map_b), points (n, 3) in their own frames.
    """
    shares = []
    for points_a, T_a, points_b, T_b in pairs:
        T_a_b = geometry.inverse(reading.poses(T_a)) @ reading.poses(T_b)
        b = geometry.transform(T_a_b, reading.points(points_b))
        b = b[np.linalg.norm(b, axis=1) < _RANGE_M]
        if len(b) < 20 or np.abs(T_a_b[:3, 3]).max() > 2 * _RANGE_M:
            shares.append(0.0)
            continue
        occupied = np.unique(voxel_keys(reading.points(points_a), 0.0, 0.0, VOXEL_M))
        shares.append(float(np.isin(voxel_keys(b, 0.0, 0.0, VOXEL_M), occupied).mean()))
    return float(np.mean(shares)) if shares else 0.0


def pairs_of_scans(T: F64, stamps_ns: I64, count: int = 6) -> list[tuple[int, int]]:
    """Pairs of scans about half a second apart, those that turn most first, then spread over the drive."""
    gap = max(1, round(5e8 / float(np.median(np.diff(stamps_ns))))) if len(stamps_ns) > 1 else 1
    starts = np.arange(0, len(T) - gap)
    if len(starts) == 0:
        return []
    turn = np.array([geometry.rotation_angle(geometry.inverse(T[i]) @ T[i + gap]) for i in starts])
    chosen: NDArray[np.int64] = np.unique(
        np.r_[starts[np.argsort(-turn, kind="stable")[: count // 2]], starts[:: max(1, len(starts) // (count // 2))]]
    )
    return [(int(i), int(i) + gap) for i in chosen[: 2 * count]]


def check_up(up: str, depth_m: float) -> list[Finding]:
    if up == "+z":
        return []
    if up == "-z":
        what = f"the sensor is upside down: the road lies {depth_m:.1f} m above it (z points down)"
        return [Finding("error", what, "negate y and z of every point, or mount the frame so that z points up")]
    what = f"the points' axis {up} points up (the road lies {depth_m:.1f} m along its opposite), not z"
    return [
        Finding(
            "error", what, "turn the points to x forward, y left, z up (camera axes are x right, y down, z forward)"
        )
    ]


def check_frames(drive: Drive, T: F64, up: F64, depth_m: float) -> list[Finding]:
    cache: dict[int, F64] = {}

    def points_of(i: int) -> F64:
        if i not in cache:
            cache[i] = structure(drive.read_scan(i).points, up, depth_m)
        return cache[i]

    try:
        indices = pairs_of_scans(T, drive.stamps_ns)
        pairs = [(points_of(a), T[a], points_of(b), T[b]) for a, b in indices]
    except MapvoteError:
        return []  # named already, or met when the drive is used
    scores = {r: fit(pairs, r) for r in READINGS}
    still = fit([(a, np.eye(4), b, np.eye(4)) for a, _, b, _ in pairs], AS_IT_IS)
    best = max(READINGS, key=lambda r: scores[r])
    found = []
    if scores[best] > 1.2 * scores[AS_IT_IS] + 0.02 and scores[best] > 1.05 * still:
        what = f"{best.name}: so {scores[best]:.0%} of a scan falls on the scan before, else {scores[AS_IT_IS]:.0%}"
        found.append(Finding("error", what, best.mend))
    elif still > 1.2 * scores[AS_IT_IS] + 0.02:
        what = f"scans fit better if the vehicle stood still ({still:.0%}) than by the prior ({scores[AS_IT_IS]:.0%})"
        found.append(Finding("warning", what, "is it the trajectory of this drive, one row for each scan?"))
    turned = max((geometry.rotation_angle(geometry.inverse(a) @ b) for _, a, _, b in pairs), default=0.0)
    if not found and np.rad2deg(turned) < 3.0:
        found.append(Finding("note", "the drive is straight: mirrored scans (left-handed axes) would not be noticed"))
    return found
