"""A simulated drive is a drive folder like anyone's, with the truth apart from it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mapvote.core.geometry import transform
from mapvote.core.types import MapvoteError
from mapvote.simulation import simulate

FEW = {"length_m": 30.0, "speed_kmh": 90.0, "vehicles": 2, "changes": []}


@pytest.fixture(scope="module")
def corner(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sim") / "corner"
    simulate("corner", out, seed=3)
    return out


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


def test_the_points_of_a_built_building_lie_on_its_surface(corner: Path) -> None:
    surface = np.load(corner / "truth" / "surface.npz")
    added = surface["points"][surface["label"] == 1]
    poses = np.loadtxt(corner / "truth" / "v1" / "poses.txt").reshape(-1, 3, 4)
    cells = {tuple(c) for c in np.floor(added[:, :2] / 0.3).astype(int)}
    hits = {"survey_1": 0, "v1": 0}
    for name in hits:
        poses = np.loadtxt(corner / "truth" / name / "poses.txt").reshape(-1, 3, 4)
        for i in range(0, 33, 8):
            points = np.fromfile(corner / name / f"velodyne/{i:06d}.bin", "<f4").reshape(-1, 4)[:, :3]
            T = np.vstack([poses[i], [0, 0, 0, 1]])
            here = transform(T, points)
            high = here[here[:, 2] > added[:, 2].min() + 1.0]
            hits[name] += sum(tuple(c) in cells for c in np.floor(high[:, :2] / 0.3).astype(int))
    assert hits["v1"] > 20 * max(hits["survey_1"], 1), "only vehicles meet what was built after the survey"


def test_truth_names_what_was_built_and_demolished(corner: Path) -> None:
    objects = json.loads((corner / "truth" / "objects.json").read_text())["objects"]
    kinds = [o["kind"] for o in objects if o["what"] == "building"]
    assert sorted(kinds) == ["built", "demolished"]
    truth = np.load(corner / "truth" / "truth.npz")
    for name in ("strict", "provenance"):
        assert truth[name].shape == (200, 120)
        assert set(np.unique(truth[name])) == {0, 1, 2, 255}
    assert (float(truth["x0"]), float(truth["y0"]), float(truth["cell_size"])) == (0.0, 0.0, 0.3)


def test_same_seed_same_bytes_whatever_the_number_of_processes(tmp_path: Path) -> None:
    simulate("corner", tmp_path / "a", seed=5, overrides=FEW, workers=1)
    simulate("corner", tmp_path / "b", seed=5, overrides=FEW, workers=2)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(tmp_path / "b") for p in (tmp_path / "b").rglob("*") if p.is_file())
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


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
    with pytest.raises(MapvoteError, match="do not fit"):
        crowded = [{"kind": "built", "side": "north", "from_m": 5, "to_m": 25, "count": 9}]
        simulate("corner", tmp_path / "x", overrides={"changes": crowded})
    assert list(tmp_path.iterdir()) == [], "nothing half-written"
    (tmp_path / "old").mkdir()
    with pytest.raises(MapvoteError, match="exists already"):
        simulate("corner", tmp_path / "old")
