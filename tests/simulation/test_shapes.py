"""Parts of the street: solids by their measures, foliage that lets rays pass, the ground and its mesh."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core.types import F64
from mapvote_lab.simulation import shapes
from mapvote_lab.simulation.scenario import load_scenario
from mapvote_lab.simulation.world import STREET, make_terrain

sizes = st.floats(0.2, 5.0)
few = settings(max_examples=20)


def area(triangles: F64) -> float:
    edges = triangles[:, 1:] - triangles[:, :1]
    return float(0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum())


def volume(triangles: F64) -> float:
    """By the divergence theorem: right only of a closed surface whose faces all look outwards, or all inwards."""
    return abs(float(np.einsum("ij,ij->", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6.0))


def bounds(triangles: F64) -> list[tuple[float, float]]:
    flat = triangles.reshape(-1, 3)
    return [(round(float(a), 6), round(float(b), 6)) for a, b in zip(flat.min(axis=0), flat.max(axis=0), strict=True)]


@few
@given(sizes, sizes, sizes, st.floats(-20, 20))
def test_a_box_is_closed_and_has_the_area_and_volume_of_a_box(x: float, y: float, z: float, at: float) -> None:
    solid = shapes.box(at, at + x, -at, -at + y, 1.0, 1.0 + z)
    assert solid.shape == (12, 3, 3)
    assert area(solid) == pytest.approx(2 * (x * y + y * z + z * x))
    assert volume(solid) == pytest.approx(x * y * z, rel=1e-6)


@few
@given(st.integers(3, 20), sizes, sizes)
def test_a_cylinder_is_a_prism_of_so_many_sides_open_below(sides: int, radius: float, height: float) -> None:
    solid = shapes.cylinder(radius, 0.0, height, sides)
    polygon = 0.5 * sides * radius**2 * np.sin(2 * np.pi / sides)
    around = sides * 2 * radius * np.sin(np.pi / sides) * height
    assert area(solid) == pytest.approx(polygon + around)
    assert volume(solid) == pytest.approx(polygon * height), "the open foot lies at height zero and adds nothing"


@few
@given(st.floats(-7, 7), st.floats(-50, 50), st.floats(-50, 50))
def test_a_placed_solid_is_turned_counter_clockwise_about_its_foot_and_then_moved(
    yaw: float, x: float, y: float
) -> None:
    tip = np.array([[[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]])
    placed = shapes.place(tip, x, y, 0.5, yaw)[0]
    np.testing.assert_allclose(placed[0], [x + np.cos(yaw), y + np.sin(yaw), 0.5])
    np.testing.assert_allclose(placed[1:], [[x, y, 0.5], [x, y, 2.5]])


def test_samples_lie_on_the_surface_one_to_each_patch() -> None:
    solid = shapes.box(0, 4, 0, 3, 0, 2)
    points = shapes.sample(solid, 0.1, np.random.default_rng(3))
    assert len(points) == pytest.approx(52 / 0.01, rel=0.05)
    to_faces = np.minimum(points, np.array([4.0, 3.0, 2.0]) - points)
    assert np.abs(to_faces.min(axis=1)).max() < 1e-9
    on_top = points[points[:, 2] == 2.0]
    assert len(on_top) == pytest.approx(1200, rel=0.15)
    assert on_top[:, :2].mean(axis=0) == pytest.approx([2.0, 1.5], abs=0.15)


@pytest.mark.parametrize("seed", range(12))
def test_a_building_stands_on_its_plot_and_hangs_over_the_sidewalk_by_two_metres_at_most(seed: int) -> None:
    rng = np.random.default_rng(seed)
    width, depth, height = rng.uniform(5, 20), rng.uniform(6, 12), rng.uniform(4, 14)
    (x0, x1), (y0, y1), (z0, z1) = bounds(shapes.building(rng, width, depth, height))
    assert -0.7 < x0 < 0.5
    assert width - 0.5 < x1 < width + 0.7
    assert -2.0 < y0 <= 0.0
    assert depth - 0.01 < y1 < depth + 0.7
    assert z0 == shapes.FOOT_M, "its walls reach below any slope"
    assert height <= z1 < height + 3.0


@pytest.mark.parametrize("seed", range(6))
def test_furniture_is_as_high_as_such_things_are_and_rooted_in_the_ground(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for make, low, high in ((shapes.tree, 3.0, 7.5), (shapes.pole, 6.5, 9.0), (shapes.sign, 2.0, 3.2)):
        z0, z1 = bounds(make(rng))[2]
        assert z0 == -0.5
        assert low < z1 <= high
    assert bounds(shapes.street_box(rng))[2][1] <= 2.5
    assert bounds(shapes.rail(10.0)) == [(-0.06, 10.06), (-0.06, 0.06), (-0.3, 0.8)]
    gantry = shapes.gantry(10.0)
    assert bounds(gantry)[1] == (-10.15, 10.15)
    over_the_road = gantry[np.abs(gantry[:, :, 1]).max(axis=1) < 9.0]
    assert bounds(over_the_road)[2][0] > 4.5, "higher than any lorry"


def test_the_mesh_of_the_ground_is_its_height_and_has_no_holes() -> None:
    scenario = load_scenario("corner")
    terrain = make_terrain(scenario, np.random.default_rng(4))
    mesh = terrain.triangles()
    corners = mesh.reshape(-1, 3)
    np.testing.assert_allclose(corners[:, 2], terrain.height(corners[:, 0], corners[:, 1]))
    (x0, x1), (y0, y1), _ = bounds(mesh)
    flat = mesh.copy()
    flat[..., 2] = 0.0
    assert area(flat) == pytest.approx((x1 - x0) * (y1 - y0)), "seen from above, every place is covered once"


@pytest.mark.parametrize("name", ["corner", "street", "junction"])
def test_the_mesh_of_the_carriageway_keeps_to_its_height_up_to_both_kerbs(name: str) -> None:
    terrain = make_terrain(load_scenario(name), np.random.default_rng(4))
    middles = terrain.triangles().mean(axis=1)
    road = middles[terrain.road_distance(middles[:, 0], middles[:, 1]) < STREET.kerb_m - 0.01]
    assert len(road) > 100
    np.testing.assert_allclose(road[:, 2], terrain.height(road[:, 0], road[:, 1]), atol=0.03)
