"""A folder follows a server while Autoware's map loader reads it: three versions and a rollback."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from pypcd4 import PointCloud

from mapvote.cli.files import follow_once
from mapvote.core.point_map import PointMap, all_points, map_from_points
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.maps.autoware import lay_version
from mapvote.formats.maps.cloud import Cloud

STREET = np.random.default_rng(3).uniform([-35, -35, 0], [35, 35, 4], (3000, 3)).astype(np.float32).astype(np.float64)


@dataclass
class Loader:
    """Autoware's differential map loader by its published rules, and one client that caches cells by their ids.

    On start it reads the metadata once and lists the folder; a file that the metadata does not name is left out. A
    cell's id is its path. Asked for an area with the ids that the client has, it answers with the cells that are new
    and the ids to remove.
    """

    folder: Path
    metadata: dict[str, tuple[float, float, float, float]] = field(default_factory=dict)
    cached: dict[str, F64] = field(default_factory=dict)
    loaded: int = 0

    def start(self) -> None:
        table = yaml.safe_load((self.folder / "pointcloud_map_metadata.yaml").read_text())
        dx, dy = table.pop("x_resolution"), table.pop("y_resolution")
        there = {f.name: str(f) for f in (self.folder / "pointcloud_map.pcd").glob("*.pcd")}
        assert set(table) <= set(there)
        assert all(isinstance(v, int) for corner in table.values() for v in corner)
        self.metadata = {there[name]: (x, y, x + dx, y + dy) for name, (x, y) in table.items()}

    def ask(self, x: float, y: float, radius: float) -> None:
        wanted = {
            path: box
            for path, box in self.metadata.items()
            if box[0] - radius <= x <= box[2] + radius and box[1] - radius <= y <= box[3] + radius
        }
        for path in set(self.cached) - set(wanted):
            del self.cached[path]
        for path in set(wanted) - set(self.cached):
            self.cached[path] = PointCloud.from_path(path).numpy(("x", "y", "z")).astype(np.float64)
            self.loaded += 1

    def points(self) -> F64:
        return by_row(np.concatenate(list(self.cached.values())))


def by_row(points: F64) -> F64:
    return points[np.lexsort(points.T)]


class Server:
    """A client of a server whose newest version the test names."""

    def __init__(self) -> None:
        self.maps: list[PointMap] = []
        self.version: int | None = None

    def publish(self, points: F64) -> None:
        self.maps.append(map_from_points(points, map_id="m"))

    def manifest(self) -> SimpleNamespace:
        return SimpleNamespace(version=len(self.maps), map_id="m")

    def fetch(self) -> PointMap:
        self.version = len(self.maps)
        return self.maps[-1]


def test_a_running_autoware_sees_three_versions_and_a_rollback(tmp_path: Path) -> None:
    server, folder = Server(), tmp_path / "map"
    house = np.random.default_rng(4).uniform([5, 5, 0], [9, 9, 3], (200, 3)).astype(np.float32).astype(np.float64)
    second = np.concatenate([STREET, house])
    third = second[~((second[:, :2] > -15) & (second[:, :2] < -5)).all(axis=1)]
    loader = Loader(folder)
    versions = (STREET, second, third, STREET)
    changed_tiles = (None, 1, 1, 2)
    for points, changed in zip(versions, changed_tiles, strict=True):
        old = dict(loader.metadata)
        server.publish(points)
        change = follow_once(server, folder, None, keep=3)  # type: ignore[arg-type]
        assert change is not None
        assert follow_once(server, folder, None, keep=3) is None  # type: ignore[arg-type]
        for path in old:
            assert Path(path).is_file()  # a loader that goes by the older metadata loses nothing
        before = loader.loaded
        loader.start()
        loader.ask(0.0, 0.0, 100.0)
        assert np.array_equal(
            loader.points(), by_row(all_points(server.maps[-1]).astype(np.float32).astype(np.float64))
        )
        if changed is not None:
            assert loader.loaded - before == changed  # only what changed is loaded again
    assert change is not None
    assert change.written == 0  # what the rollback needs was kept


def test_tiles_older_than_kept_are_deleted_and_strangers_stay(tmp_path: Path) -> None:
    folder = tmp_path / "map"
    for version in range(5):
        moved = STREET + np.array([0.0, 0.0, 0.1 * version])
        change = lay_version(folder, Cloud(moved), version, keep=1)
        (folder / "pointcloud_map.pcd" / "notes.pcd").write_text("mine")
    assert change.deleted == change.tiles
    assert len(list((folder / "pointcloud_map.pcd").glob("*_*.pcd"))) == 2 * change.tiles
    assert (folder / "pointcloud_map.pcd" / "notes.pcd").exists()
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "pointcloud_map_metadata.yaml").write_text("x_resolution: 20\n")
    with pytest.raises(MapvoteError, match="did not make"):
        lay_version(tmp_path / "theirs", Cloud(STREET), 1)


def test_the_metadata_never_names_a_tile_that_is_not_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "map"
    lay_version(folder, Cloud(STREET), 1)
    good = (folder / "pointcloud_map_metadata.yaml").read_bytes()
    import mapvote.formats.maps.autoware as live

    written: list[Path] = []

    def fails(path: Path, *rest: object) -> None:
        written.append(path)
        if len(written) == 3:
            raise OSError(28, "No space left on device")
        path.write_bytes(b"part")

    monkeypatch.setattr(live, "save_pcd", fails)
    with pytest.raises(MapvoteError, match="No space left"):
        lay_version(folder, Cloud(STREET + 1.0), 2)
    assert (folder / "pointcloud_map_metadata.yaml").read_bytes() == good
    loader = Loader(folder)
    loader.start()
    loader.ask(0.0, 0.0, 100.0)
    assert np.array_equal(loader.points(), by_row(STREET))
