"""The bench of the real court, on a made-up one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from made_courts import made_court
from mapvote.core.point_map import map_from_points
from mapvote.core.types import MapvoteError
from mapvote_lab.evaluation.experiments.court import Court, cast_drive


def test_cast_scans_end_on_the_first_surface_and_see_nothing_behind_it() -> None:
    drive = cast_drive("robot", map_from_points(made_court(())))
    assert len(drive) > 5
    assert drive.T_map_lidar_prior is not None
    T = drive.T_map_lidar_prior[0]
    points = drive.read_scan(0).points @ T[:3, :3].T + T[:3, 3]
    assert (points[:, 1] > -22.6).all()  # the south wall stands at y = -22, and ground lies behind it
    assert (np.abs(points[:, 2] - 0.01 * points[:, 0] - 0.005 * points[:, 1]) < 0.3).mean() > 0.2


def test_a_folder_without_the_clouds_is_refused_with_where_they_come_from(tmp_path: Path) -> None:
    with pytest.raises(MapvoteError, match=r"no gtmap.pcd; docs/diff.md"):
        Court.read(tmp_path)
