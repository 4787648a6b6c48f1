"""Names that stand in files open nothing that nobody handed over: ten thousand hostile names in every document that
names files. An audit hook sees every file that is opened."""

from __future__ import annotations

import json
import os
import random
import re
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest
import yaml

from hand_made import save_pcd
from mapvote.client.map_client import MapClient
from mapvote.codec.manifest import Manifest, TileHashes, digests_of, shown
from mapvote.core.point_map import map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import MapvoteError
from mapvote.formats import DriveWriter, open_drive, read_map, write_map
from mapvote.formats.listing import below, plain_name
from mapvote.formats.maps.autoware import METADATA, write_autoware
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.mapvote_folder import FolderManifest

POINTS = np.random.default_rng(0).uniform([-30, -30, -1], [30, 30, 5], (80, 3))
SECRET = "secret.pcd"
PARTS = [
    "..",
    ".",
    "",
    "/",
    "\\",
    "~",
    SECRET,
    "dev",
    "zero",
    "etc",
    "passwd",
    "pipe",
    "a",
    "\0",
    "\n",
    "‥",
    "%2e%2e",
    "C:",
]
SECONDS = 10
FORBIDDEN = re.compile(r"^/(dev/(?!null|urandom|random)|etc/passwd)|secret|pipe")
opened: list[str] | None = None


def _listen(event: str, given: tuple[object, ...]) -> None:
    if opened is not None and event == "open" and isinstance(given[0], str | bytes):
        opened.append(os.fsdecode(given[0]))


sys.addaudithook(_listen)


@contextmanager
def watched() -> Iterator[list[str]]:
    """Every file that is opened within, which may last so many seconds."""
    global opened
    found: list[str] = []
    opened = found
    signal.signal(signal.SIGALRM, lambda *_: pytest.fail(f"hangs after it opened {found[-1:]}"))
    signal.alarm(SECONDS)
    try:
        yield found
    finally:
        signal.alarm(0)
        opened = None


def hostile(rng: random.Random, outside: Path) -> str:
    """A name that leads elsewhere, or is none."""
    kind = rng.randrange(5)
    if kind == 0:
        return "../" * rng.randint(1, 5) + rng.choice([SECRET, SECRET, f"outside/{SECRET}", "etc/passwd", "pipe"])
    if kind == 1:
        return rng.choice(["/dev/zero", "/dev/stdin", "/etc/passwd", str(outside / SECRET), str(outside / "pipe")])
    if kind == 2:
        return rng.choice(["pipe", "samples/LIDAR_TOP/pipe", "A" * 64, "a" * 63, "a" * 64 + "\n", "a" * 300])
    joined = rng.choice(["", "/", "\\"])
    return joined.join(rng.choice(PARTS) for _ in range(rng.randint(1, 6)))


def in_map_folder(folder: Path, name: str, rng: random.Random) -> None:
    file = folder / "manifest.json"
    manifest = json.loads(file.read_text())
    tiles = {key: TileHashes(**hashes) for key, hashes in manifest["tiles"].items()}
    if rng.random() < 0.2:
        tiles[name] = next(iter(tiles.values()))
    else:
        key = rng.choice(sorted(tiles))
        tiles[key] = msgspec.structs.replace(tiles[key], **{rng.choice(["points", "ground", "free"]): name})
    manifest["tiles"] = json.loads(msgspec.json.encode(tiles))
    manifest["digest"], manifest["fields_digest"] = shown(*digests_of(tiles.items()))
    write(file, json.dumps(manifest))
    read_map(folder)


def in_autoware(folder: Path, name: str, rng: random.Random) -> None:
    write(folder / METADATA, yaml.safe_dump({"x_resolution": 20.0, "y_resolution": 20.0, name: [0, 0]}))
    read_map(folder)


def in_bag(folder: Path, name: str, rng: random.Random) -> None:
    about = {"storage_identifier": rng.choice(["mcap", "sqlite3"]), "relative_file_paths": [name], "version": 5}
    about |= {"topics_with_message_count": [], "compression_mode": rng.choice(["", "file"])}
    write(folder / "metadata.yaml", yaml.safe_dump({"rosbag2_bagfile_information": about}))
    open_drive(folder)


def in_nuscenes(folder: Path, name: str, rng: random.Random) -> None:
    scan: dict[str, object] = {"token": "d", "sample_token": "s", "ego_pose_token": "p", "calibrated_sensor_token": "c"}
    scan |= {"timestamp": 1, "filename": rng.choice([name, f"samples/LIDAR_TOP/{name}", f"{name}/LIDAR_TOP"])}
    pose = {"translation": [0, 0, 0], "rotation": [1, 0, 0, 0]}
    tables = {
        "scene": [{"token": "sc", "name": "scene"}],
        "sample": [{"token": "s", "scene_token": "sc"}],
        "sample_data": [scan],
        "ego_pose": [pose | {"token": "p"}],
        "calibrated_sensor": [pose | {"token": "c"}],
    }
    for table, rows in tables.items():
        write(folder / "v1.0-mini" / f"{table}.json", json.dumps(rows))
    for i in range(len(open_drive(folder))):
        open_drive(folder).read_scan(i)


def in_drive_toml(folder: Path, name: str, rng: random.Random) -> None:
    write(folder / "drive.toml", f"{rng.choice(['prior', 'prior', 'topic', 'sensor'])} = {json.dumps(name)}\n")
    open_drive(folder, rate_hz=10.0)


def in_cache(folder: Path, name: str, rng: random.Random) -> None:
    with MapClient("http://127.0.0.1:9", home=folder, attempts=1) as client:
        kept = Manifest(
            map_id="m", version=1, lattice=map_from_points(POINTS).lattice, georeference={}, digest="", removed=[],
            tiles={"0,0": TileHashes(*(rng.choice([name, "a" * 64]) for _ in range(3)))},
        )  # fmt: skip
        client._kept_manifest.parent.mkdir(parents=True, exist_ok=True)
        client._kept_manifest.write_bytes(msgspec.json.encode(kept))
        client.fetch_kept()


def write(file: Path, text: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")


READERS: list[Callable[[Path, str, random.Random], None]] = [
    in_map_folder, in_autoware, in_bag, in_nuscenes, in_drive_toml, in_cache,
]  # fmt: skip


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    """A folder of each kind, each with a pipe in it, and a secret beside."""
    home = tmp_path / "handed" / "over"
    home.mkdir(parents=True)
    write_map(map_from_points(POINTS), home / "in_map_folder")
    write_autoware(home / "in_autoware", Cloud(POINTS))
    writer = DriveWriter(home / "in_drive_toml", "v", SENSORS["hdl32e"], start_ns=0).open()
    for i in range(2):
        writer.write_scan(i, POINTS.astype(np.float32))
    writer.close(np.arange(2) * 10**8, np.tile(np.eye(4), (2, 1, 1)))
    for name in ("in_bag", "in_cache/planes", "in_nuscenes/samples/LIDAR_TOP"):
        (home / name).mkdir(parents=True)
    for name in ("in_map_folder/planes", "in_autoware", "in_bag", "in_cache/planes", "in_nuscenes/samples/LIDAR_TOP"):
        os.mkfifo(home / name / "pipe")
    for place in (tmp_path, tmp_path / "handed", home, tmp_path / "outside"):
        place.mkdir(exist_ok=True)
        save_pcd(place / SECRET, POINTS.astype(np.float32), "binary")
    os.mkfifo(tmp_path / "outside" / "pipe")
    return home


def open_nothing_else(folders: Path, cases: int, seed: int) -> None:
    rng = random.Random(seed)
    outside = folders.parents[1] / "outside"
    for case in range(cases):
        reader = READERS[case % len(READERS)]
        name = hostile(rng, outside)
        with watched() as found:
            try:
                reader(folders / reader.__name__, name, rng)
            except MapvoteError:
                pass
            except Exception as error:
                raise AssertionError(f"{reader.__name__}, {name!r}: {error!r}") from error
        wrong = [path for path in found if FORBIDDEN.search(path.removeprefix(str(folders.parents[1])))]
        assert not wrong, f"{reader.__name__}, {name!r} opened {wrong}"


@pytest.mark.slow
def test_no_name_in_a_file_opens_anything_else(folders: Path) -> None:
    open_nothing_else(folders, 300, 1)


@pytest.mark.slow
def test_none_of_thousands_of_names_opens_anything_else(folders: Path) -> None:
    """`NAMES=10000 pytest -m slow` tries so many."""
    open_nothing_else(folders, int(os.environ.get("NAMES", "1000")), 2)


def test_a_map_folder_with_a_pipe_or_a_device_for_a_plane_is_refused(tmp_path: Path) -> None:
    write_map(map_from_points(POINTS), tmp_path / "map")
    manifest = msgspec.json.decode((tmp_path / "map" / "manifest.json").read_bytes(), type=FolderManifest)
    plane = tmp_path / "map" / "planes" / next(iter(manifest.tiles.values())).points
    for make in (os.mkfifo, lambda place: os.symlink("/dev/zero", place)):
        plane.unlink()
        make(plane)
        with watched(), pytest.raises(MapvoteError, match="no regular file"):
            read_map(tmp_path / "map")


@pytest.mark.parametrize("name", ["..", "../x", "/x", "a/../b", "a//b", "a\\b", "", "a\0", "C:x", "x" * 256])
def test_a_name_that_leads_elsewhere_is_refused(name: str) -> None:
    with pytest.raises(MapvoteError, match="not a plain file name"):
        below(Path("drive"), name, Path("drive/metadata.yaml"))


@pytest.mark.parametrize("name", ["0_0.pcd", "n015-2018-07-24__LIDAR_TOP__1.pcd.bin", "Straße 1.pcd", "..a", "a.."])
def test_an_ordinary_name_is_taken(name: str) -> None:
    assert plain_name(name, Path("m")) == name
    assert below(Path("d"), f"lidar/{name}", Path("m")) == Path("d/lidar") / name
