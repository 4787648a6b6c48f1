"""A map that is made piece by piece, over the disk, is the map that is made of all its points at once."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hand_made import Say, make_ballot, save_pcd, states_plane, wall
from mapvote.codec.planes import pack_plane
from mapvote.config import FuseSettings
from mapvote.core.point_map import LazyTiles, PointMap, lattice_of, map_from_points
from mapvote.core.types import F64, CellState, MapvoteError
from mapvote.formats import export_map, import_cloud, read_map, write_map
from mapvote.formats.maps.cloud import Cloud, ReadSizes
from mapvote.formats.maps.las import write_las
from mapvote.formats.maps.mapvote_folder import read_manifest
from mapvote.formats.maps.pcd import stream_pcd, write_pcd
from mapvote.formats.maps.ply import stream_ply, write_ply
from mapvote.formats.maps.tiling import map_of
from mapvote.formats.registry import MAPS
from mapvote.fusion.fuse import update_map


def street(seed: int, n: int = 4000, x: float = 0.0) -> tuple[F64, dict[str, Any]]:
    """Two tiles of road, and things on it."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([x - 40, -30, 0], [x + 40, 30, 0.02], (n, 3))
    points[: n // 4, 2] += rng.uniform(0, 5, n // 4)
    classes = np.where(points[:, 2] < 0.05, 2, 1).astype(np.uint8)
    return points, {"intensity": rng.integers(0, 999, n).astype(np.uint16), "classification": classes}


def content(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def files(point_map: PointMap, folder: Path) -> dict[str, bytes]:
    write_map(point_map, folder)
    return content(folder)


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**31), st.lists(st.integers(0, 4000), max_size=5), st.sampled_from([0.0, 367_000.0]))
def test_pieces_make_the_same_bytes_as_the_whole(
    tmp_path_factory: pytest.TempPathFactory, seed: int, cuts: list[int], x: float
) -> None:
    points, fields = street(seed, x=x)
    ends = [0, *sorted(cuts), len(points)]
    pieces = [
        Cloud(points[a:b], fields={name: column[a:b] for name, column in fields.items()}) for a, b in pairwise(ends)
    ]
    folder = tmp_path_factory.mktemp("maps")
    road = points[fields["classification"] == 2]
    whole = map_from_points(points, lattice=lattice_of(points), road=road, fields=fields, georeference={"crs": "local"})
    assert files(map_of("it", iter(pieces)), folder / "a") == files(whole, folder / "b")


def test_points_are_looked_at_before_tiles_are_cut(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def look(pieces: Any, ground: Any) -> None:
        seen.extend(pieces())
        raise MapvoteError("these are millimetres")

    seen: list[Any] = []
    points, _ = street(3)
    write_pcd(tmp_path / "mm.pcd", Cloud(1000.0 * points))
    monkeypatch.setattr("mapvote.formats.maps.tiling.lay_ground", lambda *_: pytest.fail("the ground was laid"))
    for read in (lambda: read_map(tmp_path / "mm.pcd", look), lambda: import_cloud(tmp_path / "mm.pcd", look=look)):
        with pytest.raises(MapvoteError, match="these are millimetres"):
            read()
    assert sum(map(len, seen)) == 2 * len(points)


SMALL = ReadSizes(block=700, in_memory_bytes=1, kept_points=1500)
"""Every map counts as larger than memory."""


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are read in small blocks."""
    for name, stream in (("PCD file", stream_pcd), ("PLY file", stream_ply)):
        monkeypatch.setitem(MAPS, name, replace(MAPS[name], stream=partial(stream, sizes=SMALL)))


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(
    ("suffix", "out"),
    [(".pcd", "a.las"), (".ply", "a.laz"), (" ascii.pcd", "a.ply"), (".laz", "a.pcd"), (".las", "a")],
)
def test_a_map_larger_than_memory_is_the_same_map_and_leaves_as_the_same_file(
    tmp_path: Path, suffix: str, out: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    points, fields = street(3)
    cloud, file = Cloud(points, fields=fields), tmp_path / f"a{suffix}"
    if "pcd" in suffix:
        save_pcd(file, points, "ascii" if "ascii" in suffix else "binary", **fields)
    else:
        (write_ply if suffix == ".ply" else write_las)(file, cloud)
    made, _ = import_cloud(file, folder=tmp_path, sizes=SMALL)
    assert isinstance(made.tiles, LazyTiles)
    assert (len(made.tiles), made.n_points) == (4, 4000)
    lazy = files(made, tmp_path / "lazy")
    export_map(made, tmp_path / "out of lazy" / out)
    monkeypatch.undo()
    small, _ = import_cloud(file)
    assert isinstance(small.tiles, dict)
    assert lazy == files(small, tmp_path / "small")
    export_map(small, tmp_path / "out of small" / out)
    written = content(tmp_path / "out of lazy")
    assert written == content(tmp_path / "out of small")
    assert len(written) == (1 if "." in out else 18)
    assert {p.name for p in tmp_path.iterdir()} == {file.name, "lazy", "small", "out of lazy", "out of small"}


def test_a_tile_that_somebody_holds_is_not_made_again(tmp_path: Path) -> None:
    points, fields = street(4)
    made = map_of("it", [Cloud(points, fields=fields)], sizes=SMALL)
    held = made.tiles[0, 0]
    for _ in range(2):
        assert sum(len(tile.points) for tile in made.tiles.values()) == 4000
    assert made.tiles[0, 0] is held
    assert made.tiles.get((7, 7)) is None


def test_a_large_map_on_disk_is_opened_tile_by_tile_and_updated(tmp_path: Path) -> None:
    points, fields = street(7)
    write_map(map_of("it", [Cloud(points, fields=fields)]), tmp_path / "m")
    opened = read_map(tmp_path / "m", sizes=SMALL)
    assert isinstance(opened.tiles, LazyTiles)
    built = Say(states_plane({(5, 5): CellState.CHANGED_OCCUPIED}), new_points=wall([(5, 5)], [0.45, 0.75]))
    after, _ = update_map(opened, [make_ballot(opened, {(0, 0): built})], FuseSettings(min_votes=1))
    assert isinstance(after.tiles, LazyTiles)
    assert after.n_points == 4002
    assert after.tiles[0, -1] is opened.tiles[0, -1]
    before, now = files(opened, tmp_path / "a"), files(after, tmp_path / "b")
    assert {name for name in now.keys() & before.keys() if now[name] != before[name]} == {"manifest.json"}
    assert len(now.keys() - before.keys()) == 3, "points and fields of one tile, and what it remembers"


def test_a_large_map_with_a_damaged_tile_is_refused_when_it_is_opened(tmp_path: Path) -> None:
    points, _ = street(8)
    write_map(map_of("it", [Cloud(points)]), tmp_path / "m")
    plane = read_manifest(tmp_path / "m").tiles["0,0"].points
    (tmp_path / "m/planes" / plane).write_bytes(pack_plane(np.zeros((4, 3), np.float32)))
    with pytest.raises(MapvoteError, match=f"tile plane {plane[:12]} does not match its hash"):
        read_map(tmp_path / "m", sizes=SMALL)


def test_a_file_that_is_cut_off_late_leaves_no_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(MAPS, "PCD file", replace(MAPS["PCD file"], stream=partial(stream_pcd, sizes=SMALL)))
    points, _ = street(5)
    write_pcd(tmp_path / "a.pcd", Cloud(points))
    (tmp_path / "a.pcd").write_bytes((tmp_path / "a.pcd").read_bytes()[:-100])
    with pytest.raises(MapvoteError, match="cut off: 3991 points, but its header says 4000"):
        read_map(tmp_path / "a.pcd")


def test_a_full_disk_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(**_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.TemporaryFile", full)
    points, _ = street(6)
    with pytest.raises(MapvoteError, match="temporary files cannot be written"):
        map_of("it", [Cloud(points)], sizes=SMALL)
