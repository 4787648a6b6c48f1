"""A survey's fit to its priors is drawn, breaks and lost scans included."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from mapvote.plots import draw_survey
from mapvote.slam.build import BuildReport
from mapvote.slam.pose_graph import DriveTrack
from streets import drive_along, path

POSES = path(10)
DRIVE = drive_along(POSES, 1, POSES.copy())
REPORT = BuildReport((DriveTrack(DRIVE, POSES, np.arange(10) != 4, (5,), np.full(10, 0.3)),), 1, 0.0, None)


def test_the_picture_is_the_same_each_time(tmp_path: Path) -> None:
    for name in ("one.png", "two.png"):
        draw_survey([DRIVE], REPORT, tmp_path / name)
    assert (tmp_path / "one.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_a_drive_without_priors_is_drawn_too(tmp_path: Path) -> None:
    draw_survey([replace(DRIVE, T_map_lidar_prior=None)], REPORT, tmp_path / "x.png")
    assert (tmp_path / "x.png").stat().st_size > 1000
