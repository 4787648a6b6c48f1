"""Points of a localised drive lie on the map's walls and on its road, unless their ranges or angles are wrong."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mapvote.core.point_map import map_from_points
from mapvote.core.types import F32, F64, Drive
from mapvote.doctor.bent_scans import window_for
from mapvote.doctor.off_surfaces import check_off_surfaces
from streets import drive_along, path, street

POSES = path(12)
STREET = street(1, density=4.0)
SOUND = drive_along(POSES, 1)


def with_points(change: Callable[[F64], F64]) -> Drive:
    """The drive with other x, y, z (n, 3)."""

    def changed(points: F32) -> F32:
        return np.ascontiguousarray(change(points.astype(np.float64)), dtype=np.float32)

    return replace(SOUND, read_scan=lambda i: replace(SOUND.read_scan(i), points=changed(SOUND.read_scan(i).points)))


def longer(metres: F64 | float) -> Callable[[F64], F64]:
    return lambda p: p * (1.0 + metres / np.linalg.norm(p, axis=1, keepdims=True))


def scattered(sigma_m: float) -> Callable[[F64], F64]:
    return lambda p: longer(np.random.default_rng(7).normal(0.0, sigma_m, (len(p), 1)))(p)


def raised(deg: float) -> Callable[[F64], F64]:
    """Beams whose elevations are so much higher than they were."""

    def change(p: F64) -> F64:
        away_m = np.linalg.norm(p, axis=1)
        elevation = np.arcsin(p[:, 2] / away_m) + np.radians(deg)
        azimuth = np.arctan2(p[:, 1], p[:, 0])
        level = np.column_stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)])
        return np.asarray(away_m[:, None] * np.column_stack([level, np.sin(elevation)]))

    return change


def found(drive: Drive, points_map: F64 = STREET) -> list[str]:
    return [
        f"{f.severity}: {f.what}"
        for f in check_off_surfaces(drive, list(POSES), window_for(map_from_points(points_map), True))
    ]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (longer(-0.15), r"off the walls of the map.*nearer to the sensor"),
        (longer(0.2), r"off the walls of the map.*farther from the sensor"),
        (scattered(0.2), "off the walls of the map, those of sound drives .01 to .03 m"),
        (raised(1.0), "off the road of the map"),
    ],
    ids=["short ranges", "long ranges", "scattered ranges", "beams of another sensor"],
)
def test_points_off_the_surfaces_of_the_map_are_an_error(change: Callable[[F64], F64], said: str) -> None:
    (first, *_) = found(with_points(change))
    assert first.startswith("error: points lie ")
    assert re.search(said, first), first


def test_a_sound_drive_lies_on_them_also_where_half_of_the_street_has_changed() -> None:
    assert found(SOUND) == []
    changed = STREET[(STREET[:, 1] < 5.0) | (STREET[:, 2] < 0.2)]
    assert found(SOUND, np.concatenate([changed, STREET[STREET[:, 1] > 5.0] + [0.0, 4.0, 0.0]])) == []


def test_a_map_with_a_thickness_of_its_own_tells_nothing() -> None:
    rough = STREET + np.random.default_rng(3).normal(0.0, 0.1, STREET.shape)
    assert found(SOUND, rough) == []
