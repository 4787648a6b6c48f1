"""A street that is turned in the map is the same street, and its truth and its drives turn with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapvote.core.geometry import inverse, transform
from mapvote.core.grid import CELL_SIZE
from mapvote.core.types import F64, U8
from mapvote_lab.evaluation.truths import Truth, read_truth
from mapvote_lab.simulation import simulate
from mapvote_lab.simulation.scenario import load_scenario
from mapvote_lab.simulation.truth import T_map_street, truth_grid

SHORT = {"length_m": 36.0, "width_m": 60.0, "speed_kmh": 90.0, "vehicles": 1, "sensor": "vlp16"}


def street(folder: Path, heading_deg: float) -> Path:
    out = folder / f"at_{heading_deg:g}"
    simulate("corner", out, 3, overrides={**SHORT, "heading_deg": heading_deg}, workers=1)
    return out


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return street(tmp_path_factory.mktemp("straight"), 0.0)


@pytest.mark.parametrize("heading_deg", [90.0, -33.0])
@pytest.mark.slow
def test_a_turned_street_is_driven_alike_scan_for_scan_and_lies_where_it_was_turned_to(
    straight: Path, tmp_path: Path, heading_deg: float
) -> None:
    turned, T = street(tmp_path, heading_deg), T_map_street(load_scenario("corner", {"heading_deg": heading_deg}))
    scans = sorted((straight / "v1" / "velodyne").glob("*.bin"))
    assert [(turned / "v1" / "velodyne" / scan.name).read_bytes() for scan in scans] == [s.read_bytes() for s in scans]
    was, now = read_truth(straight), read_truth(turned)
    np.testing.assert_allclose(now.poses("v1"), T @ was.poses("v1"), atol=1e-6)
    for before, after in zip(was.surfaces(), now.surfaces(), strict=True):
        np.testing.assert_allclose(after, transform(T, before), atol=1e-4)
    for one, other in zip(was.objects, now.objects, strict=True):
        np.testing.assert_allclose(turned_by(T, one["footprint"]), other["footprint"], atol=2e-3)


@pytest.mark.slow
def test_by_a_quarter_turn_every_cell_says_what_it_said(straight: Path, tmp_path: Path) -> None:
    was, now = read_truth(straight), read_truth(street(tmp_path, 90.0))
    for before, after in ((was.strict, now.strict), (was.provenance, now.provenance)):
        quarter = np.rot90(before, -1)  # x goes to y, y to -x: rows are y, and their first is the lowest
        assert quarter.shape == after.shape
        assert np.count_nonzero(quarter != after) <= 0.001 * after.size, "but for points on cells' borders"
    assert changed(now).sum() > 50


@pytest.mark.slow
def test_at_any_other_angle_every_changed_cell_lies_where_a_surface_came_or_went(
    straight: Path, tmp_path: Path
) -> None:
    was, now = read_truth(straight), read_truth(street(tmp_path, -33.0))
    rows, cols = np.nonzero(changed(now))
    middle = np.column_stack(
        [now.x0 + (cols + 0.5) * CELL_SIZE, now.y0 + (rows + 0.5) * CELL_SIZE, np.zeros(len(rows))]
    )
    back = transform(inverse(T_map_street(load_scenario("corner", {"heading_deg": -33.0}))), middle)
    near = [np.abs(back[:, None, :2] - surface[None, :, :2]).max(axis=2).min(axis=1) for surface in was.surfaces()[1:]]
    assert (np.minimum(*near) < 0.35).all()


def changed(truth: Truth) -> U8:
    return np.asarray(np.isin(truth.strict, (1, 2)))


def turned_by(T: F64, footprint: list[list[float]]) -> F64:
    return transform(T, np.column_stack([np.array(footprint), np.zeros(len(footprint))]))[:, :2]


@pytest.mark.parametrize("heading_deg", [0.0, 33.0, 90.0, -120.0, 180.0])
def test_the_window_holds_all_of_the_turned_street_and_no_more_than_it_must(heading_deg: float) -> None:
    scenario = load_scenario("street", {"heading_deg": heading_deg})
    grid, T = truth_grid(scenario), T_map_street(scenario)
    corners = transform(T, np.array([[0, 0, 0], [249, 0, 0], [0, 81.3, 0], [249, 81.3, 0.0]]))[:, :2]
    low, high = corners.min(axis=0), corners.max(axis=0)
    np.testing.assert_allclose([grid.x0, grid.y0], low, atol=0.5 * CELL_SIZE + 1e-6)
    size = CELL_SIZE * np.array(grid.shape)[::-1]
    np.testing.assert_allclose(size, high - low, atol=CELL_SIZE + 1e-6)
