"""The figures that the filter must reach, against the simulator's labels (docs/measurements quotes larger scenes)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapvote.config import MovingSettings
from mapvote.core.columns import GROUND_MARGIN_M
from mapvote.core.geometry import transform
from mapvote.core.grid import Lattice, window_around
from mapvote.core.point_map import map_from_points
from mapvote.core.reference import reference_window
from mapvote.core.types import Bool
from mapvote.formats import open_drive
from mapvote.perception.moving_objects import MovingFilter
from mapvote_lab.simulation import simulate


def labels(street: Path, vehicle: str, stride: int) -> tuple[Bool, Bool]:
    """(true, found) of every obstacle point of a drive, at true poses; the ground is what all its scans saw."""
    drive = open_drive(street / vehicle, scans=f"::{stride}")
    T_map_lidar = np.tile(np.eye(4), (len(drive), 1, 1))
    T_map_lidar[:, :3] = np.loadtxt(street / "truth" / vehicle / "poses.txt").reshape(-1, 3, 4)[::stride]
    clouds = [transform(T, scan.points) for T, scan in zip(T_map_lidar, drive, strict=True)]
    middle = T_map_lidar[len(drive) // 2, :3, 3]
    grid = window_around(Lattice(), middle[0], middle[1], 260.0)
    ground_z = reference_window(map_from_points(np.concatenate(clouds)), grid).ground_z
    moving = MovingFilter(drive.sensor, MovingSettings())
    masks: list[Bool] = []
    obstacle = []
    for i, points_map in enumerate(clouds):
        rows, cols, inside = grid.indices_of(points_map)
        assert inside.all()
        obstacle.append(points_map[:, 2] - ground_z[rows, cols] > GROUND_MARGIN_M)
        masks += moving.push(points_map, T_map_lidar[i, :3, 3], obstacle[i], int(drive.stamps_ns[i]))
    masks += moving.flush()
    folder = street / "truth" / vehicle / "moving"
    true = [np.load(folder / f"{i * stride:06d}.npy")[mask] for i, mask in enumerate(obstacle)]
    return np.concatenate(true), np.concatenate([masks[i][mask] for i, mask in enumerate(obstacle)])


@pytest.mark.slow
def test_precision_and_recall_per_point_at_10_and_2_hz(tmp_path: Path) -> None:
    simulate("corner", tmp_path / "corner", 2)
    for stride in (1, 5):
        right = found = moving = 0
        for vehicle in ("v1", "v2", "v3"):
            true, called = labels(tmp_path / "corner", vehicle, stride)
            assert true.mean() > 0.05
            assert (true & called).sum() >= 0.45 * true.sum()
            right += int((true & called).sum())
            found += int(called.sum())
            moving += int(true.sum())
        assert right >= 0.97 * found
        assert right >= 0.60 * moving
