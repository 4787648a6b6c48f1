"""A surveyor's day: build a map from a drive with ordinary GNSS, look at how it fits, ask the map about its ground."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from typer.testing import CliRunner

from command_line import type_in
from mapvote.cli import app
from mapvote.core.sensors import SENSORS
from mapvote.formats import DriveWriter
from streets import drive_along, path

START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def survey(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """24 scans at 10 m/s through the street of the tests; priors alike off by a metre, two of them wild."""
    monkeypatch.chdir(tmp_path)
    poses = path(24, -12.0)
    told = poses.copy()
    told[:, :2, 3] += [0.8, -0.6]
    told[[5, 17], 0, 3] += 20.0
    drive, writer = drive_along(poses, 31), DriveWriter(Path("survey"), "car", SENSORS["hdl32e"], START_NS, 1.0).open()
    for i, scan in enumerate(drive):
        writer.write_scan(i, scan.points)
    writer.close(START_NS + np.arange(24) * 100_000_000, told)
    return Path("survey")


@pytest.mark.slow
def test_build_draws_how_the_drives_fit_and_tells_the_height_over_the_ground(survey: Path) -> None:
    said = type_in(f"mapvote build {survey} --out map --report fit.png")
    assert "car: 24 of 24 scans, 23 m; off its prior by" in said
    assert "car: sensor 1.79 m over the ground (median), off by 0.0" in said
    assert "warning" not in said
    assert "fit.png: the drives' trajectories and their distance from the priors" in said
    picture = imread("fit.png")
    assert min(picture.shape[:2]) > 400
    assert len(np.unique(picture.reshape(-1, picture.shape[2]), axis=0)) > 20, "lines, dots and words are drawn"
    assert "sensor 1.79 m over the ground" in type_in("mapvote info map")
    doctor = CliRunner().invoke(app, ["doctor", str(survey), "--map", "map"], env={"COLUMNS": "200"})
    assert doctor.exit_code == 0, "two of its priors are wild: the map leaves them out"
    assert "the prior jumps 4 times" in doctor.output
    assert "by the scans themselves the sensor stands 1.8 m over the road" in doctor.output
