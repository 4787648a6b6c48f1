"""Moving-object removal (paper II, [9]) in a street of boxes cast by plane arithmetic, with exact labels."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy import ndimage

from mapvote.config import MovingSettings, VotingSettings
from mapvote.core.geometry import rows_from, turn
from mapvote.core.grid import CELL_SIZE, Lattice, window_around
from mapvote.core.sensors import SENSORS, Sensor
from mapvote.core.types import F32, F64, I32, U16, Bool
from mapvote.perception.moving_objects import (
    BELOW,
    HIT,
    MOVERS,
    NO_RETURN,
    Movers,
    MovingFilter,
    Pixels,
    Samples,
    look,
    mark_components,
    range_image,
    room_to_look,
    voxels,
)

LIDAR_HEIGHT = 1.9
Box = tuple[float, float, float, float, float]
"""x0, y0, x1, y1 and top, standing on the ground z = 0."""

WALLS: list[Box] = [(-80.0, 8.0, 120.0, 9.0, 6.0), (-80.0, -9.0, 10.0, -8.0, 4.0), (25.0, -30.0, 26.0, -8.0, 5.0)]
PARKED: list[Box] = [(x, 5.5, x + 4.4, 7.3, 1.5) for x in (-20.0, -5.0, 2.0, 20.0)]
POLES: list[Box] = [(x, -6.0, x + 0.15, -5.85, 5.0) for x in (-15.0, 5.0, 18.0)]


def coarse(name: str) -> Sensor:
    """The named sensor with fewer azimuths, to keep tests short."""
    return replace(SENSORS[name], azimuth_step_deg=0.6)


def cast(sensor: Sensor, origin: F64, boxes: list[Box], rng: np.random.Generator) -> tuple[F64, np.ndarray]:
    """(points (n, 3), index of the box hit or -1 for the ground) of one instantaneous revolution."""
    azimuth = np.radians(np.arange(0.0, 360.0, sensor.azimuth_step_deg))
    elevation = np.radians(np.array(sensor.elevations_deg))
    a, e = (m.ravel() for m in np.meshgrid(azimuth, elevation))
    d = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        best = np.where(d[:, 2] < 0, -origin[2] / d[:, 2], np.inf)
        which = np.full(len(d), -1)
        for index, (x0, y0, x1, y1, top) in enumerate(boxes):
            near = (np.array([x0, y0, 0.0]) - origin) / d
            far = (np.array([x1, y1, top]) - origin) / d
            enter, leave = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
            hit = (enter < leave) & (enter > 0) & (enter < best)
            best[hit], which[hit] = enter[hit], index
    seen = best < 60.0
    ranges = best[seen] + rng.normal(0.0, sensor.range_sigma_m, int(seen.sum()))
    return origin + ranges[:, None] * d[seen], which[seen]


class Street:
    """Our vehicle drives east at 10 m/s; everything else as the test says."""

    def __init__(self, sensor: Sensor, rate_hz: float, seconds: float, movers: list[tuple[Box, float]]) -> None:
        rng = np.random.default_rng(1)
        fixed = WALLS + PARKED + POLES
        self.scans: list[tuple[F32, F64, Bool, int]] = []
        self.truth: list[Bool] = []
        for t in np.arange(0.0, seconds, 1.0 / rate_hz):
            origin = np.array([10.0 * t - 10.0, 0.0, LIDAR_HEIGHT])
            now = [(x0 + v * t, y0, x1 + v * t, y1, top) for (x0, y0, x1, y1, top), v in movers]
            points, which = cast(sensor, origin, fixed + now, rng)
            self.scans.append((rows_from(points, origin), origin, points[:, 2] > 0.3, round(t * 1e9)))
            self.truth.append(which >= len(fixed))

    def run(self, sensor: Sensor, settings: MovingSettings, movers: Movers = MOVERS) -> list[Bool]:
        moving = MovingFilter(sensor, settings, movers)
        masks = []
        for rows, origin, obstacle, stamp_ns in self.scans:
            masks += moving.push(rows, origin, obstacle, stamp_ns)
        return masks + moving.flush()

    def score(self, masks: list[Bool]) -> tuple[float, float]:
        """(precision, recall) over all obstacle points."""
        found = np.concatenate(masks)
        truth = np.concatenate([t & s[2] for t, s in zip(self.truth, self.scans, strict=True)])
        return float((found & truth).sum() / max(found.sum(), 1)), float((found & truth).sum() / max(truth.sum(), 1))


ONCOMING: tuple[Box, float] = ((30.0, 2.6, 34.4, 4.4, 1.5), -11.0)
AHEAD: tuple[Box, float] = ((2.0, -1.0, 6.4, 0.8, 1.5), 10.0)
WALKER: tuple[Box, float] = ((4.0, -5.0, 4.5, -4.5, 1.8), 1.4)


@pytest.mark.parametrize(
    ("sensor_name", "rate_hz"),
    [
        ("vlp16", 10.0),
        ("hdl32e", 2.0),
        *(
            pytest.param(name, rate_hz, marks=pytest.mark.slow)
            for name, rate_hz in (
                ("vlp16", 2.0),
                ("vlp16", 5.0),
                ("hdl32e", 5.0),
                ("hdl32e", 10.0),
                ("hdl64e", 2.0),
                ("hdl64e", 5.0),
                ("hdl64e", 10.0),
            )
        ),
    ],
)
def test_movers_are_found_and_nothing_else_at_any_rate_and_number_of_beams(sensor_name: str, rate_hz: float) -> None:
    sensor = coarse(sensor_name)
    street = Street(sensor, rate_hz, 4.0, [ONCOMING, AHEAD, WALKER])
    precision, recall = street.score(street.run(sensor, MovingSettings()))
    assert precision >= 0.97
    assert recall >= 0.60


@pytest.mark.parametrize("x", [0.01, 0.15, 0.29])
def test_whatever_can_vote_is_looked_at_up_to_the_corners_of_the_local_grid(x: float) -> None:
    grid = window_around(Lattice(), x, x, VotingSettings().window_m)
    rows, cols = np.array([0, 0, grid.rows, grid.rows]), np.array([0, grid.cols, 0, grid.cols])
    corners = np.column_stack([grid.x0 + CELL_SIZE * cols, grid.y0 + CELL_SIZE * rows, np.ones(4)])
    origin = np.array([x, x, LIDAR_HEIGHT])
    assert np.linalg.norm(corners - origin, axis=1).max() > 56.5
    chosen, _, _ = voxels(rows_from(corners, origin), np.ones(4, np.bool_), origin, MOVERS.reach_m, CELL_SIZE)
    assert chosen.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("waiting", [[], [((6.0, -4.0, 10.4, -2.2, 1.5), 0.0)]])
def test_objects_that_come_into_view_and_a_waiting_car_are_not_moving(waiting: list[tuple[Box, float]]) -> None:
    """Walls appear from behind corners and parked cars, and all of it stays."""
    sensor = coarse("hdl32e")
    assert all(mask.mean() < 1e-3 for mask in Street(sensor, 10.0, 3.0, waiting).run(sensor, MovingSettings()))


def test_a_scan_is_decided_within_the_look_ahead_and_no_later_scan_changes_it() -> None:
    sensor = coarse("hdl32e")
    settings = MovingSettings(lookahead_s=0.5)
    street = Street(sensor, 10.0, 2.5, [ONCOMING])
    whole = street.run(sensor, settings)
    moving = MovingFilter(sensor, settings)
    decided = 0
    for newest, (rows, origin, obstacle, stamp_ns) in enumerate(street.scans):
        for mask in moving.push(rows, origin, obstacle, stamp_ns):
            assert newest - decided <= 5
            np.testing.assert_array_equal(mask, whole[decided])
            decided += 1
    assert decided + len(moving.flush()) == len(street.scans)


def test_nothing_older_than_the_window_is_used() -> None:
    sensor = coarse("hdl32e")
    movers = Movers(past_s=1.0)
    settings = MovingSettings(lookahead_s=0.5)
    street = Street(sensor, 10.0, 2.5, [ONCOMING])
    whole = street.run(sensor, settings, movers)
    street.scans = street.scans[5:]
    late = street.run(sensor, settings, movers)
    for index in range(10, len(late)):  # a second of history behind it
        np.testing.assert_array_equal(late[index], whole[index + 5])


def test_only_obstacle_points_are_called_moving_and_an_empty_scan_is_no_trouble() -> None:
    sensor = coarse("hdl32e")
    street = Street(sensor, 10.0, 2.0, [ONCOMING])
    _, origin, _, stamp_ns = street.scans[7]
    street.scans[7] = (np.zeros((3, 0), np.float32), origin, np.zeros(0, dtype=bool), stamp_ns)
    masks = street.run(sensor, MovingSettings())
    assert masks[7].shape == (0,)
    assert not any((masks[i] & ~street.scans[i][2]).any() for i in range(len(street.scans)))
    moving = MovingFilter(sensor, MovingSettings())
    assert moving.flush() == []
    moving.push(*street.scans[7])
    with pytest.raises(ValueError, match="stamps must increase"):
        moving.push(*street.scans[7])


SIDE = 10


@pytest.mark.parametrize("seed", range(9))
def test_cells_move_by_components_as_scipy_labels_them(seed: int) -> None:
    """Voxels over one cell count together, and what is mostly static parts what touches it from what moves."""
    rng = np.random.default_rng(seed)
    place = rng.choice(np.flatnonzero(np.pad(rng.random((SIDE - 2, SIDE - 2)) < 0.35, 1)), 90)
    seen = rng.random(len(place)) < 0.8
    brief = seen & (rng.random(SIDE * SIDE)[place] + rng.normal(0, 0.2, len(place)) < 0.5)
    cells, of = np.unique(place, return_inverse=True)
    n_seen, n_brief = np.bincount(of, seen), np.bincount(of, brief)
    moves, wanted = np.zeros(len(cells), np.bool_), np.ones(len(cells), np.bool_)
    for share in (0.5, 0.6):
        held = np.zeros(SIDE * SIDE, np.bool_)
        held[cells[wanted]] = True
        label = ndimage.label(held.reshape(SIDE, SIDE), structure=np.ones((3, 3)))[0].ravel()[cells]
        total, moving = np.bincount(label, n_seen), np.bincount(label, n_brief)
        moves |= ((moving >= 4) & (moving >= share * total))[label] & (label > 0)
        wanted = ~moves & (2 * n_brief >= n_seen)
    plane = np.full((SIDE, SIDE), -1, np.int32)
    voxel_of, chosen = rng.integers(0, len(place), 200).astype(np.int32), rng.permutation(300)[:200].astype(np.int32)
    expected, out = np.zeros(300, np.bool_), np.zeros(300, np.bool_)
    expected[chosen] = moves[of][voxel_of]
    mark_components(place.astype(np.int32), plane, seen, brief, (4, 0.5, 0.6), (voxel_of, chosen), out)
    np.testing.assert_array_equal(out, expected)
    assert (plane == -1).all()
    assert 0 < moves.sum() < len(moves)


@pytest.mark.parametrize("count", [0, 50, 20_000])
def test_voxels_are_numbered_by_their_first_points_however_many_there_are(count: int) -> None:
    """The last has more than the table that is tried first holds."""
    rng = np.random.default_rng(count)
    origin = np.array([500.0, -300.0, 8.0])
    rows, obstacle = rng.uniform(-12.0, 12.0, (3, 3 * count)).astype(np.float32), rng.random(3 * count) < 0.7
    points = rows.T + origin
    found, voxel_of, samples = voxels(rows, obstacle, origin, 11.0, 0.3)
    chosen = np.flatnonzero(obstacle & (np.hypot(*(points - origin)[:, :2].T) <= 11.0))
    _, at, number = np.unique(np.floor(points[chosen] / 0.3), axis=0, return_index=True, return_inverse=True)
    in_order = np.argsort(at)
    np.testing.assert_array_equal(samples, rows[:, chosen[at[in_order]]])
    assert count < 1000 or samples.shape[1] > 8192
    np.testing.assert_array_equal(found, chosen)
    np.testing.assert_array_equal(voxel_of, np.argsort(in_order)[number.ravel()])


PIXELS = Pixels(90, 60, np.float32(-0.6), np.float32(50.0))
MARGIN_M, HEIGHT_M, ENOUGH = 0.5, 0.12, 2


def aimed(offsets: F32) -> tuple[F32, np.ndarray, np.ndarray]:
    """(horizontal range (n,), azimuth pixel, slope pixel) of places (n, 3) from the sensor."""
    x, y, z = offsets.T
    rho = np.sqrt(x * x + y * y)
    azimuth = np.array([turn.py_func(a, b) for a, b in zip(x, y, strict=True)], dtype=np.float32)
    a = np.minimum((azimuth * np.float32(PIXELS.turns)).astype(int), PIXELS.turns - 1)
    return rho, a, np.floor((z / np.maximum(rho, np.float32(0.5)) - PIXELS.slope_min) * PIXELS.per_slope).astype(int)


def plain_image(points: F64, origin: F64) -> U16:
    rho, a, b = aimed((points - origin).astype(np.float32))
    image = np.full((PIXELS.turns, PIXELS.slopes), NO_RETURN)
    seen = (rho >= 0.5) & (b >= 0) & (b < PIXELS.slopes)
    range_2mm = np.minimum(rho * np.float32(500.0) + np.float32(0.5), 65534).astype(np.uint16)
    for aside in (-1, 0, 1):
        np.minimum.at(image, ((a[seen] + aside) % PIXELS.turns, b[seen]), range_2mm[seen])
    return image


class LookCounts(NamedTuple):
    """What scans saw at places, (m,) each."""

    free: I32
    hit: I32
    sides: I32
    """1 if a ray passed below, 2 if one passed above, 3 for both."""

    @property
    def packed(self) -> I32:
        return np.asarray(self.free + self.hit * HIT + self.sides * BELOW, np.int32)


def plain_look(offsets: F32, image: U16, counts: LookCounts) -> list[int]:
    """Which samples still wait."""
    waiting = []
    for i, (rho, a, b) in enumerate(zip(*aimed(offsets), strict=True)):
        around = int(min(max(HEIGHT_M * PIXELS.per_slope / max(rho, np.float32(0.5)), 2.0), 8.0))
        if rho >= 0.5 and b >= around and b + around < PIXELS.slopes:
            below, above = image[a, b - around : b].min(), image[a, b + 1 : b + around + 1].min()
            r, own = int(min(below, above, image[a, b])), round(float(rho) * 500.0)
            if r != NO_RETURN and r > own + 250:
                counts.free[i] += 1
                counts.sides[i] |= (below < NO_RETURN) + 2 * (above < NO_RETURN)
            elif r != NO_RETURN and r >= own - 250:
                counts.hit[i] += 1
        free, hit = counts.free[i], counts.hit[i]
        if not ((free == 0 and hit >= ENOUGH) or (hit == 0 and free >= ENOUGH and counts.sides[i] == 3)):
            waiting.append(i)
    return waiting


def image_of(seen: F64, sensor: F64) -> U16:
    image = np.empty((PIXELS.turns, PIXELS.slopes), np.uint16)
    range_image(rows_from(seen, sensor), PIXELS, image)
    return image


@pytest.mark.parametrize("seed", range(3))
def test_an_image_holds_the_nearest_return_of_each_direction_and_of_those_beside_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    origin = np.array([1000.0, -500.0, 20.0])
    points = origin + rng.normal(0.0, 1.0, (3000, 3)) * [30.0, 30.0, 3.0]
    points[:5] = [[0.1, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [500.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]
    points[:5] += origin
    np.testing.assert_array_equal(image_of(points, origin), plain_image(points, origin))


@pytest.mark.parametrize("seed", range(3))
def test_looks_count_and_settle_as_the_rule_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places = (rng.normal(0.0, 1.0, (400, 3)) * [12.0, 12.0, 1.0]).astype(np.float32)
    seen, expected, wait = np.zeros(400, np.int32), LookCounts(*np.zeros((3, 400), np.int32)), np.arange(400)
    x, y, z = places.T.copy()
    samples, n = Samples(x, y, z, np.arange(400, dtype=np.int32)), 400
    for asked in (1, 2, 2):
        sensors = rng.normal(0.0, 2.0, (asked, 3))
        images = [image_of(s + rng.normal(0.0, 1.0, (4000, 3)) * [15.0, 15.0, 2.0], s) for s in sensors]
        stored = np.array(images[::-1]).reshape(asked, -1)
        which = np.arange(asked)[::-1].copy()
        rule = MARGIN_M, HEIGHT_M, ENOUGH
        n = look(samples, n, stored, which, sensors.astype(np.float32), PIXELS, rule, seen, room_to_look(400))
        for sensor, image in zip(sensors.astype(np.float32), images, strict=True):
            some = LookCounts(expected.free[wait], expected.hit[wait], expected.sides[wait])
            left = plain_look(places[wait] - sensor, image, some)
            expected.free[wait], expected.hit[wait], expected.sides[wait] = some
            wait = wait[left]
        np.testing.assert_array_equal(samples.of[:n], wait)
        np.testing.assert_array_equal(seen, expected.packed)
    assert 0 < n < 400
    assert expected.free.sum() > 50
