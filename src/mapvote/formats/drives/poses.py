"""Trajectories in text: KITTI's rows of 12 numbers, its camera poses with calib.txt (Geiger et al. 2013)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapvote.core import geometry
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.extras import read_text


def read_numbers(file: Path, columns: int) -> F64:
    """(n, columns) float64 of a text file of numbers; MapvoteError names the line that is not one."""
    lines = read_text(file).splitlines()
    rows = [(number, line.replace(",", " ").split()) for number, line in enumerate(lines, 1) if _holds(line)]
    out = np.empty((len(rows), columns))
    for i, (number, words) in enumerate(rows):
        try:
            out[i] = [float(word) for word in words]
        except ValueError as error:
            raise MapvoteError(f"{file}:{number}: expected {columns} numbers, found {len(words)}: {error}") from error
    return out


def _holds(line: str) -> bool:
    """Whether a line is neither empty nor a comment."""
    return bool(line.strip()) and not line.lstrip().startswith("#")


def read_poses(file: Path) -> F64:
    """(n, 4, 4) from rows of 12 numbers (3 x 4) or 16 (4 x 4), as they stand in the file. MapvoteError if not rigid."""
    first = next((line for line in read_text(file).splitlines() if line.strip()), "")
    columns = 16 if len(first.replace(",", " ").split()) == 16 else 12
    rows = read_numbers(file, columns)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = rows[:, :12].reshape(-1, 3, 4)
    check_rigid(T, str(file))
    return T


def check_rigid(T: F64, where: str) -> None:
    """MapvoteError naming the first of the poses (n, 4, 4) that is not a right-handed rigid motion, and its defect."""
    for i, T_i in enumerate(T):
        if geometry.is_rigid(T_i):
            continue
        R = T_i[:3, :3]
        if not np.isfinite(T_i).all():
            defect = "holds a value that is not a number"
        elif np.allclose(R @ R.T, np.eye(3), atol=1e-3):
            defect = "is left-handed (determinant -1): one axis points the wrong way; flip it in all poses"
        else:
            scale = float(np.cbrt(abs(np.linalg.det(R))))
            defect = f"has a rotation that is not orthonormal (scale {scale:.3f}); each row is a 3 x 4 T_map_lidar"
        raise MapvoteError(f"{where}: pose {i} {defect}")


def read_calib(file: Path) -> dict[str, F64]:
    """The lines "name: numbers" of a KITTI calibration file; names without numbers are left out."""
    out = {}
    for line in read_text(file).splitlines():
        name, colon, numbers = line.partition(":")
        try:
            out[name.strip()] = np.array([float(word) for word in numbers.split()])
        except ValueError:
            continue  # calib_time: 09-Jan-2012 13:57:47
        if not colon:
            raise MapvoteError(f"{file}: not a KITTI calibration: {line!r} has no colon")
    return out


def read_T_camera_lidar(file: Path) -> F64:
    """(4, 4) from the line Tr (or Tr_velo_cam, Tr_velo_to_cam) of KITTI odometry's calib.txt."""
    calib = read_calib(file)
    for name in ("Tr", "Tr_velo_cam", "Tr_velo_to_cam"):
        if name in calib and calib[name].size == 12:
            T = np.eye(4)
            T[:3] = calib[name].reshape(3, 4)
            check_rigid(T[None], f"{file} ({name})")
            return T
    raise MapvoteError(f"{file}: no line 'Tr:' with 12 numbers, the motion from LiDAR to camera")


def camera_to_lidar(T_world_camera: F64, T_camera_lidar: F64) -> F64:
    """KITTI odometry's poses (n, 4, 4), relative to the first camera, as T_map_lidar in the first LiDAR's frame."""
    return geometry.inverse(T_camera_lidar) @ T_world_camera @ T_camera_lidar


def travels_along(T: F64) -> str:
    """The local axis, "+x" ... "-z", along which the vehicle moves by most of its way; "" if it hardly moves (1 m)."""
    steps = np.einsum("nji,nj->ni", T[:-1, :3, :3], np.diff(T[:, :3, 3], axis=0))
    total = steps.sum(axis=0) if len(steps) else np.zeros(3)
    axis = int(np.argmax(np.abs(total)))
    if np.abs(total[axis]) < max(1.0, 0.7 * float(np.linalg.norm(steps, axis=1).sum())):
        return ""
    return f"{'+' if total[axis] > 0 else '-'}{'xyz'[axis]}"


def read_T_map_lidar(file: Path, folder: Path) -> F64:
    """Poses (n, 4, 4) of a file of rows as T_map_lidar. Camera poses are recognised by their motion along z.

    With ``folder``/calib.txt (KITTI odometry) they are converted, the map being the first LiDAR frame; without it
    they are a MapvoteError.
    """
    poses = read_poses(file)
    calib = folder / "calib.txt"
    axis = travels_along(poses)
    if axis == "+z" or (calib.is_file() and axis == "" and file.name != "prior.txt"):
        if not calib.is_file():
            raise MapvoteError(
                f"{file}: these are camera poses (the vehicle moves along z, not x); put KITTI's calib.txt into "
                f"{folder} to have them converted, or write T_map_lidar rows"
            )
        return camera_to_lidar(poses, read_T_camera_lidar(calib))
    return poses
