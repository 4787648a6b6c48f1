"""Range images and looks into them, against the same rules written out in numpy, point by point."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.core.geometry import turn
from mapvote.core.types import F32, F64
from mapvote.perception.moving_objects import NOTHING, U16, LookCounts, Pixels, Samples, look, range_image, room_to_look

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
    image = np.full((PIXELS.turns, PIXELS.slopes), NOTHING)
    seen = (rho >= 0.5) & (b >= 0) & (b < PIXELS.slopes)
    range_2mm = np.minimum(rho * np.float32(500.0) + np.float32(0.5), 65534).astype(np.uint16)
    for aside in (-1, 0, 1):
        np.minimum.at(image, ((a[seen] + aside) % PIXELS.turns, b[seen]), range_2mm[seen])
    return image


def plain_look(offsets: F32, image: U16, counts: LookCounts) -> list[int]:
    """Which samples still wait."""
    waiting = []
    for i, (rho, a, b) in enumerate(zip(*aimed(offsets), strict=True)):
        around = int(min(max(HEIGHT_M * PIXELS.per_slope / max(rho, np.float32(0.5)), 2.0), 8.0))
        if rho >= 0.5 and b >= around and b + around < PIXELS.slopes:
            below, above = image[a, b - around : b].min(), image[a, b + 1 : b + around + 1].min()
            r, own = int(min(below, above, image[a, b])), round(float(rho) * 500.0)
            if r != NOTHING and r > own + 250:
                counts.free[i] += 1
                counts.sides[i] |= (below < NOTHING) + 2 * (above < NOTHING)
            elif r != NOTHING and r >= own - 250:
                counts.hit[i] += 1
        free, hit = counts.free[i], counts.hit[i]
        if not ((free == 0 and hit >= ENOUGH) or (hit == 0 and free >= ENOUGH and counts.sides[i] == 3)):
            waiting.append(i)
    return waiting


def no_counts(n: int) -> LookCounts:
    return LookCounts(np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros(n, np.uint8))


@pytest.mark.parametrize("seed", range(3))
def test_an_image_holds_the_nearest_return_of_each_direction_and_of_those_beside_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    origin = np.array([1000.0, -500.0, 20.0])
    points = origin + rng.normal(0.0, 1.0, (3000, 3)) * [30.0, 30.0, 3.0]
    points[:5] = [[0.1, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [500.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]
    points[:5] += origin
    np.testing.assert_array_equal(range_image(points, origin, PIXELS), plain_image(points, origin))


@pytest.mark.parametrize("seed", range(3))
def test_looks_count_and_settle_as_the_rule_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places = (rng.normal(0.0, 1.0, (400, 3)) * [12.0, 12.0, 1.0]).astype(np.float32)
    counts, expected, wait = no_counts(400), no_counts(400), np.arange(400)
    x, y, z = places.T.copy()
    samples, n = Samples(x, y, z, np.arange(400, dtype=np.int32)), 400
    for _ in range(5):
        sensor = rng.normal(0.0, 2.0, 3)
        seen = sensor + rng.normal(0.0, 1.0, (4000, 3)) * [15.0, 15.0, 2.0]
        image = range_image(seen, sensor, PIXELS)
        rule = MARGIN_M, HEIGHT_M, ENOUGH
        n = look(samples, n, image.reshape(-1), sensor.astype(np.float32), PIXELS, rule, counts, room_to_look(400))
        some = LookCounts(expected.free[wait], expected.hit[wait], expected.sides[wait])
        left = plain_look(places[wait] - sensor.astype(np.float32), image, some)
        expected.free[wait], expected.hit[wait], expected.sides[wait] = some
        wait = wait[left]
        np.testing.assert_array_equal(samples.of[:n], wait)
        for found, plane in zip(counts, expected, strict=True):
            np.testing.assert_array_equal(found, plane)
    assert 0 < n < 400
    assert counts.free.sum() > 50
