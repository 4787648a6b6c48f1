"""Content of a truth folder, and the comparison of poses: by hand, and against exact geometry."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core.geometry import exp, from_xyz_rpy
from mapvote.core.grid import CELL_SIZE, Grid, Lattice
from mapvote.core.types import F64, NO_VOTE, MapvoteError
from mapvote_lab.evaluation.truths import (
    Truth,
    error_summary,
    lay_on,
    read_truth,
    rigid_between,
)

ROWS, COLS = 40, 50
X0, Y0 = -3.0, 6.0


def write_scene(scene: Path, **planes: np.ndarray) -> Path:
    """A truth folder as the simulator writes it: nothing changed, but for ``planes``."""
    folder = scene / "truth"
    (folder / "drive_1" / "moving").mkdir(parents=True)
    zero = np.zeros((ROWS, COLS), dtype=np.uint8)
    every = {
        "strict": zero,
        "provenance": zero,
        "reason": zero,
        "densest": zero,
        "hit": zero > 0,
        "passed": zero > 0,
    } | planes
    np.savez(folder / "truth.npz", x0=X0, y0=Y0, **every)
    (folder / "objects.json").write_text(json.dumps({"objects": [{"kind": "built", "height_m": 3.0}]}))
    points = np.array([[1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]], dtype=np.float32)
    np.savez(folder / "surface.npz", points=points, label=np.array([2, 0, 1, 0], dtype=np.uint8))
    rows = np.array([from_xyz_rpy(i, 2.0, 3.0, yaw=0.1)[:3].ravel() for i in range(3)])
    np.savetxt(folder / "drive_1" / "poses.txt", rows)
    np.save(folder / "drive_1" / "moving" / "000012.npy", np.array([0, 1, 1], dtype=np.uint8))
    return scene


@pytest.fixture
def truth(tmp_path: Path) -> Truth:
    return read_truth(write_scene(tmp_path))


def test_a_truth_is_read_as_it_was_written(truth: Truth) -> None:
    assert (truth.x0, truth.y0, truth.strict.shape) == (X0, Y0, (ROWS, COLS))
    assert truth.objects == ({"kind": "built", "height_m": 3.0},)
    kept, added, removed = truth.surfaces()
    assert (kept[:, 0].tolist(), added[:, 0].tolist(), removed[:, 0].tolist()) == ([2, 4], [3], [1])
    assert kept.dtype == np.float64
    np.testing.assert_allclose(truth.poses("drive_1")[2], from_xyz_rpy(2.0, 2.0, 3.0, yaw=0.1), atol=1e-12)
    assert truth.moving("drive_1", 12).tolist() == [False, True, True]


def test_half_a_truth_or_one_of_other_planes_is_none_and_says_what_to_do(tmp_path: Path) -> None:
    folder = write_scene(tmp_path) / "truth"
    np.savez(folder / "truth.npz", strict=np.zeros((2, 2)))
    for missing in ("none", "truth.npz", "objects.json"):
        (folder / missing).unlink(missing_ok=True)
        with pytest.raises(MapvoteError, match=r"truth: no usable truth .* simulate the scene again"):
            read_truth(tmp_path)


def test_a_truth_lies_on_the_lattice_of_a_map_that_starts_on_whole_cells(truth: Truth) -> None:
    assert truth.grid_on(Lattice()) == Grid(Lattice(), 20, -10, ROWS, COLS)
    shifted = Lattice(0.3, -0.6)
    assert truth.grid_on(shifted) == Grid(shifted, 22, -11, ROWS, COLS)
    for off in (Lattice(0.1, 0.0), Lattice(0.0, 0.1)):
        with pytest.raises(MapvoteError, match=r"off the map's lattice .* multiples of 0.3 m"):
            truth.grid_on(off)


def distance_outside(corners: F64, x: F64, y: F64) -> F64:
    """How far points lie outside the edges of a convex polygon that runs counter-clockwise; negative inside."""
    out = np.full(x.shape, -np.inf)
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        out = np.maximum(out, ((by - ay) * (x - ax) - (bx - ax) * (y - ay)) / np.hypot(bx - ax, by - ay))
    return out


@settings(max_examples=20, deadline=None)
@given(st.integers(3, 6), st.floats(0, 6), st.floats(1.0, 4.0), st.booleans())
def test_the_cells_of_a_footprint_have_their_centres_in_it_or_within_60_cm(
    n: int, turned: float, radius: float, clockwise: bool
) -> None:
    angle = turned + 2 * np.pi * np.arange(n) / n
    corners = np.column_stack([4.0 + radius * np.cos(angle), 12.0 + 0.7 * radius * np.sin(angle)])
    zero = np.zeros((ROWS, COLS), dtype=np.uint8)
    truth = Truth(Path(), X0, Y0, zero, zero, zero, zero, zero > 0, zero > 0, ())
    found = truth.cells_of((corners[::-1] if clockwise else corners).tolist())
    assert found.any()
    x, y = np.meshgrid(X0 + (np.arange(COLS) + 0.5) * CELL_SIZE, Y0 + (np.arange(ROWS) + 0.5) * CELL_SIZE)
    away = distance_outside(corners, x, y)
    assert ((found == (away <= 0.6)) | (abs(away - 0.6) < 1e-9)).all()


def test_states_are_laid_on_another_window_and_elsewhere_nobody_voted() -> None:
    states = np.arange(12, dtype=np.uint8).reshape(3, 4)
    laid = lay_on(states, Grid(Lattice(), 10, 20, 3, 4), Grid(Lattice(), 11, 18, 4, 4))
    assert laid.tolist() == [[255, 255, 4, 5], [255, 255, 8, 9], [255] * 4, [255] * 4]
    for row0, col0 in ((13, 20), (10, 24), (0, 0)):  # touching it, or far away
        assert (lay_on(states, Grid(Lattice(), 10, 20, 3, 4), Grid(Lattice(), row0, col0, 3, 3)) == NO_VOTE).all()


def trajectory(rng: np.random.Generator, n: int, straight: bool) -> F64:
    poses = [from_xyz_rpy(2.0 * i, 0.0, 0.0) for i in range(n)]
    return np.array(poses if straight else [T @ exp(rng.normal(0, 0.5, 6)) for T in poses])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 9), st.booleans())
def test_the_motion_between_two_frames_is_found_exactly_on_a_straight_road_too(
    seed: int, n: int, straight: bool
) -> None:
    rng = np.random.default_rng(seed)
    T_map_world = exp(rng.normal(0, 1.0, 6))
    T_world = trajectory(rng, n, straight)
    np.testing.assert_allclose(rigid_between(T_map_world @ T_world, T_world), T_map_world, atol=1e-9)


def test_a_summary_is_of_the_scans_that_were_localised() -> None:
    true = np.tile(np.eye(4), (5, 1, 1))
    found = np.array([from_xyz_rpy(x, 0, 0, yaw=np.radians(x)) for x in (1.0, 2.0, 6.0, 9.0, 0.0)])
    found[3] = np.nan
    found[4, 0, 3] = np.nan
    errors = error_summary(found, true)
    assert (errors.scans, errors.localised) == (5, 3)
    assert (errors.median_m, errors.max_m) == (2.0, 6.0)
    assert errors.p99_m == pytest.approx(5.92)
    assert errors.median_deg == pytest.approx(2.0)
    lost = error_summary(np.full((2, 4, 4), np.nan), true[:2])
    assert (lost.scans, lost.localised, lost.max_m, lost.median_deg) == (2, 0, 0.0, 0.0)
    assert error_summary(from_xyz_rpy(0, 0, 0, yaw=np.pi)[None], np.eye(4)[None]).median_deg == pytest.approx(180.0)
