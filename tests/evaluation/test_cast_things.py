"""Things cast into real scans: a ray ends where it first meets something, and goes on where one was taken away."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mapvote.core.geometry import from_xyz_rpy, transform
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, Drive, Scan
from mapvote_lab.evaluation.cast_things import Site, Thing, with_things
from mapvote_lab.evaluation.real_street import in_rain
from mapvote_lab.simulation.shapes import box

HEIGHT = 1.8
WALL_X = 20.0


def fan() -> F64:
    """Unit rays (n, 3) ahead, 30 deg to both sides, from -20 to 5 deg."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-30, 30, 0.2)), np.radians(np.arange(-20, 5, 0.5)))
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], -1).reshape(-1, 3)


def drive() -> tuple[Drive, F64]:
    """Two scans from one place, before a wall 20 m ahead on a flat road; and where they were taken."""
    rays = fan()
    with np.errstate(divide="ignore"):
        ground = np.where(rays[:, 2] < 0, -HEIGHT / rays[:, 2], np.inf)
    points = (rays * np.minimum(ground, WALL_X / rays[:, 0])[:, None]).astype(np.float32)
    T = np.stack([from_xyz_rpy(0.0, 0.0, HEIGHT)] * 2)
    sensor = replace(SENSORS["hdl64e"], range_sigma_m=0.0)
    stamps_ns = np.array([1, 100_000_001])
    return Drive(Path("yard"), "v", "yard", sensor, stamps_ns, lambda i: Scan(int(stamps_ns[i]), points)), T


def seen(things: list[Thing]) -> tuple[F64, F64]:
    """(points before, points after) of the first scan, map metres, ray by ray where none was dropped."""
    plain, T = drive()
    changed = with_things(plain, things, T)
    return transform(T[0], plain.read_scan(0).points), transform(T[0], changed.read_scan(0).points)


def test_rays_end_on_a_new_pole_and_all_others_stay() -> None:
    pole = Thing("pole", box(9.9, 10.1, -0.1, 0.1, 0.0, 4.0))
    before, after = seen([pole])
    hit = np.linalg.norm(before - after, axis=1) > 0.01
    assert 50 < hit.sum() < 0.02 * len(hit)
    assert (np.abs(after[hit, 1]) < 0.11).all()
    np.testing.assert_allclose(after[hit, 0], 9.9, atol=0.01)
    np.testing.assert_array_equal(before[~hit], after[~hit])
    np.testing.assert_allclose(pole.met[0], after[hit], atol=1e-3)
    np.testing.assert_array_equal(*seen([Thing("house", box(25.0, 30.0, -5.0, 5.0, 0.0, 6.0))]))  # behind the return


def test_an_object_behind_another_is_not_hit_in_whatever_order_they_were_placed() -> None:
    near, far = box(9.9, 10.1, -3.0, 3.0, 0.0, 4.0), box(14.9, 15.1, -1.0, 1.0, 0.0, 1.0)
    for first in (0, 1):
        things = [Thing("wall", near), Thing("cabinet", far)]
        seen(things[::-1] if first else things)
        assert [len(np.concatenate(thing.met)) > 0 for thing in things] == [True, False]


def test_rays_through_a_removed_wall_go_on_or_return_nothing() -> None:
    gone = from_xyz_rpy(WALL_X, 0.0, 3.0), np.array([0.2, 3.0, 2.9])
    behind = box(30.0, 31.0, -50.0, 50.0, 0.0, 2.5)
    thing = Thing("wall", np.zeros((0, 3, 3)), gone, behind)
    before, after = seen([thing])
    middle = (np.abs(after[:, 1]) < 2.0) & (after[:, 2] > 0.3)
    assert np.abs(after[middle & (after[:, 0] < 29.0), 0] - WALL_X).size == 0
    np.testing.assert_allclose(after[middle, 0].max(), 30.0, atol=0.01)
    assert len(after) < len(before), "above what stands behind there is sky"
    np.testing.assert_allclose(thing.left[0][:, 0], WALL_X, atol=0.01)


def test_rain_falls_before_what_was_cast_and_the_same_rays_are_noted_as_if_it_were_dry() -> None:
    plain, T = drive()
    dry, wet = (Thing("pole", box(9.9, 10.1, -0.1, 0.1, 0.0, 4.0)) for _ in range(2))
    before = with_things(plain, [dry], T).read_scan(0).points
    after = in_rain(0.1)(with_things(plain, [wet], T)).read_scan(0).points
    on_pole = np.linalg.norm(before - plain.read_scan(0).points, axis=1) > 0.01
    reach = np.linalg.norm(after, axis=1) / np.linalg.norm(before, axis=1)
    assert 0 < (reach[on_pole] < 0.99).sum() < 0.3 * on_pole.sum()
    assert (reach <= 1.0 + 1e-6).all()
    np.testing.assert_array_equal(wet.met[0], dry.met[0])


def street() -> Site:
    """A street along x, walls at y = 12 and -12, a parked car at (30, 5)."""
    x, z = np.meshgrid(np.arange(0.15, 80, 0.3), np.arange(0.45, 4, 0.3))
    walls = [np.column_stack([x.ravel(), np.full(x.size, y), z.ravel()]) for y in (12.0, -12.0)]
    a, b, c = np.meshgrid(np.arange(28.0, 32.2, 0.3), np.arange(4.2, 6.0, 0.3), np.arange(0.45, 1.6, 0.3))
    car = np.column_stack([a.ravel(), b.ravel(), c.ravel()])
    path = np.column_stack([np.arange(0.0, 80.0), np.zeros(80), np.full(80, HEIGHT)])
    return Site(np.vstack([*walls, car]), lambda xy: np.zeros(len(xy)), path)


def test_things_find_room_beside_the_path_and_apart_from_what_stands() -> None:
    site = street()
    things, hedges = site.placed(1, 2)
    assert len(things) == 14
    assert len(hedges) == 2
    for thing in things:
        away = np.linalg.norm(site.obstacles[:, None, :2] - thing.comes.reshape(-1, 3)[None, :, :2], axis=2)
        assert away.min() > 0.3
        assert abs(thing.centre[1]) > 1.5
    again, _ = site.placed(1, 2)
    np.testing.assert_array_equal(things[0].comes, again[0].comes)


def test_walls_move_to_and_from_the_road_by_half_a_metre() -> None:
    walls = street().moved_walls(1, 4)
    assert [w.kind for w in walls] == ["wall set back", "wall set forward"] * 2
    for wall in walls:
        away = np.abs(wall.comes.reshape(-1, 3)[:, 1]).mean() - 12.0
        assert abs(away - (0.5 if wall.kind == "wall set back" else -0.5)) < 0.05


def test_objects_of_a_cars_size_can_be_removed() -> None:
    (car,) = street().gone_cars(5)
    np.testing.assert_allclose(car.centre, [30.0, 5.0], atol=0.3)
