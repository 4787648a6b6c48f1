"""A mapvote map folder keeps a map bit for bit, appears whole, and notices damage."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.codec.manifest import TileHashes, digests_of, shown
from mapvote.codec.tile_planes import check_plane, pack_tile, unpack_tile
from mapvote.core.grid import TILE_CELLS, Lattice
from mapvote.core.point_map import PointMap, all_points, map_from_points
from mapvote.core.tile import Tile
from mapvote.core.types import MapvoteError
from mapvote.formats import read_map, write_map
from mapvote.formats.describe import describe
from mapvote.formats.maps.mapvote_folder import read_manifest
from mapvote_server.store.store import Store


def small_map(seed: int = 0, offset: tuple[float, float] = (0.0, 0.0)) -> PointMap:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-100, -50, -1], [100, 50, 8], (3000, 3)) + np.array([*offset, 0.0])
    lattice = Lattice(round(offset[0] / 0.3) * 0.3, round(offset[1] / 0.3) * 0.3)
    return map_from_points(points, lattice=lattice, georeference={"crs": "EPSG:32654", "note": "é"})


def same(a: Tile, b: Tile) -> bool:
    free = (a.free is None and b.free is None) or np.array_equal(a.free, b.free)  # type: ignore[arg-type]
    return free and np.array_equal(a.points, b.points) and np.array_equal(a.ground_z, b.ground_z, equal_nan=True)


def test_a_round_trip_is_exact_even_at_utm_coordinates_and_the_same_map_gives_the_same_bytes(tmp_path: Path) -> None:
    before = small_map(offset=(367_123.456, 3_951_876.543))
    write_map(before, tmp_path / "m")
    after = read_map(tmp_path / "m")
    assert (after.map_id, after.lattice, after.georeference) == (before.map_id, before.lattice, before.georeference)
    assert list(after.tiles) == sorted(before.tiles)
    assert all(same(before.tiles[k], after.tiles[k]) for k in before.tiles)
    assert np.array_equal(all_points(before), all_points(after))
    write_map(after, tmp_path / "again")
    first, again = (
        {f.name: f.read_bytes() for f in (tmp_path / name).rglob("*") if f.is_file()} for name in ("m", "again")
    )
    assert len(first) > 3
    assert first == again


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 40), st.integers(0, 2**32 - 1), st.booleans())
def test_a_tile_comes_back_from_its_planes_and_equal_tiles_have_equal_planes(n: int, seed: int, learned: bool) -> None:
    rng = np.random.default_rng(seed)
    points = (rng.random((n, 3)) * 76.7).astype(np.float32)
    ground_z = np.where(rng.random((TILE_CELLS, TILE_CELLS)) < 0.1, np.nan, 1.5).astype(np.float32)
    free = rng.integers(0, 2**63, (TILE_CELLS, TILE_CELLS), dtype=np.uint64) if learned else None
    window = Lattice().tile((2, -3))
    tile = Tile(window, points, ground_z, free)
    hashes, frames = pack_tile(tile)
    back = unpack_tile(window, hashes, {name: frames[digest] for name, digest in hashes.planes().items()})
    assert same(back, tile)
    assert pack_tile(back) == (hashes, frames)


def test_a_folder_that_is_no_map_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "cat.jpg").write_text("cat")
    with pytest.raises(MapvoteError, match="not replaced"):
        write_map(small_map(), tmp_path)


@pytest.mark.parametrize("flipped", [True, False])
def test_one_flipped_bit_or_a_missing_plane_is_noticed(tmp_path: Path, flipped: bool) -> None:
    write_map(small_map(), tmp_path / "m")
    plane = sorted((tmp_path / "m" / "planes").iterdir())[0]
    data = bytearray(plane.read_bytes())
    data[len(data) // 2] ^= 1
    plane.unlink()
    if flipped:
        plane.write_bytes(data)
    with pytest.raises(MapvoteError, match=plane.name[:12] if flipped else f"{plane.name}: No such file"):
        read_map(tmp_path / "m")


def test_planes_that_the_manifest_interchanges_are_refused(tmp_path: Path) -> None:
    write_map(small_map(), tmp_path / "m")
    file = tmp_path / "m" / "manifest.json"
    told = json.loads(file.read_text())
    planes = told["tiles"]["0,0"]
    planes["points"], planes["ground"] = planes["ground"], planes["points"]
    file.write_text(json.dumps(told))
    with pytest.raises(MapvoteError, match="its tiles are not those of its digest"):
        read_map(tmp_path / "m")
    whole = digests_of((key, TileHashes(**{"free": None} | hashes)) for key, hashes in told["tiles"].items())
    file.write_text(json.dumps(told | {"digest": shown(*whole)[0]}))
    with pytest.raises(MapvoteError, match="no plane of its kind"):
        read_map(tmp_path / "m")


def test_a_folder_is_what_a_server_of_the_map_tells(tmp_path: Path) -> None:
    """Its manifest and its planes, hash by hash."""
    write_map(small_map(), tmp_path / "m")
    with closing(Store.create(f"sqlite:///{tmp_path / 's.db'}", read_map(tmp_path / "m"))) as store:
        told, kept = store.manifest(), read_manifest(tmp_path / "m")
        assert (told.map_id, told.lattice, told.tiles) == (kept.map_id, kept.lattice, kept.tiles)
        assert (told.digest, told.version) == (kept.digest, kept.version)
        for plane in (tmp_path / "m" / "planes").iterdir():
            assert check_plane(store.blob(plane.name), plane.name) == check_plane(plane.read_bytes(), plane.name)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("format_version", 99, "update mapvote"),
        ("cell_size", 0.2, r"cells of 0\.2 m"),
        ("lattice", "a", "not a readable"),
    ],
)
def test_a_manifest_of_another_kind_is_refused(tmp_path: Path, key: str, value: object, message: str) -> None:
    write_map(small_map(), tmp_path / "m")
    file = tmp_path / "m" / "manifest.json"
    manifest = json.loads(file.read_text())
    manifest[key] = value
    file.write_text(json.dumps(manifest))
    with pytest.raises(MapvoteError, match=message):
        read_map(tmp_path / "m")


def test_the_driven_paths_come_back_and_info_says_how_high_the_sensor_stood(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(0.15, 40.0, 0.3), np.arange(0.15, 12.0, 0.3))
    road = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    path = np.column_stack([np.arange(2.0, 38.0), np.full(36, 6.0), np.full(36, 1.73)])
    write_map(replace(map_from_points(road), driven=(path,)), tmp_path / "map")
    back = read_map(tmp_path / "map")
    np.testing.assert_array_equal(back.driven[0], path)
    rows = dict(describe(tmp_path / "map")[1])
    assert rows["drive 1"] == "sensor 1.73 m over the ground (median), off by 0.00 m at most"
    write_map(map_from_points(road), tmp_path / "imported")
    assert read_map(tmp_path / "imported").driven == ()
