"""A survey's fit to its priors is drawn, breaks and lost scans included."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from mapvote.core.sensor_height import Heights
from mapvote.core.types import Drive
from mapvote.plots import draw_survey
from mapvote.slam.build import BuildReport, DriveTrack
from streets import drive_along, path


def survey() -> tuple[Drive, DriveTrack]:
    poses = path(10)
    drive = drive_along(poses, 1, poses.copy())
    registered = np.arange(10) != 4
    heights = Heights(1.8, 0.0, (0.0, 0.0), 0.0, 0.0)
    return drive, DriveTrack("v", "d", poses, registered, 9.0, None, heights, (5,), np.full(10, 0.3))


def test_the_picture_is_the_same_each_time(tmp_path: Path) -> None:
    drive, track = survey()
    report = BuildReport((track,), 1, False, 0.0, None)
    for name in ("one.png", "two.png"):
        draw_survey([drive], report, tmp_path / name)
    assert (tmp_path / "one.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_a_drive_without_priors_is_drawn_too(tmp_path: Path) -> None:
    drive, track = survey()
    draw_survey(
        [replace(drive, T_map_lidar_prior=None)], BuildReport((track,), 1, False, 0.0, None), tmp_path / "x.png"
    )
    assert (tmp_path / "x.png").stat().st_size > 1000
