"""Pictures of a survey and of the doctor's findings: the same picture each time, and whatever is not known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapvote.core.point_map import map_from_points
from mapvote.doctor import Finding
from mapvote.doctor.diagnosis import Diagnosis
from mapvote.plots import draw_diagnosis, draw_survey
from mapvote.survey.build import BuildReport
from mapvote.survey.pose_graph import DriveTrack
from streets import drive_along, path

POSES = path(10)
DRIVE = drive_along(POSES, 1, POSES.copy())


@pytest.fixture(scope="module")
def diagnosis() -> Diagnosis:
    moved = POSES.copy()
    moved[:, 0, 3] += 3.0
    return Diagnosis(
        [Finding("error", "the prior is 3 m off", "move it")], replace(DRIVE, T_map_lidar_prior=moved), POSES
    )


@pytest.mark.slow
def test_the_picture_is_the_same_each_time_and_shows_the_map(tmp_path: Path, diagnosis: Diagnosis) -> None:
    point_map = map_from_points(np.random.default_rng(1).uniform(0, 20, (2000, 3)))
    for name in ("one.png", "two.png"):
        draw_diagnosis(diagnosis, point_map, tmp_path / name)
    draw_diagnosis(diagnosis, None, tmp_path / "without_map.png")
    assert (tmp_path / "one.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    assert (tmp_path / "one.png").read_bytes() != (tmp_path / "without_map.png").read_bytes()


@pytest.mark.slow
def test_an_unknown_value_is_named(tmp_path: Path, diagnosis: Diagnosis) -> None:
    unmended = replace(diagnosis, T_mended=None)
    for less in (
        unmended,
        replace(unmended, drive=replace(DRIVE, T_map_lidar_prior=None)),
        replace(unmended, drive=None),
    ):
        draw_diagnosis(less, None, tmp_path / "x.png")
        assert (tmp_path / "x.png").stat().st_size > 1000


REPORT = BuildReport((DriveTrack(DRIVE, POSES, np.arange(10) != 4, (5,), np.full(10, 0.3)),), 1, 0.0, None)


def test_the_picture_of_a_survey_with_a_break_and_a_lost_scan_is_the_same_each_time(tmp_path: Path) -> None:
    for name in ("one.png", "two.png"):
        draw_survey([DRIVE], REPORT, tmp_path / name)
    assert (tmp_path / "one.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    draw_survey([replace(DRIVE, T_map_lidar_prior=None)], REPORT, tmp_path / "without_priors.png")
    assert (tmp_path / "one.png").read_bytes() != (tmp_path / "without_priors.png").read_bytes()
