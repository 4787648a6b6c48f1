"""Noise is as large and as slow as it says; the oracles say what the simulator knows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hand_made import AtOnce, two_walls
from mapvote.core.types import Drive, PosePrior, Registration, Scan
from mapvote.formats import open_drive
from mapvote.localisation.odometry import Fix
from mapvote_lab.evaluation.conditions import Conditions, Shaken, TrueMovers, with_true_ground
from mapvote_lab.evaluation.truths import read_truth
from mapvote_lab.simulation import simulate
from mapvote_lab.simulation.routes import PRIOR_MEMORY_S, ar1
from mapvote_lab.simulation.scenario import load_scenario
from mapvote_lab.simulation.world import make_world


def test_ar1_noise_has_its_deviation_and_its_memory() -> None:
    errors = ar1(np.full(199_999, 0.1), np.array([0.1, 2.0]), np.random.default_rng(5))
    np.testing.assert_allclose(errors.std(axis=0), [0.1, 2.0], rtol=0.05)
    later = round(PRIOR_MEMORY_S / 0.1)
    correlation = np.corrcoef(errors[:-later, 0], errors[later:, 0])[0, 1]
    assert correlation == pytest.approx(np.exp(-1.0), abs=0.05)


def still(scan: Scan, prior: PosePrior | None) -> Fix:
    return Fix(scan, Registration(np.eye(4), np.zeros((6, 6)), 1.0, 1.0, 1, True), scan.points, True)


@pytest.mark.parametrize("told", [False, True])
def test_shaken_poses_stay_rigid_and_only_a_vehicle_that_is_told_doubts_them(told: bool) -> None:
    stamps_ns = np.arange(50, dtype=np.int64) * 100_000_000
    conditions = Conditions(noise_m=0.1, noise_deg=0.2, noise_told=told)
    one, again = (Shaken(AtOnce(still), stamps_ns, conditions, (1, 2)) for _ in range(2))
    scans = [Scan(int(stamp), np.zeros((1, 3), np.float32)) for stamp in stamps_ns]
    for scan in scans:
        found = one.push(scan, None)[0].registration
        T = found.T_map_lidar
        assert 0 < np.linalg.norm(T[:3, 3]) < 1.0
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        np.testing.assert_array_equal(again.push(scan, None)[0].registration.T_map_lidar, T)
        assert found.covariance[0, 0] == pytest.approx(0.01 if told else 0.0)


@pytest.fixture(scope="module")
def corner(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("conditions") / "corner"
    simulate("corner", out, 3, overrides={"vehicles": 1, "length_m": 31.0, "speed_kmh": 100.0}, workers=1)
    return out


@pytest.mark.slow
def test_true_movers_know_the_scans_of_a_thinned_drive_by_their_stamps(corner: Path) -> None:
    truth, whole = read_truth(corner), open_drive(corner / "v1")
    thinned: Drive = open_drive(corner / "v1", scans="::3")
    movers = TrueMovers(truth, whole)
    scan = thinned.read_scan(1)
    points = scan.points.astype(np.float64)
    every = np.ones(len(points), np.bool_)
    [moving] = movers.push(points, np.zeros(3), every, scan.stamp_ns)
    np.testing.assert_array_equal(moving, truth.moving("v1", 3))
    with pytest.raises(ValueError, match="points, but the truth labels"):
        movers.push(points[:5], np.zeros(3), every[:5], scan.stamp_ns)


def test_true_ground_is_the_terrain_and_leaves_points_alone() -> None:
    before = two_walls()
    after = with_true_ground(before, "corner", 1, {})
    terrain = make_world(load_scenario("corner"), 1).terrain
    tile = after.tiles[0, 0]
    assert tile.points is before.tiles[0, 0].points
    assert tile.ground_z[100, 60] == pytest.approx(float(terrain.height(60.5 * 0.3, 100.5 * 0.3)), abs=1e-4)
