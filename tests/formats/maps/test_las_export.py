"""Content of LAS files of a map: every coordinate in its unit, brightness on its scale, flags, the kind of times."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapvote.core.point_map import PointMap, all_fields, all_points, lattice_of, map_from_points
from mapvote.core.types import F64, MapvoteError
from mapvote.formats import export_map, import_cloud, read_map, stream_cloud, write_map
from mapvote.formats.geo.frame import MapFrame
from mapvote.formats.maps.cloud import Cloud, joined
from mapvote.formats.maps.las import steps_and_offsets, write_las
from mapvote.formats.maps.marked_points import marks_in
from mapvote.formats.maps.pcd import write_pcd
from mapvote.formats.maps.ply import write_ply

BERLIN = np.array([389_000.0, 5_820_000.0, 30.0])
NEW_YORK = np.array([585_000.0, 4_511_000.0, 5.0])


def placed(n: int, corner: F64, crs: str, seed: int = 0) -> PointMap:
    points = np.random.default_rng(seed).uniform([0, 0, 0], [150, 150, 15], (n, 3)) + corner
    return map_from_points(points, lattice=lattice_of(points), georeference={"crs": crs})


def sorted_axes(points: Any) -> F64:
    return np.sort(np.asarray(points, dtype=np.float64), axis=0)


def xyz_of(file: Path) -> F64:
    las = laspy.read(file)
    return np.column_stack([las.x, las.y, las.z])


def test_an_export_in_degrees_keeps_every_coordinate(tmp_path: Path) -> None:
    before = placed(95_514, BERLIN, "EPSG:32633")
    _, frame = export_map(before, tmp_path / "a.laz", crs="EPSG:4326")
    right = MapFrame("EPSG:32633").to_lonlat(all_points(before))
    written = xyz_of(tmp_path / "a.laz")
    assert len(np.unique(written[:, 0])) == len(np.unique(right[:, 0])) == 95_514
    assert np.abs(written - right)[:, :2].max() < 1e-12
    assert "x longitude, y latitude, degrees" in frame.told()
    after, _ = import_cloud(tmp_path / "a.laz", MapFrame("EPSG:32633"))
    assert np.abs(sorted_axes(all_points(after)) - sorted_axes(all_points(before))).max() < 1e-4


@pytest.mark.parametrize("crs", ["EPSG:2263", "EPSG:2263+6360", "EPSG:2263+5703", "EPSG:6539", "EPSG:32618"])
def test_heights_are_in_the_unit_of_the_coordinate_system(tmp_path: Path, crs: str) -> None:
    """Feet where the system has feet; a system that names metres for heights gets metres."""
    before = placed(2000, NEW_YORK, "EPSG:32618")
    export_map(before, tmp_path / "a.las", crs=crs)
    high = xyz_of(tmp_path / "a.las")[:, 2].max()
    assert np.isclose(high, 20.0 if crs in ("EPSG:32618", "EPSG:2263+5703") else 20.0 * 3937 / 1200, rtol=0.01)
    after, _ = import_cloud(tmp_path / "a.las", MapFrame("EPSG:32618"))
    assert np.abs(sorted_axes(all_points(after)) - sorted_axes(all_points(before))).max() < 2e-4


def test_a_map_is_never_in_degrees_or_feet(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    before = placed(500, NEW_YORK, "EPSG:32618")
    export_map(before, tmp_path / "a.las")
    with pytest.raises(MapvoteError, match="a map needs metres"):
        import_cloud(tmp_path / "a.las", MapFrame("EPSG:4326"))
    after, _ = import_cloud(tmp_path / "a.las", MapFrame("EPSG:2263"))
    assert np.ptp(all_points(after), axis=0).max() < 160
    assert "a map is in metres" in caplog.text


@pytest.mark.parametrize(
    ("name", "options", "said"),
    [
        ("a.pcd", {"crs": "EPSG:4326"}, "float32, which rounds degrees .* --crs EPSG:32633"),
        ("a.las", {"crs": "EPSG:4978"}, "geocentric metres have no heights"),
        ("a.las", {"crs": "EPSG:4326", "offset": (1.0, 0.0, 0.0)}, "--offset is in metres"),
    ],
)
def test_an_export_that_would_lose_values_is_refused(tmp_path: Path, name: str, options: Any, said: str) -> None:
    with pytest.raises(MapvoteError, match=said):
        export_map(placed(200, BERLIN, "EPSG:32633"), tmp_path / name, **options)
    assert list(tmp_path.iterdir()) == []


def test_a_local_map_is_not_put_on_earth_in_degrees(tmp_path: Path) -> None:
    local = map_from_points(np.random.default_rng(0).uniform(0, 9, (100, 3)))
    with pytest.raises(MapvoteError, match="the map's place on Earth is unknown"):
        export_map(local, tmp_path / "a.las", crs="EPSG:4326")


@given(
    st.tuples(*[st.floats(-2e7, 2e7)] * 3), st.tuples(*[st.floats(0, 4e7)] * 3), st.booleans(), st.integers(0, 2**31)
)
def test_no_coordinate_overflows_32_bits(low: Any, wide: Any, degrees: bool, seed: int) -> None:
    """Anywhere, of any extent; where 0.1 mm fits, steps are 0.1 mm."""
    corners = np.array([low, np.add(low, wide)])
    if degrees:
        corners[:, :2] = corners[:, :2] % 179.0
        corners = np.sort(corners, axis=0)
    steps, offsets = steps_and_offsets(corners, degrees=degrees)
    within = corners[0] + np.random.default_rng(seed).random((50, 3)) * (corners[1] - corners[0])
    stored = np.rint((np.concatenate([corners, within]) - offsets) / steps)
    assert np.abs(stored).max() <= 2**31 - 1
    assert (steps[2] == 1e-4) == (0.5 * (corners[1, 2] - corners[0, 2]) < 214_000)


rng = np.random.default_rng(5)
U = rng.random(4000)
ONE, FEW = np.arange(4000) == 7, np.arange(4000) < 9
COUNTS = np.floor(U * 4096)
EXACT: dict[str, tuple[NDArray[Any], NDArray[Any], str]] = {
    "8 bits": ((U * 256).astype(np.uint8), np.floor(U * 256), ""),
    "12 bits as float32": (COUNTS.astype(np.float32), COUNTS, ""),
    "12 bits in 4 bytes": (COUNTS.astype(np.int32), COUNTS, ""),
    "16 bits": (np.floor(U * 65536).astype(np.uint16), np.floor(U * 65536), ""),
    "16 bits as float64": (np.floor(U * 65536), np.floor(U * 65536), ""),
    "12 bits and NaN": (np.where(FEW, np.nan, COUNTS), np.where(FEW, 0, COUNTS), "9 not finite"),
    "negative whole numbers": (np.where(FEW, -5, COUNTS).astype(np.int16), np.where(FEW, 0, COUNTS), "9 negative"),
}
SCALED: dict[str, tuple[NDArray[Any], NDArray[Any], str]] = {
    "to 1": (U.astype(np.float32), U, ""),
    "to 255": (U * 255, U, ""),
    "to 4095": ((U * 4095).astype(np.float32), U, ""),
    "one of 1.0001": (np.where(ONE, 1.0001, U), np.where(ONE, 1.0, U), ""),
    "one of 300": (np.where(ONE, 300.0, U), np.where(ONE, 1.0, U), "1 above the scale"),
    "one infinite": (np.where(ONE, np.inf, U), np.where(ONE, 0.0, U), "1 not finite"),
    "some NaN": (np.where(FEW, np.nan, U), np.where(FEW, 0.0, U), "9 not finite"),
    "some negative": (np.where(FEW, -3.0, U), np.where(FEW, 0.0, U), "9 negative"),
    "whole numbers of more than 16 bits": (np.where(ONE, 1_000_000, U * 1e6).astype(np.uint32), U, ""),
    "dark": (U * 0.01, U * 0.01, ""),
}


@pytest.mark.parametrize("name", [*EXACT, *SCALED])
@pytest.mark.filterwarnings("error")
def test_intensity_in_las_is_exact_or_on_a_stated_scale(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Whole numbers to 65535 stay as they are; reals become 0 to 65535. Values that LAS cannot hold are counted."""
    values, right, lost = (EXACT | SCALED)[name]
    points = np.random.default_rng(1).uniform(0, 50, (4000, 3))
    write_las(tmp_path / "a.las", Cloud(points, fields={"intensity": values}))
    written = laspy.read(tmp_path / "a.las").intensity.astype(np.float64)
    if name in EXACT:
        assert np.array_equal(written, right)
    else:
        same = ~ONE if "more than 16" in name else np.ones(4000, bool)
        assert np.abs(written - 65535 * right)[same].max() <= 1.0
    assert ("is written as 0 to 65535" in caplog.text) == (name in SCALED)
    assert lost in caplog.text
    assert lost or "LAS holds" not in caplog.text


@pytest.mark.parametrize(
    ("colours", "right"),
    [
        (np.array([[0, 255, 7]], np.uint8), [0, 65535, 7 * 257]),
        (np.array([[0, 65535, 7]], np.uint16), [0, 65535, 7]),
        (np.array([[0.0, 1.0, 0.5]]), [0, 65535, 32768]),
        (np.array([[0.0, 255.0, 1.0]]), [0, 65535, 257]),
        (np.array([[0.0, 65535.0, 1.0]]), [0, 65535, 1]),
        (np.array([[1.0, 200.0, 1.0]]), [257, 51400, 257]),
    ],
)
def test_colours_share_one_scale(tmp_path: Path, colours: NDArray[Any], right: list[int]) -> None:
    """A channel that is dark everywhere is not brightened by itself."""
    fields = dict(zip(("red", "green", "blue"), colours.T, strict=True))
    write_las(tmp_path / "a.las", Cloud(np.ones((1, 3)), fields=fields))
    las = laspy.read(tmp_path / "a.las")
    assert [int(las[name][0]) for name in fields] == right


@pytest.mark.slow
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**31), st.sampled_from([".las", ".laz"]), st.sampled_from(["week", "adjusted standard"]))
def test_flags_and_the_kind_of_times_survive_every_way(tmp_path: Path, seed: int, suffix: str, times: str) -> None:
    """Through a map folder and through PLY too; kept as asked."""
    r = np.random.default_rng(seed)
    points, flags = np.round(r.uniform(0, 60, (300, 3)), 3), r.integers(0, 16, 300).astype(np.uint8)
    fields: dict[str, NDArray[Any]] = {"las_flags": flags, "gps_time": r.uniform(0, 6e5, 300)}
    write_las(tmp_path / f"a{suffix}", Cloud(points, fields=fields, gps_times=times))
    las = laspy.read(tmp_path / f"a{suffix}")
    assert int(las.header.global_encoding.gps_time_type) == (times != "week")
    assert np.array_equal(np.array(las.withheld, bool), flags & 4 > 0)
    kept, _ = import_cloud(tmp_path / f"a{suffix}", drop=marks_in("none"))
    write_map(kept, tmp_path / "m")
    export_map(read_map(tmp_path / "m"), tmp_path / f"b{suffix}")
    again = laspy.read(tmp_path / f"b{suffix}")
    assert again.header.global_encoding.gps_time_type == las.header.global_encoding.gps_time_type
    for name in ("withheld", "synthetic", "key_point", "overlap"):
        assert np.array_equal(by_place(again, name), by_place(las, name))
    export_map(kept, tmp_path / "a.ply")
    assert np.array_equal(np.sort(joined(stream_cloud(tmp_path / "a.ply")).fields["las_flags"]), np.sort(flags))


def by_place(las: Any, name: str) -> NDArray[Any]:
    return np.array(las[name])[np.lexsort(np.round([las.x, las.y, las.z], 3))]


def marked_file(file: Path, **fields: Any) -> None:
    points = np.random.default_rng(2).uniform(0, 60, (500, 3))
    write = {".las": write_las, ".ply": write_ply, ".pcd": write_pcd}[file.suffix]
    write(file, Cloud(points, fields=fields))


@pytest.mark.parametrize("suffix", [".las", ".ply", ".pcd"])
def test_withheld_points_and_noise_become_no_map(tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture) -> None:
    flags = np.where(np.arange(500) < 100, 4, 1).astype(np.uint8)
    classes = np.where(np.arange(500) % 10 == 9, 18, 1).astype(np.uint8)
    marked_file(tmp_path / f"a{suffix}", las_flags=flags, classification=classes)
    point_map, told = import_cloud(tmp_path / f"a{suffix}")
    assert point_map.n_points == 360
    assert "dropped: 100 points that the file marks as withheld" in told
    assert "dropped: 50 points that the file marks as noise (classes 7 and 18)" in told
    assert "kept: 400 points that the file marks as synthetic" in told
    assert read_map(tmp_path / f"a{suffix}").n_points == 360, "every verb reads the same map"
    assert "dropped: 100 points that the file marks as withheld" in caplog.text
    without, told = import_cloud(tmp_path / f"a{suffix}", drop=marks_in("synthetic"))
    assert without.n_points == 100
    assert "kept: 100 points that the file marks as withheld" in told
    with pytest.raises(MapvoteError, match="'ghost' is no mark of points; use withheld, noise"):
        marks_in("ghost")


def test_class_12_of_old_files_is_the_flag_overlap(tmp_path: Path) -> None:
    old = laspy.create(point_format=1, file_version="1.2")
    old.x, old.y, old.z = np.random.default_rng(0).uniform(0, 9, (3, 60))
    old.classification = np.where(np.arange(60) < 20, 12, 2)
    old.write(str(tmp_path / "a.las"))
    point_map, told = import_cloud(tmp_path / "a.las")
    assert "kept: 20 points that the file marks as overlap" in told
    assert set(all_fields(point_map)["classification"].tolist()) == {1, 2}


def test_no_map_without_flags_holds_a_field_of_them(tmp_path: Path) -> None:
    write_las(tmp_path / "a.las", Cloud(np.random.default_rng(0).uniform(0, 9, (60, 3))))
    assert "las_flags" not in read_map(tmp_path / "a.las").field_names


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("point_format", range(11))
def test_a_header_that_counts_other_than_the_file_holds_is_named(
    tmp_path: Path, suffix: str, point_format: int, caplog: pytest.LogCaptureFixture
) -> None:
    """In every point format; of LAZ up to format 5 the chunks do not tell, but the header's returns do."""
    if suffix == ".laz" and point_format in (4, 5, 9, 10):
        pytest.skip("lazrs writes no waveforms")
    version = "1.4" if point_format >= 6 else "1.3"
    las = laspy.create(point_format=point_format, file_version=version)
    las.x, las.y, las.z = np.random.default_rng(0).uniform(0, 50, (3, 4000))
    las.return_number = las.number_of_returns = np.ones(4000, np.uint8)
    las.write(str(tmp_path / f"a{suffix}"))
    assert len(joined(stream_cloud(tmp_path / f"a{suffix}")).points) == 4000
    assert caplog.text == ""
    data = bytearray((tmp_path / f"a{suffix}").read_bytes())
    for said, wrong in (("data for 1000 more follow", 3000), ("cut off|not a whole", 5000)):
        struct.pack_into("<I", data, 107, wrong if point_format < 6 else 0)
        if version == "1.4":
            struct.pack_into("<Q", data, 247, wrong)
        (tmp_path / f"b{suffix}").write_bytes(data)
        if suffix == ".laz" and point_format < 6 and wrong == 3000:
            joined(stream_cloud(tmp_path / f"b{suffix}"))
            assert "counts 3000 points, but 4000 returns" in caplog.text
            continue
        with pytest.raises(MapvoteError, match=said):
            joined(stream_cloud(tmp_path / f"b{suffix}"))


def test_a_coordinate_system_that_nobody_makes_out_can_be_named(tmp_path: Path) -> None:
    """Many files of surveys describe a projection of their own in GeoTIFF keys."""
    las = laspy.create(point_format=1, file_version="1.2")
    las.x, las.y, las.z = np.random.default_rng(0).uniform(0, 50, (3, 400))
    keys = laspy.vlrs.known.GeoKeyDirectoryVlr()
    keys.record_data_bytes = lambda: struct.pack("<12H", 1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 32767)
    las.header.vlrs.append(keys)
    las.write(str(tmp_path / "a.las"))
    with pytest.raises(MapvoteError, match="--from-crs EPSG:n"):
        import_cloud(tmp_path / "a.las")
    assert import_cloud(tmp_path / "a.las", from_crs="EPSG:32633")[0].n_points == 400
    assert len(joined(stream_cloud(tmp_path / "a.las")).points) == 400, "a scan needs no coordinate system"
