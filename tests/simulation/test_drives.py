"""A simulated drive is a drive folder like anyone's, with the truth apart from it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mapvote.core.geometry import inverse, log, transform
from mapvote.core.types import F64, MapvoteError
from mapvote.formats import open_drive
from mapvote.formats.drives.trajectory import read_poses
from mapvote_lab.simulation import simulate

FEW = {"length_m": 30.0, "speed_kmh": 90.0, "vehicles": 2, "changes": [], "sensor": "vlp16"}


@pytest.fixture(scope="module")
def corner(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sim") / "corner"
    simulate("corner", out, seed=3)
    return out


@pytest.mark.slow
def test_every_drive_has_scans_times_priors_and_true_poses(corner: Path) -> None:
    drives = sorted(p.name for p in corner.iterdir() if p.name != "truth")
    assert drives == ["survey_1", "survey_2", "v1", "v2", "v3"]
    for name in drives:
        scans = sorted((corner / name / "velodyne").glob("*.bin"))
        assert len(np.loadtxt(corner / name / "times.txt")) == len(scans) == 33
        assert np.loadtxt(corner / name / "prior.txt").shape == (33, 12)
        assert np.loadtxt(corner / "truth" / name / "poses.txt").shape == (33, 12)
        moving = np.load(corner / "truth" / name / "moving" / "000010.npy")
        assert moving.dtype == np.bool_
        assert 16 * len(moving) == scans[10].stat().st_size
        assert 60_000 < len(moving) < 72_000, "about 70,000 points a scan (paper II)"


def deskewed(root: Path, drive: str, index: int) -> F64:
    """(n, 3) map points of a scan, each moved from where the sensor was when it measured (constant twist)."""
    points = np.fromfile(root / drive / f"velodyne/{index:06d}.bin", "<f4").reshape(-1, 4)[:, :3].astype(float)
    time_s = -np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) / 10.0
    poses = np.loadtxt(root / "truth" / drive / "poses.txt").reshape(-1, 3, 4)
    twist = log(inverse(square(poses[index - 1])) @ square(poses[index + 1])) / 0.2
    points += time_s[:, None] * (twist[:3] + np.cross(twist[3:], points))
    return transform(square(poses[index]), points)


def square(T: F64) -> F64:
    return np.vstack([T, [0, 0, 0, 1]])


@pytest.mark.slow
def test_only_vehicles_meet_what_was_built_after_the_survey(corner: Path) -> None:
    gained = np.load(corner / "truth" / "truth.npz")["strict"] == 1
    hits = {"survey_1": 0, "v1": 0}
    for name in hits:
        for i in range(1, 32, 8):
            here = deskewed(corner, name, i)
            cells = np.floor(here[here[:, 2] > 1.0, :2] / 0.3).astype(int)
            cells = cells[((cells >= 0) & (cells < (120, 200))).all(axis=1)]
            hits[name] += int(gained[cells[:, 1], cells[:, 0]].sum())
    assert hits["v1"] > 5000
    assert hits["survey_1"] < 0.005 * hits["v1"]


@pytest.mark.slow
def test_the_sensor_moves_while_it_turns(corner: Path) -> None:
    surface = np.load(corner / "truth" / "surface.npz")
    tree = cKDTree(surface["points"][surface["label"] != 2])
    still = ~np.load(corner / "truth" / "v2" / "moving" / "000015.npy")
    clean = deskewed(corner, "v2", 15)
    raw = np.fromfile(corner / "v2/velodyne/000015.bin", "<f4").reshape(-1, 4)[:, :3]
    skewed = transform(square(np.loadtxt(corner / "truth" / "v2" / "poses.txt").reshape(-1, 3, 4)[15]), raw)
    high = still & (clean[:, 2] > 1.0) & (abs(clean[:, 0] - 18) < 25) & (abs(clean[:, 1] - 30) < 25)
    near, far = (np.mean(tree.query(points[high])[0] < 0.3) for points in (clean, skewed))
    assert near > 0.96
    assert far < 0.9


@pytest.mark.slow
def test_truth_names_what_was_built_and_demolished(corner: Path) -> None:
    objects = json.loads((corner / "truth" / "objects.json").read_text())["objects"]
    kinds = [o["kind"] for o in objects if o["what"] == "building"]
    assert sorted(kinds) == ["built", "demolished"]
    truth = np.load(corner / "truth" / "truth.npz")
    for name in ("strict", "provenance"):
        assert truth[name].shape == (200, 120)
        assert set(np.unique(truth[name])) == {0, 1, 2, 255}
    assert (float(truth["x0"]), float(truth["y0"]), float(truth["cell_size"])) == (0.0, 0.0, 0.3)


@pytest.mark.slow
def test_a_survey_and_a_vehicle_are_whole_before_the_others(tmp_path: Path) -> None:
    """The demo draws its first picture of them."""
    told: list[tuple[str, str, list[str]]] = []

    def begun(folder: Path, survey: str, vehicle: str) -> None:
        for name in (survey, vehicle):
            assert 0 < len(open_drive(folder / name)) == len(read_poses(folder / "truth" / name / "poses.txt"))
        told.append((survey, vehicle, sorted(path.parent.name for path in folder.glob("*/drive.toml"))))

    simulate("corner", tmp_path / "out", seed=5, overrides=FEW, workers=1, begun=begun)
    assert told == [("survey_1", "v1", ["survey_1", "v1"])]


@pytest.mark.slow
def test_same_seed_same_bytes_whatever_the_number_of_processes(tmp_path: Path) -> None:
    simulate("corner", tmp_path / "a", seed=5, overrides=FEW, workers=1)
    simulate("corner", tmp_path / "b", seed=5, overrides=FEW, workers=2)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(tmp_path / "b") for p in (tmp_path / "b").rglob("*") if p.is_file())
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


@pytest.mark.slow
def test_a_street_where_nothing_is_built_has_no_changed_cell(tmp_path: Path) -> None:
    calm = FEW | {"clutter": {"visitor_share": 0.0}, "vehicles": 1}
    simulate("corner", tmp_path / "out", seed=6, overrides=calm)
    truth = np.load(tmp_path / "out" / "truth" / "truth.npz")
    assert not np.isin(truth["strict"], (1, 2)).any()
    assert not np.isin(truth["provenance"], (1, 2)).any()


def test_bad_scenarios_say_what_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(MapvoteError, match="trafic"):
        simulate("corner", tmp_path / "x", overrides={"trafic": {}})
    with pytest.raises(MapvoteError, match="choose one of"):
        simulate("cornr", tmp_path / "x")
    crowded = [{"kind": "built", "side": "north", "from_m": 5, "to_m": 25, "count": 9}]
    with pytest.raises(MapvoteError, match="do not fit"):
        simulate("corner", tmp_path / "x", overrides={"changes": crowded})
    assert list(tmp_path.iterdir()) == [], "nothing half-written"
    (tmp_path / "old").mkdir()
    with pytest.raises(MapvoteError, match="exists already"):
        simulate("corner", tmp_path / "old")
