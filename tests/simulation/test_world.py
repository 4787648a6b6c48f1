"""The street: what stands there, what moves, and what counts as a change."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.core.types import MapvoteError
from mapvote_lab.simulation.actors import make_traffic
from mapvote_lab.simulation.routes import DRIVE_PLAN, ar1, make_routes
from mapvote_lab.simulation.scenario import load_scenario, scenario_names
from mapvote_lab.simulation.truth import Label, label_cells, truth_grid
from mapvote_lab.simulation.world import Body, Role, make_world


@pytest.mark.parametrize("name", ["as_published", "street570"])
def test_the_papers_street_has_its_514900_cells_and_four_changed_areas(name: str) -> None:
    scenario = load_scenario(name)
    assert truth_grid(scenario).shape == (271, 1900)
    assert [(c.kind, c.count) for c in scenario.changes] == [
        ("built", 1),
        ("demolished", 2),
        ("built", 2),
        ("demolished", 6),
    ]
    world = make_world(scenario, 1)
    buildings = [b.role for b in world.bodies if b.kind == "building"]
    assert buildings.count(Role.ADDED) == 3
    assert buildings.count(Role.REMOVED) == 8


@pytest.mark.parametrize("name", scenario_names())
def test_every_scenario_lays_out_by_seed_and_differently_by_another(name: str) -> None:
    scenario = load_scenario(name)
    one, again, other = (make_world(scenario, seed) for seed in (4, 4, 5))
    first, second, third = (w.mesh(w.standing(None))[0] for w in (one, again, other))
    np.testing.assert_array_equal(first, second)
    assert first.shape != third.shape or not np.allclose(first, third)
    kinds = {body.kind for body in one.bodies}
    assert {"ground", "building", "pole", "parked car"} <= kinds


def test_the_published_scenario_has_what_the_paper_describes_and_nothing_more() -> None:
    scenario = load_scenario("as_published")
    flaws = scenario.flaws.model_dump()
    assert flaws.pop("range_sigma_m") is None, "the noise of its LiDAR's model"
    assert set(flaws.values()) == {0.0}
    world = make_world(scenario, 1)
    assert {body.kind for body in world.bodies} == {"ground", "building", "pole", "sign", "parked car"}
    axis = world.terrain.axis_y
    for body in world.bodies:
        y = np.abs(body.triangles[..., 1] - axis)
        if body.kind == "building":
            assert len(body.triangles) == 12, "a block: six faces of two triangles"
            assert 12.3 < y.min() < 13.5, ".2 to .9 m behind the sidewalk, hardly askew"
            assert y.max() < 34.0, "no second row"
    cars = [body.in_pass or () for body in world.bodies if body.kind == "parked car"]
    assert np.sum(cars, axis=0).tolist() == [8, 8, 8]
    assert all(body.role == Role.PASSING for body in world.bodies if body.kind == "parked car")


def test_the_road_is_crowned_kerbed_and_no_steeper_than_it_says() -> None:
    scenario = load_scenario("street570")
    terrain = make_world(scenario, 1).terrain
    x = np.linspace(0, 570, 2000)
    along = np.gradient(terrain.height(x, terrain.axis_y), x)
    assert 0.005 < np.abs(along).max() <= scenario.max_grade * 1.01
    middle, edge, walk = (float(terrain.height(100.0, terrain.axis_y + v)) for v in (0.0, 9.1, 9.3))
    assert 0.1 < middle - edge < 0.3
    assert 0.1 < walk - edge < 0.2


def test_a_body_changes_the_map_only_if_every_pass_agrees() -> None:
    triangle = np.zeros((1, 3, 3))
    roles = {
        (True, (True, True, True)): Role.KEPT,
        (True, (True, False, True)): Role.KEPT,
        (True, (False, True, False)): Role.UNCLEAR,
        (True, (False, False, False)): Role.REMOVED,
        (False, (True, True, True)): Role.ADDED,
        (False, (True, True, False)): Role.UNCLEAR,
        (False, (False, True, False)): Role.PASSING,
    }
    for (before, passes), role in roles.items():
        assert Body("car", triangle, before, passes).role == role


def test_temporary_cars_stand_during_one_pass_only() -> None:
    calm = {"temporary_cars": 12, "clutter": {"visitor_share": 0.0}}
    world = make_world(load_scenario("street", calm), 1)
    guests = [b for b in world.bodies if b.role == Role.PASSING]
    assert [sum(b.stands(v) for b in guests) for v in range(3)] == [12, 12, 12]
    assert not any(b.before for b in guests)
    with pytest.raises(MapvoteError, match="vacant places"):
        make_world(load_scenario("corner", {"temporary_cars": 500}), 1)


@pytest.mark.parametrize("name", ["street570", "junction"])
def test_traffic_moves_and_leaves_room_for_the_vehicle(name: str) -> None:
    scenario = load_scenario(name)
    world = make_world(scenario, 1)
    route = make_routes(scenario, world.terrain, 1)[3]
    traffic = make_traffic(scenario, world.terrain, route.lane, route.scans / 10, np.random.default_rng(0))
    for time in (0.0, 5.0, 10.0):
        T = route.poses(np.array([time]))[0]
        mesh, owners = traffic.mesh(time, T, None, 60.0)
        assert len(np.unique(owners)) > 5
        flat = mesh.reshape(-1, 3)
        inside = (np.abs(flat[:, 0] - T[0, 3]) < 3.0) & (np.abs(flat[:, 1] - T[1, 3]) < 1.0)
        assert not inside.any(), "nobody drives through the vehicle that measures"
        later, _ = traffic.mesh(time + 1.0, T, None, 60.0)
        assert mesh.shape != later.shape or np.abs(mesh - later).max() > 0.5


def test_priors_are_as_good_as_they_say() -> None:
    scenario = load_scenario("street570", {"vehicles": 10})
    world = make_world(scenario, 1)
    for route in make_routes(scenario, world.terrain, 1):
        error = route.priors(np.random.default_rng(0))[:, :3, 3] - route.poses(route.time_s)[:, :3, 3]
        assert 0.4 * route.prior_sigma_m < error.std() < 1.8 * route.prior_sigma_m
        assert np.abs(np.diff(error, axis=0)).max() < 0.8 * route.prior_sigma_m, "smooth, not white"
        assert (route.prior_sigma_m == 0.02) == (route.vehicle is None)
        speed = np.linalg.norm(np.diff(route.poses(route.time_s)[:, :3, 3], axis=0), axis=1) * 10.0
        assert abs(speed.mean() - 40 / 3.6) < 0.2


def test_truth_of_single_cells() -> None:
    """One cell per column: what was there, what the drives recorded, what the answer must be."""
    cases = [  # (dense before, dense after, survey, vehicles) as {role: hits} -> strict, provenance
        ({}, {}, {}, {}, Label.UNCHANGED, Label.UNCHANGED),
        ({Role.KEPT: 9}, {Role.KEPT: 9}, {Role.KEPT: 50}, {Role.KEPT: 50}, Label.UNCHANGED, Label.UNCHANGED),
        ({Role.REMOVED: 9}, {}, {Role.REMOVED: 50}, {}, Label.CHANGED_EMPTY, Label.CHANGED_EMPTY),
        ({}, {Role.ADDED: 9}, {}, {Role.ADDED: 50}, Label.CHANGED_OCCUPIED, Label.CHANGED_OCCUPIED),
        ({Role.REMOVED: 9}, {}, {Role.REMOVED: 3}, {}, Label.CHANGED_EMPTY, Label.UNSCORED),
        ({}, {Role.ADDED: 9}, {}, {Role.ADDED: 3}, Label.CHANGED_OCCUPIED, Label.UNSCORED),
        ({Role.REMOVED: 9, Role.KEPT: 2}, {Role.KEPT: 2}, {Role.REMOVED: 50, Role.KEPT: 9}, {Role.KEPT: 9}, 0, 0),
        ({Role.REMOVED: 9}, {Role.ADDED: 9}, {Role.REMOVED: 50}, {Role.ADDED: 50}, Label.UNCHANGED, Label.UNCHANGED),
        ({}, {}, {}, {Role.KEPT: 4}, Label.UNSCORED, Label.UNSCORED),
        ({}, {}, {}, {Role.UNCLEAR: 4}, Label.UNSCORED, Label.UNSCORED),
        ({}, {}, {}, {Role.PASSING: 400}, Label.UNCHANGED, Label.UNCHANGED),
        ({Role.REMOVED: 9}, {}, {}, {}, Label.UNSCORED, Label.UNSCORED),
    ]
    planes = np.zeros((4, len(Role), 1, len(cases)), dtype=np.int32)
    for column, case in enumerate(cases):
        for plane, hits in enumerate(case[:4]):
            assert isinstance(hits, dict)
            for role, count in hits.items():
                planes[plane, role, 0, column] = count
    strict, provenance, _ = label_cells(planes[:2], planes[2], planes[3], rate_hz=10.0)
    assert strict[0].tolist() == [case[4] for case in cases]
    assert provenance[0].tolist() == [case[5] for case in cases]


def test_ar1_errors_have_their_deviation_and_their_memory() -> None:
    errors = ar1(np.full(199_999, 0.1), np.array([0.1, 2.0]), np.random.default_rng(5))
    np.testing.assert_allclose(errors.std(axis=0), [0.1, 2.0], rtol=0.05)
    later = round(DRIVE_PLAN.memory_s / 0.1)
    assert np.corrcoef(errors[:-later, 0], errors[later:, 0])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.05)


def test_objects_over_a_street_stay_and_reach_neither_the_ground_nor_a_house_that_goes() -> None:
    world = make_world(load_scenario("overhead"), 4)
    hanging = [body for body in world.bodies if body.kind in ("wire", "bridge", "board", "crown")]
    assert [sum(body.kind == kind for body in hanging) for kind in ("wire", "bridge", "board", "crown")] == [8, 6, 8, 4]
    assert {body.role for body in hanging} == {Role.KEPT}
    for body in hanging:
        lowest = body.triangles.reshape(-1, 3)[body.triangles[..., 2].argmin()]
        assert lowest[2] > world.terrain.height(lowest[0], lowest[1]) + 4.0
    gone = [body.triangles for body in world.bodies if body.role == Role.REMOVED]
    assert len(gone) == 4
    for crown, house in zip((body.triangles for body in hanging if body.kind == "crown"), gone, strict=True):
        assert crown[..., 2].min() > house[..., 2].max() + 1.0, "a crown begins a metre above the house below it"


def test_a_street_without_overhead_is_laid_out_as_if_there_were_no_such_thing() -> None:
    plain, hung = (load_scenario("overhead", {"overhead": {"wire_m": metres}}) for metres in ((), (10.0,)))
    one = make_world(plain, 4).bodies
    other = make_world(hung, 4).bodies
    across = [k for k, body in enumerate(other) if body.kind == "wire" and np.ptp(body.triangles[..., 1]) > 30.0]
    assert len(across) == 1
    rest = [body for k, body in enumerate(other) if k not in across]
    assert all((a.triangles == b.triangles).all() for a, b in zip(one, rest, strict=True))
