"""Five hundred damaged files of every format: a value or one clear error; no crash, no hang, and memory bounded."""

from __future__ import annotations

import re
import resource
import shutil
import signal
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pye57
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from hand_made import save_pcd
from mapvote.core.point_map import map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import MapvoteError
from mapvote.formats import DriveWriter, open_drive, read_map, stream_cloud, write_map
from mapvote.formats.drives.trajectory import read_trajectory
from mapvote.formats.geo.projector import read_projector
from mapvote.formats.maps.autoware import write_autoware
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.las import write_las
from mapvote.formats.maps.ply import write_ply

POINTS = np.random.default_rng(0).uniform([-30, -30, -1], [30, 30, 5], (80, 3))
GIANT = [b"99999999999", b"-1", b"nan", b"0", b"18446744073709551615"]
SECONDS = 30
MEMORY = 2_000_000_000


def drive(path: Path) -> None:
    for scan in open_drive(path, rate_hz=10.0):
        assert np.isfinite(scan.points).all()


def map_points(path: Path) -> None:
    list(stream_cloud(path))


@dataclass(frozen=True)
class Target:
    """One file of a sound map or drive, to be damaged, and what reads it."""

    file: str
    read: Callable[[Path], object]
    what: str = ""
    """What is read; the file itself if empty."""
    times: int = 25


TARGETS = [
    Target("ascii.pcd", map_points),
    Target("binary.pcd", map_points, times=30),
    Target("packed.pcd", map_points, times=30),
    Target("m.ply", map_points, times=30),
    Target("m.las", map_points, times=40),
    Target("m.laz", map_points, times=8),
    Target("m.e57", map_points, times=40),
    Target("autoware/pointcloud_map_metadata.yaml", map_points, "autoware"),
    Target("map_projector_info.yaml", lambda path: read_projector(str(path))),
    Target("map/manifest.json", read_map, "map"),
    Target("map/planes/*", read_map, "map"),
    Target("drive/velodyne/000001.bin", drive, "drive"),
    Target("drive/drive.toml", drive, "drive"),
    Target("drive/times.txt", drive, "drive"),
    Target("npy/000001.npy", drive, "npy"),
    Target("t.tum", read_trajectory),
    Target("t.csv", read_trajectory),
    Target("m.mcap", drive, times=25),
    Target("bag2/bag2.db3", drive, "bag2", times=15),
    Target("bag2/metadata.yaml", drive, "bag2", times=15),
    Target("b.bag", drive, times=25),
]


def test_there_are_five_hundred() -> None:
    assert sum(target.times for target in TARGETS) >= 500


def _bags(folder: Path) -> None:
    store, cloud_type = get_typestore(Stores.ROS2_HUMBLE), "sensor_msgs/msg/PointCloud2"
    kinds = store.types
    head, time = kinds["std_msgs/msg/Header"], kinds["builtin_interfaces/msg/Time"]
    field, cloud = kinds["sensor_msgs/msg/PointField"], kinds["sensor_msgs/msg/PointCloud2"]
    fields = [field(name, 4 * i, 7, 1) for i, name in enumerate("xyz")]
    raw = np.ascontiguousarray(POINTS, dtype="<f4").view(np.uint8).ravel()

    def message(i: int) -> object:
        stamp = time(1_700_000_000, i * 100_000_000)
        return cloud(head(stamp, "lidar"), 1, len(POINTS), fields, False, 12, raw.size, raw, True)

    for path, plugin in ((folder / "bag2", StoragePlugin.SQLITE3), (folder / "mcap", StoragePlugin.MCAP)):
        with Writer(path, version=9, storage_plugin=plugin) as bag:
            topic = bag.add_connection("/points", cloud_type, typestore=store)
            for i in range(3):
                bag.write(topic, 1_700_000_000 * 10**9 + i * 10**8, store.serialize_cdr(message(i), cloud_type))
    shutil.move(next((folder / "mcap").glob("*.mcap")), folder / "m.mcap")
    old = get_typestore(Stores.ROS1_NOETIC)
    head1, cloud1 = old.types["std_msgs/msg/Header"], old.types[cloud_type]
    field1 = [old.types["sensor_msgs/msg/PointField"](name, 4 * i, 7, 1) for i, name in enumerate("xyz")]
    with Writer1(folder / "b.bag") as bag1:
        topic1 = bag1.add_connection("/points", cloud_type, typestore=old)
        for i in range(3):
            stamp = old.types["builtin_interfaces/msg/Time"](1_700_000_000, i * 100_000_000)
            content = cloud1(head1(i, stamp, "lidar"), 1, len(POINTS), field1, False, 12, raw.size, raw, True)
            bag1.write(topic1, 1_700_000_000 * 10**9 + i * 10**8, old.serialize_ros1(content, cloud_type))


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One sound file of everything."""
    folder = tmp_path_factory.mktemp("good")
    cloud = Cloud(POINTS)
    for name, encoding in (("ascii", "ascii"), ("binary", "binary"), ("packed", "binary_compressed")):
        save_pcd(folder / f"{name}.pcd", POINTS.astype(np.float32), encoding)
    write_ply(folder / "m.ply", cloud)
    write_las(folder / "m.las", cloud)
    write_las(folder / "m.laz", cloud)
    file = pye57.E57(str(folder / "m.e57"), mode="w")
    file.write_scan_raw({f"cartesian{a}": POINTS[:, i].copy() for i, a in enumerate("XYZ")})
    file.close()
    write_autoware(folder / "autoware", cloud)
    shutil.copy(folder / "autoware" / "map_projector_info.yaml", folder)
    write_map(map_from_points(POINTS), folder / "map")
    writer = DriveWriter(folder / "drive", "v", SENSORS["hdl32e"], start_ns=0).open()
    for i in range(3):
        writer.write_scan(i, POINTS.astype(np.float32))
    writer.close(np.arange(3) * 10**8)
    (folder / "npy").mkdir()
    for i in range(3):
        np.save(folder / "npy" / f"{i:06d}.npy", POINTS.astype(np.float32))
    (folder / "t.tum").write_text("".join(f"{i / 10} {i} 0 0 0 0 0 1\n" for i in range(5)))
    (folder / "t.csv").write_text("time,x,y,z,yaw\n" + "".join(f"{i / 10},{i},0,0,0.1\n" for i in range(5)))
    _bags(folder)
    return folder


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, changed near the start, changed anywhere, or with a count that has become gigantic."""
    out = bytearray(content)
    kind = rng.integers(5)
    if kind == 0:
        return bytes(out[: rng.integers(len(out))])
    if kind == 1:
        for at in rng.integers(0, min(len(out), 400), rng.integers(1, 6)):
            out[at] = rng.integers(256)
    elif kind == 2:
        for at in rng.integers(0, len(out), rng.integers(1, 20)):
            out[at] = rng.integers(256)
    elif kind == 3 and len(out) > 16:
        at = int(rng.integers(0, min(len(out), 500) - 8))
        wide = int(rng.choice([4, 8]))
        out[at : at + wide] = rng.choice([b"\xff" * 8, b"\xff\xff\xff\x7f" * 2, b"\0" * 8])[:wide].ljust(wide, b"\0")
    else:
        numbers = list(re.finditer(rb"\d+", bytes(out[:4000])))
        if numbers:
            where = numbers[int(rng.integers(len(numbers)))]
            out[where.start() : where.end()] = rng.choice(GIANT)
    return bytes(out) or b"\n"


def what_it_says(target: Target, path: Path) -> str:
    """ "", or the message of the one kind of error that users may see; any other error ends the test."""
    try:
        target.read(path)
    except MapvoteError as error:
        return str(error)
    return ""


@pytest.fixture
def bounded() -> Iterator[None]:
    """Any allocation far above what these files need fails, and so does waiting."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)

    def late(*_: object) -> None:
        raise AssertionError(f"hangs: still reading after {SECONDS} s")

    before = signal.signal(signal.SIGALRM, late)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, hard))
    yield
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS, ids=[target.file for target in TARGETS])
def test_a_damaged_file_is_a_value_or_one_clear_error(
    tmp_path: Path, good: Path, bounded: None, target: Target
) -> None:
    what = Path(target.what or target.file)
    shutil.copytree(good / what, tmp_path / what) if (good / what).is_dir() else shutil.copy(good / what, tmp_path)
    file = min(good.glob(target.file))
    content = file.read_bytes()
    for seed in range(target.times):
        (tmp_path / file.relative_to(good)).write_bytes(damaged(content, np.random.default_rng(seed)))
        signal.alarm(SECONDS)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy's and laspy's opinions on garbage
            said = what_it_says(target, tmp_path / what)
        assert "\n" not in said, f"seed {seed}: {said}"
        signal.alarm(0)
