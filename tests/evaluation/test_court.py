"""The bench of the real court, on a made-up one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from made_courts import made_court
from mapvote.core.point_map import map_from_points
from mapvote.core.types import F64, Drive, MapvoteError
from mapvote_lab.evaluation.court import COURT_RULE, Court, cast_drive


def test_cast_scans_end_on_the_first_surface_and_see_nothing_behind_it() -> None:
    drive = cast_drive("robot", map_from_points(made_court(())), replace(COURT_RULE, step_m=12.0))
    assert len(drive) > 5
    assert drive.T_map_lidar_prior is not None
    T = drive.T_map_lidar_prior[0]
    points = drive.read_scan(0).points @ T[:3, :3].T + T[:3, 3]
    assert (points[:, 1] > -22.6).all()  # the south wall stands at y = -22, and ground lies behind it
    assert (np.abs(points[:, 2] - 0.01 * points[:, 0] - 0.005 * points[:, 1]) < 0.3).mean() > 0.2


def _crosses(drive: Drive, low: F64, high: F64) -> int:
    """Rays that pass a box (slab test) and end half a metre or more behind it."""
    assert drive.T_map_lidar_prior is not None
    count = 0
    for k, T in enumerate(drive.T_map_lidar_prior):
        way = drive.read_scan(k).points @ T[:3, :3].T
        slabs = np.sort((np.stack([low, high]) - T[:3, 3])[:, None] / way, axis=0)
        entered, left = slabs[0].max(axis=1), slabs[1].min(axis=1)
        count += int(((entered < left) & (entered > 0) & ((1.0 - left) * np.linalg.norm(way, axis=1) > 0.5)).sum())
    return count


@pytest.mark.slow
def test_cast_rays_cross_no_porous_crown_and_no_ground_that_the_session_did_not_survey() -> None:
    rng = np.random.default_rng(3)
    middle, wide = np.array([4.0, -12.0, 1.8]), np.array([1.2, 1.2, 0.8])
    crown = middle + rng.uniform(-wide, wide, (150, 3))
    ground, low, high = made_court(()), middle - 0.6 * wide, middle + 0.6 * wide
    with_crown = np.concatenate([ground, crown])
    unsurveyed = ground[np.hypot(ground[:, 0] - 4.0, ground[:, 1] + 12.0) > 3.0]
    rule = replace(COURT_RULE, step_m=8.0)
    crossed = [_crosses(cast_drive("r", map_from_points(p), rule), low, high) for p in (ground, with_crown, unsurveyed)]
    assert crossed[0] > 200
    assert crossed[1] < 0.03 * crossed[0]
    assert crossed[2] == 0


def test_a_folder_without_the_clouds_is_refused_with_where_they_come_from(tmp_path: Path) -> None:
    with pytest.raises(MapvoteError, match=r"no gtmap.pcd; docs/diff.md"):
        Court.read(tmp_path)
