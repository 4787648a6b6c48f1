"""Voxels that a scan saw and passed through, against a brute-force walk along every ray in 3D.

Rays without return: where all below answers and nothing above does, they went into the sky.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core.columns import GROUND_MARGIN_M, column_bits
from mapvote.core.geometry import rows_from
from mapvote.core.grid import CELL_SIZE, Grid, Lattice
from mapvote.core.sensors import SENSORS, Sensor
from mapvote.core.types import F32, F64, Bool, Reference
from mapvote.formats import open_drive
from mapvote.formats.drives.trajectory import read_poses
from mapvote.matching.prepare import deskew, motion_at
from mapvote.perception.fans import FANS, Rays, follow_rays
from mapvote.perception.placement import find_obstacles
from mapvote.perception.raycast import CLEARANCE_M, SKY_RULE, SKY_SECTORS, Sight, Sky, cast_rays
from mapvote_lab.simulation import simulate
from mapvote_lab.simulation.lidar import Caster
from mapvote_lab.simulation.scenario import load_scenario
from mapvote_lab.simulation.world import make_world

SIDE = 61
"""Cells of the small window: 18.3 m."""


def flat_reference(
    ground: np.ndarray | None = None, side: int = SIDE, corner: tuple[float, float] = (0.05, -0.1)
) -> Reference:
    """An empty map over a window of its own, with ground at ``ground`` (rows, cols) metres, 0 by default."""
    grid = Grid(Lattice(*corner), -(side // 2), -(side // 2), side, side)
    ground_z = np.zeros(grid.shape, np.float32) if ground is None else ground.astype(np.float32)
    empty, none = np.zeros(grid.shape, np.uint64), np.full(grid.shape, np.inf, np.float32)
    base = np.floor(ground_z / CELL_SIZE).astype(np.int32)
    return Reference(grid, ground_z, base, empty, np.zeros(grid.shape, np.int32), none, -none, None)


def brute_passed(points: np.ndarray, origin: np.ndarray, reference: Reference) -> tuple[np.ndarray, np.ndarray]:
    """(surely, possibly) passed words by steps of 2 mm along every ray: voxels entered deeply, and touched at all."""
    grid = reference.grid
    surely = np.zeros(grid.shape, np.uint64)
    possibly = np.zeros(grid.shape, np.uint64)
    for point in points:
        length = float(np.linalg.norm(point - origin))
        for slack, words in ((-0.004, surely), (0.004, possibly)):
            s = np.arange(0.0, length - CLEARANCE_M + slack, 0.002)[:, None]
            on_ray = origin + s * (point - origin) / length
            for nudge in [0.0] if slack < 0 else [-slack, 0.0, slack]:
                for axis in range(3) if nudge else [0]:
                    moved = on_ray.copy()
                    moved[:, axis] += nudge
                    rows, cols, inside = grid.indices_of(moved)
                    r, c = rows[inside], cols[inside]
                    bit = np.floor(moved[inside, 2] / CELL_SIZE).astype(int) - reference.base[r, c]
                    ok = (bit >= 0) & (bit < 63)
                    np.bitwise_or.at(words, (r[ok], c[ok]), np.uint64(1) << bit[ok].astype(np.uint64))
    return surely, possibly


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 12), st.booleans())
def test_passed_words_agree_with_a_brute_force_walk_in_3d(seed: int, n: int, hilly: bool) -> None:
    rng = np.random.default_rng(seed)
    ground = rng.uniform(-1.0, 1.0, (SIDE, SIDE)) if hilly else None
    reference = flat_reference(ground)
    origin = np.array([rng.uniform(-1, 1), rng.uniform(-1, 1), 1.8])
    fans = 128 * rng.choice(FANS // 128, n, replace=False)  # one ray to a fan, of those that mark from the sensor on
    azimuth = (fans + 0.5) * 2 * np.pi / FANS
    reach = rng.uniform(0.8, 15.0, n)
    flat = np.column_stack([np.cos(azimuth), np.sin(azimuth)]) * reach[:, None]
    points = origin + np.column_stack([flat, reach * np.tan(rng.uniform(-0.5, 0.5, n))])
    view = cast_rays(rows_from(points, origin), origin, np.ones(n, bool), np.zeros(n, bool), reference)
    surely, possibly = brute_passed(points, origin, reference)
    assert not (view.passed & ~possibly).any(), "a voxel was called passed that no ray came near"
    assert not (surely & ~view.passed).any(), "a voxel was missed that a ray went through"


@given(st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_first_hit_sees_up_to_the_nearest_obstacle_and_farthest_return_beyond_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    reference, origin = flat_reference(), np.array([0.0, 0.0, 1.8])
    angle = rng.uniform(0, 2 * np.pi)
    near, far = rng.uniform(1.0, 4.0), rng.uniform(5.0, 8.0)
    direction = np.array([np.cos(angle), np.sin(angle)])
    points = np.array([[*(near * direction), 1.2], [*(far * direction), 2.4]])  # a fence, and a wall seen above it
    view = cast_rays(rows_from(points, origin), origin, np.array([True, True]), np.zeros(2, bool), reference)
    grid = reference.grid

    def sight(distance: float) -> int:
        rows, cols, _ = grid.indices_of(np.array([distance * direction]))
        return int(view.sight[rows[0], cols[0]])

    assert sight(near) == sight(0.5 * near) == Sight.CLEAR
    assert sight(0.5 * (near + far) + 0.3) == Sight.BEHIND
    assert sight(far + 0.6) == Sight.BEYOND
    assert (view.sight == Sight.NEVER).sum() > 0.9 * view.sight.size


def test_a_moving_object_occludes_but_does_not_occupy() -> None:
    reference, origin = flat_reference(), np.array([0.0, 0.0, 1.8])
    points = np.array([[3.0, 0.0, 1.0], [3.0, 0.001, 1.1], [6.0, 0.0, 0.0]])
    moving = np.array([True, True, False])
    view = cast_rays(rows_from(points, origin), origin, np.array([True, True, False]), moving, reference)
    assert not view.counts.any()
    assert not view.hit.any()
    rows, cols, _ = reference.grid.indices_of(np.array([[4.5, 0.0], [2.0, 0.0]]))
    assert view.sight[rows[0], cols[0]] == Sight.BEHIND
    assert view.sight[rows[1], cols[1]] == Sight.CLEAR


def test_points_are_obstacles_from_the_margin_on_as_in_the_map_and_outside_the_window_nothing() -> None:
    points = np.array([[1.0, 1.0, 0.29], [1.0, 1.0, GROUND_MARGIN_M], [1.0, 1.0, 0.31], [40.0, 0.0, 3.0]])
    obstacle, cell = find_obstacles(points, flat_reference())
    assert obstacle.tolist() == [False, True, True, False]
    assert cell[0] == cell[1] == cell[2] >= 0
    assert cell[3] == -1
    in_map = column_bits(points[:3, 2], np.zeros(3, np.float32), np.zeros(3, np.int32))[1]
    assert in_map.tolist() == [False, True, True]


def test_every_cell_of_the_window_up_to_its_rim_has_a_number_and_those_around_it_have_none() -> None:
    reference = flat_reference()
    rows, cols = (index.ravel() - 1 for index in np.indices((SIDE + 2, SIDE + 2)))
    middle = np.column_stack(
        [reference.grid.x0 + CELL_SIZE * (cols + 0.5), reference.grid.y0 + CELL_SIZE * (rows + 0.5)]
    )
    cell = find_obstacles(np.column_stack([middle, np.zeros(len(middle))]), reference)[1].reshape(SIDE + 2, SIDE + 2)
    assert cell[1:-1, 1:-1].ravel().tolist() == list(range(SIDE * SIDE))
    assert (cell == -1).sum() == 4 * SIDE + 4


def wide_reference() -> Reference:
    """Flat ground at 0 over a window of 45 m to each side."""
    return flat_reference(side=301, corner=(0.0, 0.0))


@pytest.mark.parametrize("way", [(1, 0), (0, 1), (-1, 0), (0, -1)])
def test_a_ray_along_an_axis_passes_the_cells_of_one_row_or_column_and_no_other(way: tuple[int, int]) -> None:
    reference, origin = wide_reference(), np.array([0.15, 0.15, 0.75])
    end = origin + 6.09 * np.array([*way, 0.0])
    view = cast_rays(rows_from(end[None], origin), origin, np.array([True]), np.array([False]), reference)
    middle = reference.grid.rows // 2
    cells = np.argwhere(view.passed) - middle
    # the last 0.45 m before the hit prove nothing: 5.64 m are 18.8 cells, and the sensor is in the middle of one
    assert sorted(map(tuple, cells.tolist())) == sorted((way[1] * k, way[0] * k) for k in range(20))
    assert set(view.passed[view.passed != 0].tolist()) == {0b100}
    seen = np.argwhere(view.sight == Sight.CLEAR) - middle
    assert sorted(map(tuple, seen.tolist())) == sorted((way[1] * k, way[0] * k) for k in range(21))
    beyond = np.argwhere(view.sight == Sight.BEYOND) - middle
    assert len(beyond) == middle - 20


def test_points_of_a_cell_are_counted_and_marked_at_their_heights() -> None:
    reference = flat_reference()
    points = np.array([[3.0, 3.0, 0.4], [3.02, 3.05, 0.5], [3.0, 3.0, 1.0], [3.0, 3.0, 30.0], [-3.0, 3.0, 0.7]])
    view = cast_rays(
        rows_from(points, np.array([0.0, 0.0, 1.8])),
        np.array([0.0, 0.0, 1.8]),
        np.ones(5, bool),
        np.array([0, 0, 0, 0, 1], bool),
        reference,
    )
    rows, cols, _ = reference.grid.indices_of(points)
    assert view.counts[rows[0], cols[0]] == 4
    assert int(view.hit[rows[0], cols[0]]) == 0b1010 | 1 << 63, "and whatever is higher than a word in its last bit"
    assert view.counts.sum() == 4
    corner = np.array([[reference.grid.x0 + 0.1, reference.grid.y0 + 0.1, 0.7]])
    at_corner = cast_rays(
        rows_from(corner, np.array([0.0, 0.0, 1.8])),
        np.array([0.0, 0.0, 1.8]),
        np.ones(1, bool),
        np.zeros(1, bool),
        reference,
    )
    assert (at_corner.counts[0, 0], at_corner.hit[0, 0]) == (1, 0b100), "the window's first cell, too"


def test_points_in_the_sensors_own_cell_prove_nothing() -> None:
    origin = np.array([0.2, 0.05, 1.8])
    near = origin + np.array([[0.29, 0.0, 0.0], [0.0, -0.2, 0.0], [0.0, 0.0, -1.8]])
    view = cast_rays(rows_from(near, origin), origin, np.ones(3, bool), np.zeros(3, bool), flat_reference())
    assert not view.passed.any()
    assert not view.sight.any()


def test_a_ray_goes_on_over_what_is_below_the_window_and_above_a_word() -> None:
    """A bridge: the ground of some cells lies 6 m below, that of others 25 m above the ray."""
    ground = np.zeros((SIDE, SIDE))
    ground[:, 35:40], ground[:, 45:50] = -6.0, 25.0
    reference, origin = flat_reference(ground), np.array([0.0, 0.0, 1.75])
    view = cast_rays(
        rows_from(np.array([[8.0, 0.0, 1.75]]), origin), origin, np.array([True]), np.array([False]), reference
    )
    row = 30
    assert set(view.passed[row, 35:40].tolist()) == {1 << 25}, "5.75 + 0.25 voxels of 0.3 m above 20 layers down"
    assert not view.passed[row, 45:50].any()
    assert set(view.passed[row, 40:45].tolist()) == {1 << 5}
    assert not (view.passed >> np.uint64(63)).any()


def test_without_sight_the_same_voxels_are_passed() -> None:
    rng, reference, origin = np.random.default_rng(4), wide_reference(), np.array([0.1, -0.2, 1.8])
    points = origin + rng.normal(size=(4000, 3)) * [20.0, 20.0, 1.0]
    mask, none = points[:, 2] > 0.3, np.zeros(len(points), bool)
    with_sight = cast_rays(rows_from(points, origin), origin, mask, none, reference)
    without = cast_rays(rows_from(points, origin), origin, mask, none, reference, with_sight=False)
    np.testing.assert_array_equal(with_sight.passed, without.passed)
    assert with_sight.sight.any()
    assert without.sight.size == 0


SENSOR = SENSORS["hdl32e"]
UP = np.array([0.0, 0.0, 1.0])
FORWARD = np.array([1.0, 0.0, 0.0])
BEAMS = np.array(SENSOR.elevations_deg)


def directions(sensor: Sensor = SENSOR) -> tuple[F64, F64, F64]:
    """((rays, 3) of a whole turn, azimuths in degrees, elevations)."""
    azimuth, elevation = np.meshgrid(np.arange(0.0, 360.0, sensor.azimuth_step_deg), sensor.elevations_deg)
    a, e = np.radians(azimuth.ravel()), np.radians(elevation.ravel())
    return (
        np.column_stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)]),
        azimuth.ravel(),
        elevation.ravel(),
    )


def sky_of(answered: Bool, sensor: Sensor = SENSOR, up: F64 = UP, R: F64 | None = None) -> Rays:
    """Rays into the sky if those ``answered``, from 20 m; the sensor turned by ``R`` (3, 3)."""
    rays = 20.0 * directions(sensor)[0][answered] @ (np.eye(3) if R is None else R).T
    return Sky(sensor).rays(up, FORWARD, follow_rays(np.ascontiguousarray(rays.T, dtype=np.float32), 0.45))


def azimuths_of(sky: Rays) -> F32:
    return np.asarray(np.degrees(np.arctan2(sky.y, sky.x)) % 360.0)


def elevations_of(sky: Rays) -> F32:
    return np.asarray(np.degrees(np.arctan(sky.slope * CELL_SIZE)))


def test_above_a_wall_all_round_every_beam_but_the_one_next_to_it_went_into_the_sky() -> None:
    _, _, elevation = directions()
    sky = sky_of(elevation < 3.0)
    free = BEAMS[BEAMS > 3.0]
    np.testing.assert_allclose(np.unique(elevations_of(sky).round(3)), np.sort(free)[1:], atol=0.01)
    assert len(sky.reach) == (len(free) - 1) * FANS // 2, "every second fan"
    assert (sky.reach == SKY_RULE.follow_m).all()
    assert (sky.stop == SKY_RULE.follow_m).all()


def test_beside_a_house_the_sky_begins_a_sector_later() -> None:
    _, azimuth, elevation = directions()
    house = (azimuth > 90.0) & (azimuth < 180.0)
    sky = azimuths_of(sky_of((elevation < 0.0) | house))
    wide = 360.0 / SKY_SECTORS
    assert not ((sky > 90.0 - wide) & (sky < 180.0 + wide)).any()
    assert (sky < 90.0 - 2.0 * wide).any()
    assert (sky > 180.0 + 2.0 * wide).any()
    pole = np.abs(azimuth - 45.0 - 0.5 * wide) < 0.3 * wide  # in one sector alone
    sky = azimuths_of(sky_of((elevation < 0.0) | pole))
    assert not ((sky > 45.0 - wide) & (sky < 45.0 + 2.0 * wide)).any()
    assert (np.abs(sky - 45.0 + 1.5 * wide) < 0.5 * wide).any()
    assert (np.abs(sky - 45.0 - 2.5 * wide) < 0.5 * wide).any()


def test_a_beam_lost_here_and_there_is_not_the_sky_and_where_hardly_anything_answered_nothing_is_told() -> None:
    _, azimuth, elevation = directions()
    lost = np.random.default_rng(1).random(len(elevation)) < 0.5
    assert len(sky_of(~lost).reach) == 0
    packets = (azimuth > 40.0) & (azimuth < 80.0)
    sky = azimuths_of(sky_of((elevation < 0.0) & ~packets))
    assert not ((sky > 42.0) & (sky < 78.0)).any()
    assert len(sky_of(elevation < -25.0).reach) == 0, "the vehicle's own roof"


def test_a_quarter_of_the_rays_of_every_sector_that_answered_is_enough() -> None:
    sensor = replace(SENSOR, azimuth_step_deg=360.0 / FANS)
    a = np.pi / FANS  # between the edges of sectors
    turned = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    lowest = np.sort(BEAMS)
    some = [len(sky_of(directions(sensor)[2] <= lowest[k - 1], sensor, R=turned).reach) for k in (7, 8)]
    assert len(BEAMS) == 32
    assert some[0] == 0 < some[1]


@given(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_the_rays_lean_as_the_sensor_does(roll_deg: float, pitch_deg: float) -> None:
    a, b = np.radians([roll_deg, pitch_deg])
    roll = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    pitch = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    R = pitch @ roll
    sky = sky_of(directions()[2] < 3.0, up=R @ UP, R=R)
    way = np.column_stack([sky.x, sky.y, sky.slope * CELL_SIZE])
    elevation = np.degrees(np.arcsin(way @ (R @ UP) / np.linalg.norm(way, axis=1)))
    nearest = np.abs(elevation[:, None] - BEAMS[BEAMS > 3.0]).min(axis=1)
    assert len(elevation) > 1000
    assert nearest.max() < 0.6, "less than half of what lies between two beams, and one is left out"


@pytest.mark.parametrize("sensor", [replace(SENSOR, rings=False), replace(SENSOR, elevations_deg=(0.0,))])
def test_a_sensor_with_unknown_beams_has_no_view_of_the_sky(sensor: Sensor) -> None:
    answered = directions()[2] < 0.0
    rays = follow_rays(np.ascontiguousarray(20.0 * directions()[0][answered].T, dtype=np.float32), 0.45)
    assert len(Sky(sensor).rays(UP, FORWARD, rays).reach) == 0, "nothing came from above this scan's returns before"


def test_a_sensor_without_rings_fires_into_the_sky_up_to_where_returns_came_from_before() -> None:
    """A sensor that looks ahead: a wall in the first scan shows its field of view, in the second one there is none."""
    sensor = replace(SENSOR, rings=False)
    way, azimuth, elevation = directions(sensor)
    ahead = np.minimum(azimuth % 360.0, -azimuth % 360.0) < 40.0
    sky = Sky(sensor)

    def rays_of(answered: Bool, turned_deg: float = 0.0) -> tuple[F32, F32]:
        a = np.radians(turned_deg)
        R = np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
        returns = np.ascontiguousarray((20.0 * way[ahead & answered] @ R.T).T, dtype=np.float32)
        seen = sky.rays(UP, R @ FORWARD, follow_rays(returns, 0.45))
        return azimuths_of(seen), np.asarray(np.degrees(np.arctan(seen.slope * CELL_SIZE)), dtype=np.float32)

    assert len(rays_of(elevation < 6.0)[0]) == 0, "no return shows yet that it fires higher"
    for turned_deg in (0.0, 90.0):  # the vehicle has turned left
        azimuths, elevations = rays_of(elevation < 0.0, turned_deg)
        off = np.abs((azimuths - turned_deg + 180.0) % 360.0 - 180.0)
        assert len(off) > 100
        assert off.max() < 42.0
        assert elevations.min() > 0.0
        assert elevations.max() < 6.0


WINDOW_M = 40.0


@pytest.mark.slow
def test_hardly_a_ray_into_the_sky_meets_anything_in_the_window(tmp_path: Path) -> None:
    simulate("corner", tmp_path / "corner", 5)
    world = make_world(load_scenario("corner", {}), 5)
    for number, vehicle in enumerate(("v1", "v2")):
        drive = open_drive(tmp_path / "corner" / vehicle)
        poses = read_poses(tmp_path / "corner" / "truth" / vehicle / "poses.txt")
        street, sky = Caster(*world.mesh(world.standing(number))), Sky(drive.sensor)
        reach = []
        for i in range(0, len(drive), 8):
            T = poses[i]
            points = deskew(drive.read_scan(i), motion_at(drive.stamps_ns, poses, i)) @ T[:3, :3].T + T[:3, 3]
            rays = sky.rays(T[:3, 2].copy(), T[:3, 0].copy(), follow_rays(rows_from(points, T[:3, 3].copy()), 0.45))
            way = np.column_stack([rays.x, rays.y, rays.slope * CELL_SIZE])
            length = np.linalg.norm(way, axis=1)
            starts = np.broadcast_to(T[:3, 3].astype(np.float32), way.shape).copy()
            ranges, _, _ = street.cast(starts, (way / length[:, None]).astype(np.float32))
            reach.append(ranges / length)
        met = np.concatenate(reach) < WINDOW_M
        assert len(met) > 200 * len(reach)
        assert met.mean() < 0.002
