"""Five hundred damaged files of every format: a value or one clear error; no crash, no hang, and memory bounded."""

from __future__ import annotations

import re
import resource
import shutil
import signal
import struct
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pye57
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from bag_recorder import CLOUD, START, Recorder
from hand_made import save_pcd
from mapvote.core.point_map import map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import MapvoteError
from mapvote.formats import DriveWriter, open_drive, read_map, stream_cloud, write_map
from mapvote.formats.drives.trajectory import read_trajectory
from mapvote.formats.geo.frame import read_projector
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


def camera_drive(path: Path) -> None:
    open_drive(path, prior="poses.txt")


def map_points(path: Path) -> None:
    list(stream_cloud(path))


@dataclass(frozen=True)
class Target:
    """One file of a sound map or drive, to be damaged, and what reads it."""

    file: str
    read: Callable[[Path], object]
    what: str = ""
    """Readers under test; the file itself if empty."""
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
    Target("drive/prior.txt", drive, "drive", times=15),
    Target("drive/poses.txt", camera_drive, "drive", times=15),
    Target("drive/calib.txt", camera_drive, "drive", times=15),
    Target("npy/000001.npy", drive, "npy"),
    Target("t.tum", read_trajectory),
    Target("t.csv", read_trajectory),
    Target("m.mcap", drive, times=25),
    Target("bag2/bag2.db3", drive, "bag2", times=15),
    Target("bag2/metadata.yaml", drive, "bag2", times=15),
    Target("b.bag", drive, times=25),
]


def _bags(folder: Path) -> None:
    for path, plugin in ((folder / "bag2", StoragePlugin.SQLITE3), (folder / "mcap", StoragePlugin.MCAP)):
        bag = Recorder(path, plugin)
        for i in range(3):
            bag.cloud("/points", "lidar", START + i * 10**8, POINTS)
        bag.bag.close()
    shutil.move(next((folder / "mcap").glob("*.mcap")), folder / "m.mcap")
    old, raw = get_typestore(Stores.ROS1_NOETIC), np.ascontiguousarray(POINTS, dtype="<f4").view(np.uint8).ravel()
    head1, cloud1 = old.types["std_msgs/msg/Header"], old.types[CLOUD]
    field1 = [old.types["sensor_msgs/msg/PointField"](name, 4 * i, 7, 1) for i, name in enumerate("xyz")]
    with Writer1(folder / "b.bag") as bag1:
        topic1 = bag1.add_connection("/points", CLOUD, typestore=old)
        for i in range(3):
            stamp = old.types["builtin_interfaces/msg/Time"](1_700_000_000, i * 100_000_000)
            content = cloud1(head1(i, stamp, "lidar"), 1, len(POINTS), field1, False, 12, raw.size, raw, True)
            bag1.write(topic1, 1_700_000_000 * 10**9 + i * 10**8, old.serialize_ros1(content, CLOUD))


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
    writer.close(np.arange(3) * 10**8, np.tile(np.eye(4), (3, 1, 1)))
    (folder / "drive" / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    (folder / "drive" / "calib.txt").write_text("P0: 0 -1 0\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
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


def read_damaged(folder: Path, good: Path, target: Target, times: int, seconds: int = 0) -> None:
    """``seconds``: for each file; without a limit if 0."""
    what = Path(target.what or target.file)
    shutil.copytree(good / what, folder / what) if (good / what).is_dir() else shutil.copy(good / what, folder)
    file = min(good.glob(target.file))
    content = file.read_bytes()
    for seed in range(times):
        (folder / file.relative_to(good)).write_bytes(damaged(content, np.random.default_rng(seed)))
        signal.alarm(seconds)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy's and laspy's opinions on garbage
            said = what_it_says(target, folder / what)
        assert "\n" not in said, f"seed {seed}: {said}"
        assert not said or str(folder) in said, f"seed {seed} names no file: {said}"
        signal.alarm(0)


EVERY = pytest.mark.parametrize("target", TARGETS, ids=[target.file for target in TARGETS])


@EVERY
def test_a_damaged_file_is_a_value_or_one_clear_error(tmp_path: Path, good: Path, target: Target) -> None:
    read_damaged(tmp_path, good, target, 3)


@pytest.mark.slow
@EVERY
def test_five_hundred_damaged_files_cost_neither_time_nor_memory(
    tmp_path: Path, good: Path, bounded: None, target: Target
) -> None:
    read_damaged(tmp_path, good, target, target.times, SECONDS)


def put(at: int, kind: str, value: int) -> Callable[[bytearray], None]:
    return lambda content: struct.pack_into(kind, content, at, value)


def many_chunks(content: bytearray) -> None:
    """Four billion where there is one."""
    put(struct.unpack_from("<q", content, LAZ_START)[0] + 4, "<I", 2**32 - 1)(content)


LASZIP = 429  # the LASzip record in a LAS 1.4 header without other records: compressor, ..., chunk size, items
LAZ_START = 469
DAMAGES: dict[str, Callable[[bytearray], None]] = {
    "cut": lambda content: content.__delitem__(slice(-200, None)),
    "flipped": lambda content: content.__setitem__(slice(900, 960), bytes(60)),
    "panics: a chunk for every point": put(LASZIP + 12, "<I", 1),
    "panics: no items": put(LASZIP + 32, "<H", 0),
    "aborts: four billion chunks": many_chunks,
    "may abort: another length of the one chunk": lambda content: content.__setitem__(
        slice(-6, None), b"\x5a\x13\xc7\x08\xee\x41"
    ),
}


@pytest.fixture(scope="module")
def laz(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A LAZ file of 3,000 points."""
    path = tmp_path_factory.mktemp("laz") / "good.laz"
    write_las(path, Cloud(np.random.default_rng(0).uniform(-30, 30, (3000, 3))))
    content = path.read_bytes()
    assert struct.unpack_from("<I", content, 96)[0] == LAZ_START
    return content


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_a_damaged_laz_file_is_one_clear_error(tmp_path: Path, laz: bytes, damage: Callable[[bytearray], None]) -> None:
    """lazrs panics on some, and aborts the process that reads it on others: it reads apart."""
    content = bytearray(laz)
    damage(content)
    path = tmp_path / "bad.laz"
    path.write_bytes(content)
    with pytest.raises(MapvoteError, match=r"bad\.laz: not a whole LAS or LAZ file .*copy"):
        read_map(path)


def test_a_file_that_may_not_be_read_or_is_gone(tmp_path: Path, good: Path) -> None:
    shutil.copytree(good / "drive", tmp_path / "d")
    for name in ("times.txt", "prior.txt", "drive.toml", "calib.txt"):
        (tmp_path / "d" / name).unlink()
        (tmp_path / "d" / name).mkdir()
    with pytest.raises(MapvoteError):
        open_drive(tmp_path / "d", rate_hz=None)
