"""World coordinates: what goes through a frame comes back, and known places lie where surveyors have them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core.types import MapvoteError
from mapvote.formats.geo.frame import (
    MapFrame,
    autoware_frame,
    enu_frame,
    frame_of,
    frame_of_projector,
    projector_of,
    read_crs,
    read_projector,
    utm_of,
)
from mapvote.formats.geo.units import settle, with_units
from mapvote.formats.maps.las import frame_of_keys

TOKYO = (139.6503, 35.6762)
PLACES = st.tuples(st.floats(-179, 179), st.floats(-75, 75), st.floats(-100, 4000))


@settings(max_examples=50, deadline=None)
@given(PLACES, st.sampled_from(["utm", "enu", "offset"]))
def test_a_place_comes_back_from_map_metres(place: tuple[float, float, float], kind: str) -> None:
    lon, lat, height = place
    frame = enu_frame(lat, lon, 0.0) if kind == "enu" else MapFrame(utm_of(lon, lat))
    if kind == "offset":
        frame = MapFrame(frame.crs, (300_000.0, 3_900_000.0, 12.0))
    back = frame.to_lonlat(frame.from_lonlat(np.array([place])))[0]
    assert np.abs((back - place)[:2]).max() < 1e-9  # degrees: a tenth of a millimetre
    assert abs(back[2] - height) < 1e-3
    assert frame_of(frame.georeference()) == frame


def test_the_utm_zone_of_a_place() -> None:
    assert utm_of(*TOKYO) == "EPSG:32654"
    assert utm_of(151.2, -33.9) == "EPSG:32756"


def test_mgrs_is_utm_without_its_hundred_kilometres() -> None:
    mgrs, utm = read_projector("MGRS:54SUE"), MapFrame("EPSG:32654")
    place = np.array([[*TOKYO, 40.0]])
    assert np.allclose(mgrs.from_lonlat(place), np.mod(utm.from_lonlat(place), 1e5))
    assert mgrs.to_lonlat(mgrs.from_lonlat(place)) == pytest.approx(place)


@pytest.mark.parametrize("kind", ["LocalCartesianUTM", "LocalCartesian", "TransverseMercator"])
def test_the_origin_of_a_projector_is_zero_and_north_is_north(kind: str) -> None:
    frame = read_projector(f"{kind}:35.6762,139.6503,40")
    around = np.array([[*TOKYO, 40.0], [TOKYO[0], TOKYO[1] + 0.001, 40.0], [TOKYO[0] + 0.001, TOKYO[1], 41.0]])
    local = frame.from_lonlat(around)
    assert np.abs(local[0]).max() < 1e-6
    assert local[1, 1] == pytest.approx(110.95, rel=1e-3)
    assert local[2, 0] == pytest.approx(90.5, rel=2e-3)
    assert local[2, 2] == pytest.approx(1.0, abs=1e-3)
    assert frame_of_projector(projector_of(frame)) == frame


def test_transverse_mercator_takes_the_scale_factor() -> None:
    text = "projector_type: TransverseMercator\nscale_factor: {}\nmap_origin: {{latitude: 35.0, longitude: 139.0}}\n"
    place = np.array([[139.0, 35.1, 0.0]])
    one, small = (frame_of_projector(text.format(k)).from_lonlat(place)[0, 1] for k in (1.0, 0.9996))
    assert small / one == pytest.approx(0.9996)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("projector_type: Mercator\n", "unknown projector_type"),
        ("- 1\n", "no projector_type"),
        ("projector_type: MGRS\nmgrs_grid: 99ZZZ\n", "no MGRS grid"),
        ("projector_type: LocalCartesian\n", "needs map_origin"),
        ("projector_type: LocalCartesian\nmap_origin: {latitude: 3500, longitude: 1}\n", "no latitude"),
    ],
)
def test_a_wrong_projector_is_one_clear_error(text: str, why: str) -> None:
    with pytest.raises(MapvoteError, match=why):
        frame_of_projector(text)


@settings(max_examples=25, deadline=None)
@given(st.sampled_from([(2992, 0.3048), (2264, 1200 / 3937), (6339, 1.0)]), st.integers(0, 2**31))
def test_feet_become_metres_of_the_same_place(case: tuple[int, float], seed: int) -> None:
    code, unit = case
    area = read_crs(f"EPSG:{code}").area_of_use
    middle = np.array([[(area.west + area.east) / 2, (area.south + area.north) / 2, 0.0]])
    in_file = MapFrame(f"EPSG:{code}").from_lonlat(middle) + np.random.default_rng(seed).uniform(-900, 900, (5, 3))
    frame, convert = settle("file", MapFrame(f"EPSG:{code}"), None, in_file)
    metres = convert(in_file)
    assert np.allclose(metres, in_file * unit, rtol=1e-12)
    assert np.abs(frame.to_lonlat(metres)[:, :2] - MapFrame(f"EPSG:{code}").to_lonlat(in_file)[:, :2]).max() < 1e-10


def test_degrees_are_refused_with_the_command_that_projects_them() -> None:
    degrees = np.random.default_rng(0).uniform([139.65, 35.67, 0], [139.651, 35.671, 30], (200, 3))
    with pytest.raises(MapvoteError, match="MAP --crs EPSG:32653"):
        settle("f.las", MapFrame("EPSG:4326"), None, np.array([[137.9, 35.0, 0.0], [138.1, 35.0, 0.0]]))
    with pytest.raises(MapvoteError, match="MAP --crs EPSG:32654"):
        settle("f.las", MapFrame("EPSG:4326"), None, degrees)
    with pytest.raises(MapvoteError, match="look like degrees"):
        settle("f.ply", MapFrame(), None, degrees)
    frame, convert = settle("f.las", MapFrame("EPSG:4326"), MapFrame("EPSG:32654"), degrees)
    assert np.ptp(convert(degrees), axis=0)[:2] == pytest.approx([90, 111], rel=0.03)
    assert frame.crs == "EPSG:32654"


def test_metres_from_the_centre_of_the_earth_are_refused_and_others_that_far_are_not() -> None:
    lon, lat = np.radians(np.random.default_rng(0).uniform([139.65, 35.67], [139.651, 35.671], (200, 2))).T
    geocentric = 6.371e6 * np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    with pytest.raises(MapvoteError, match=r"6371 km .*--from-crs EPSG:4978 --crs EPSG:n"):
        settle("f.ply", MapFrame(), None, geocentric)
    for far in (1.01 * geocentric, 0.99 * geocentric, geocentric * [1.0, 1.0, 0.0]):
        assert settle("f.ply", MapFrame(), None, far)[0].is_local


def test_heights_are_named_where_the_file_names_them() -> None:
    one = np.zeros((1, 3))
    assert settle("f", MapFrame("EPSG:32654+3855"), None, one)[0].heights == "EGM2008 height"
    assert settle("f", MapFrame("EPSG:32654"), None, one)[0].heights == ""
    for file, wanted, heights in (
        (MapFrame(heights="of the file"), MapFrame("EPSG:32654", heights="wanted"), "of the file"),
        (MapFrame(), MapFrame("EPSG:32654", heights="wanted"), "wanted"),
        (MapFrame(heights="of the file"), MapFrame("EPSG:32654"), "of the file"),
        (MapFrame("EPSG:4326", heights="of the file"), MapFrame("EPSG:32654"), "of the file"),
        (MapFrame("EPSG:4326", heights="of the file"), MapFrame("EPSG:32654", heights="wanted"), "wanted"),
        (MapFrame("EPSG:4979"), MapFrame("EPSG:32654"), "above the ellipsoid"),
        (MapFrame("EPSG:32653", heights="of the file"), MapFrame("EPSG:32654"), "of the file"),
    ):
        assert settle("f", file, wanted, one)[0].heights == heights
    feet = settle("f", MapFrame("EPSG:6339+6360"), None, one)[1](np.array([[1.0, 1.0, 1.0]]))
    assert feet == pytest.approx(np.array([[1.0, 1.0, 1200 / 3937]]))


def test_geotiff_keys_name_a_system_and_its_units() -> None:
    assert frame_of_keys("f", {1024: 1, 3072: 32654}).crs == "EPSG:32654"
    assert frame_of_keys("f", {}).is_local
    assert read_crs(frame_of_keys("f", {1024: 2, 2048: 4326}).crs).is_geographic
    feet = frame_of_keys("f", {1024: 1, 3072: 32654, 3076: 9002, 4099: 9001})
    with pytest.raises(MapvoteError, match="--from-crs"):
        frame_of_keys("f", {1024: 1, 3072: 32767})
    ones = np.ones((1, 3))
    assert settle("f", feet, None, ones)[1](ones) == pytest.approx(np.array([[0.3048, 0.3048, 1]]))
    above = frame_of_keys("f", {1024: 1, 3072: 32654, 4096: 3855, 4099: 9002})
    assert settle("f", above, None, ones)[1](ones) == pytest.approx(np.array([[1, 1, 0.3048]]))
    assert with_units("EPSG:32654", "metre", None) == "EPSG:32654"


def test_autoware_gets_mgrs_within_one_square_else_metres_from_the_middle() -> None:
    utm = MapFrame("EPSG:32654")
    near = utm.from_lonlat(np.array([[*TOKYO, 0.0]])) + np.array([[0.0, 0, 0], [500, 500, 9]])
    assert "54SUE" in autoware_frame(utm, near).projector
    far = near + np.array([[0, 0, 0], [99_000.0, 0, 0]])
    assert "LocalCartesianUTM" in autoware_frame(utm, far).projector
    with pytest.raises(MapvoteError, match="spans the MGRS squares"):
        autoware_frame(utm, far, "MGRS")


def test_grid_north_is_not_true_north_beside_the_central_meridian() -> None:
    """Convergence at Tokyo in zone 54 (141 deg east): (139.65 - 141) sin(35.68) = -0.787 deg."""
    axes = MapFrame("EPSG:32654").axes_at(np.array([[*TOKYO, 0.0]]))[0]
    assert np.degrees(np.arctan2(axes[1, 0], axes[0, 0])) == pytest.approx(-0.787, abs=0.01)
    assert np.allclose(axes.T @ axes, np.eye(3))
    level = enu_frame(TOKYO[1], TOKYO[0], 0.0).axes_at(np.array([[*TOKYO, 0.0]]))[0]
    assert np.allclose(level, np.eye(3), atol=1e-5)
