"""A LiDAR is measured in its scans: rings, azimuth step, blind sectors, spin; where there are no rings, it says so."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, Scan
from mapvote.formats.drives.sensor_estimate import contradiction, estimate_sensor

VLP32C = (15, 10.333, 7, 4.667, *np.linspace(3.333, -4, 23), -4.667, -5.333, -6.148, -7.254, -8.843)
MODELS: dict[str, tuple[tuple[float, ...], float]] = {
    "VLP-16": (tuple(np.linspace(15, -15, 16)), 0.2),
    "VLP-32C": (VLP32C, 0.2),
    "HDL-32E": (tuple(np.linspace(10.67, -30.67, 32)), 0.16),
    "HDL-64E": (SENSORS["hdl64e"].elevations_deg, 0.1728),
    "VLS-128": ((*np.linspace(15, 2, 20), *np.linspace(1.8, -6.8, 79), *np.linspace(-7.1, -25, 29)), 0.2),
    "OS1-64": (tuple(np.linspace(16.6, -16.6, 64)), 0.3516),
    "OS0-128": (tuple(np.linspace(45, -45, 128)), 0.3516),
    "OS2-128": (tuple(np.linspace(11.25, -11.25, 128)), 0.1758),
    "Pandar64": ((15, 11, 8, 5, 3, *np.linspace(2, -6, 49), *range(-7, -15, -1), -19, -25), 0.2),
    "Pandar40P": ((15, 11, 8, 5, 3, *np.linspace(2, -6, 25), *range(-7, -15, -1), -19, -25), 0.2),
    "XT32": (tuple(np.linspace(15, -16, 32)), 0.18),
    "RS-32": ((15, 10.33, 7, 4.67, *np.linspace(3.33, -4.67, 24), -7.25, -10.3, -15.6, -25), 0.2),
}
"""Elevations and azimuth steps as their manuals list them; uneven ones in outline."""


def street(elevations: F64, azimuths: F64, rng: np.random.Generator) -> tuple[F64, F64]:
    """(points (n, 3), index of the ray) of rays in a street 1.8 m below the sensor, walls 12 m to either side."""
    cosine, sine = np.cos(np.radians(elevations)), np.sin(np.radians(elevations))
    x, y = cosine * np.cos(np.radians(azimuths)), cosine * np.sin(np.radians(azimuths))
    with np.errstate(divide="ignore"):
        reach = np.minimum(np.where(sine < 0, -1.8 / sine, np.inf), 12.0 / np.abs(y))
    reach = reach + rng.normal(0, 0.02, len(reach))
    hit = np.flatnonzero((reach < 90.0) & (sine * reach < 15.0))  # houses are 15 m high
    return np.column_stack([x, y, sine])[hit] * reach[hit, None], hit.astype(np.float64)


def scan(model: str, order: str, *, ring: bool = False, blind: tuple[float, float] | None = None) -> Scan:
    levels, step = MODELS[model]
    azimuth = np.arange(180.0, -180.0, -step)
    grid = np.meshgrid(np.arange(len(levels)), azimuth, indexing="ij" if order == "ring by ring" else "xy")
    rings, azimuths = grid[0].ravel(), grid[1].ravel()
    if blind is not None:
        seen = (azimuths < blind[0]) | (azimuths > blind[1])
        rings, azimuths = rings[seen], azimuths[seen]
    points, hit = street(np.array(levels)[rings], azimuths, np.random.default_rng(0))
    which = rings[hit.astype(np.int64)]
    time_s = (-azimuths[hit.astype(np.int64)] / 3600.0).astype(np.float32)
    return Scan(0, points.astype(np.float32), time_s, ring=which.astype(np.uint16) if ring else None)


@pytest.mark.parametrize("order", ["ring by ring", "firing by firing", "ring field"])
@pytest.mark.parametrize("model", MODELS)
def test_real_sensors_are_measured_rightly(model: str, order: str) -> None:
    levels, step = MODELS[model]
    found = estimate_sensor([scan(model, order, ring=order == "ring field")], 10.0)
    assert found.sensor.rings
    assert found.on_rings > 0.9
    beams = np.array(found.sensor.elevations_deg)
    seen = np.unique(np.round(scan(model, order, ring=True).ring, 0))  # type: ignore[arg-type]
    assert abs(len(beams) - len(seen)) <= max(2, 0.1 * len(seen))
    off = np.abs(beams[:, None] - np.array(levels)[None]).min(axis=1)
    assert np.median(off) < 0.1
    assert found.sensor.azimuth_step_deg == pytest.approx(step, rel=0.1)
    assert found.sensor.clockwise


def test_a_listed_sensor_is_named() -> None:
    assert estimate_sensor([scan("HDL-32E", "firing by firing")], 10.0).sensor.name == "hdl32e"
    assert estimate_sensor([scan("VLP-16", "ring by ring")], 10.0).sensor.name == "vlp16"
    assert "measured: hdl32e" in estimate_sensor([scan("HDL-32E", "ring by ring")], 10.0).told


def test_a_blind_sector_is_found() -> None:
    found = estimate_sensor([scan("OS1-64", "ring field", ring=True, blind=(100.0, 160.0))], 10.0)
    assert len(found.sensor.blind_sectors_deg) == 1
    assert found.sensor.blind_sectors_deg[0] == pytest.approx((100.0, 160.0), abs=2.1)


def test_a_sensor_that_turns_the_other_way_is_found() -> None:
    forward = scan("OS1-64", "ring field", ring=True)
    assert forward.time_s is not None
    backward = Scan(0, forward.points, -forward.time_s, ring=forward.ring)
    assert not estimate_sensor([backward], 10.0).sensor.clockwise


def test_a_non_repeating_scanner_gets_a_model_without_rings() -> None:
    """A rosette as of Livox: two prisms turn against each other."""
    t = np.linspace(0.0, 0.1, 20_000)
    a, b = 2 * np.pi * 121.567 * t, -2 * np.pi * 77.7 * t
    azimuth, elevation = 17.6 * (np.cos(a) + np.cos(b)), 17.6 * (np.sin(a) + np.sin(b))
    points, _ = street(elevation, azimuth, np.random.default_rng(0))
    found = estimate_sensor([Scan(0, points.astype(np.float32))], 10.0)
    assert not found.sensor.rings
    assert "no rings" in found.told
    assert found.sensor.blind_sectors_deg[0][1] - found.sensor.blind_sectors_deg[0][0] > 250
    assert -36 < found.sensor.fov_bottom_deg < -5


@pytest.mark.parametrize("order", ["ring by ring", "firing by firing"])
@pytest.mark.parametrize(("model", "its_own"), [("VLP-16", "vlp16"), ("HDL-32E", "hdl32e"), ("HDL-64E", "hdl64e")])
def test_a_sensor_stated_wrongly_contradicts_the_rings_and_the_right_one_does_not(
    model: str, its_own: str, order: str
) -> None:
    for name, stated in SENSORS.items():
        said = contradiction(stated, scan(model, order))
        assert (said == "") == (name == its_own), (name, said)


def test_a_scan_of_every_second_beam_and_one_without_rings_contradict_no_sensor() -> None:
    whole = scan("HDL-64E", "ring by ring", ring=True)
    assert whole.ring is not None
    half = whole.ring % 2 == 0
    assert contradiction(SENSORS["hdl64e"], Scan(0, whole.points[half], ring=whole.ring[half])) == ""
    rng = np.random.default_rng(1)
    points, _ = street(rng.uniform(-25, 25, 60_000), rng.uniform(-180, 180, 60_000), rng)
    assert contradiction(SENSORS["vlp16"], Scan(0, points.astype(np.float32))) == ""
