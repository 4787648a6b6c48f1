"""Whatever bytes lie in a file, reading it gives a value or one MapvoteError; never another exception."""

from __future__ import annotations

import contextlib
import shutil
import struct
import subprocess
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from live_server import mapvote
from mapvote.core.point_map import map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import MapvoteError
from mapvote.formats import DriveWriter, export_map, open_drive, read_map, write_map
from mapvote.formats.maps.cloud import Cloud
from mapvote.formats.maps.las import write_las

TR = "0 -1 0 0 0 0 -1 0 1 0 0 0"


def build(folder: Path) -> Path:
    """One of everything."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-30, -30, -1], [30, 30, 5], (60, 3))
    point_map = map_from_points(points, georeference={"crs": "EPSG:32654"})
    for name in ("m.pcd", "m.ply", "m.las", "m.laz", "autoware"):
        export_map(point_map, folder / name)
    write_map(point_map, folder / "map")
    writer = DriveWriter(folder / "drive", "v", SENSORS["hdl32e"], start_ns=0).open()
    for i in range(3):
        writer.write_scan(i, points.astype(np.float32))
    T = np.tile(np.eye(4), (3, 1, 1))
    writer.close(np.arange(3) * 10**8, T)
    (folder / "drive" / "calib.txt").write_text(f"P0: {TR}\nTr: {TR}\n")
    (folder / "drive" / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    return folder


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("good"))


def read_drive(path: Path) -> None:
    drive = open_drive(path, prior="poses.txt")
    open_drive(path)
    list(drive)


def read_any_map(path: Path) -> None:
    read_map(path)


TARGETS: list[tuple[str, str, Callable[[Path], None]]] = [
    ("m.pcd", "m.pcd", read_any_map),
    ("m.ply", "m.ply", read_any_map),
    ("m.las", "m.las", read_any_map),
    ("autoware", "autoware/pointcloud_map_metadata.yaml", read_any_map),
    ("map", "map/manifest.json", read_any_map),
    ("map", "map/planes/*", read_any_map),
    ("drive", "drive/times.txt", read_drive),
    ("drive", "drive/prior.txt", read_drive),
    ("drive", "drive/poses.txt", read_drive),
    ("drive", "drive/calib.txt", read_drive),
    ("drive", "drive/drive.toml", read_drive),
    ("drive", "drive/velodyne/000001.bin", read_drive),
]


@pytest.mark.parametrize(("what", "file", "read"), TARGETS, ids=[t[1] for t in TARGETS])
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_bytes_are_a_value_or_one_clear_error(
    tmp_path: Path, good: Path, what: str, file: str, read: Callable[[Path], None], data: st.DataObject
) -> None:
    shutil.rmtree(tmp_path / "x", ignore_errors=True)
    shutil.copytree(good, tmp_path / "x")
    target = min((tmp_path / "x").glob(file))
    content = bytearray(target.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        kind = data.draw(st.sampled_from(["flip", "cut", "insert"]))
        if kind == "flip":
            content[at] = data.draw(st.integers(0, 255))
        elif kind == "cut":
            del content[at : at + data.draw(st.integers(1, 40))]
        else:
            content[at:at] = data.draw(st.binary(min_size=1, max_size=8))
        content = content or bytearray(b"\n")
    target.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy's and laspy's opinions on garbage
        with contextlib.suppress(MapvoteError):
            read(tmp_path / "x" / what)


def put(at: int, kind: str, value: int) -> Callable[[bytearray], None]:
    return lambda content: struct.pack_into(kind, content, at, value)


def damage_count(content: bytearray) -> None:
    """Four billion chunks where there is one."""
    (table,) = struct.unpack_from("<q", content, POINTS)
    struct.pack_into("<I", content, table + 4, 2**32 - 1)


def damage_table(content: bytearray) -> None:
    """Another length of the one chunk: random bytes where the compressed chunk table is."""
    content[-6:] = b"\x5a\x13\xc7\x08\xee\x41"


LASZIP = 429  # the LASzip record in a LAS 1.4 header without other records: compressor, ..., chunk size, items
POINTS = 469
DAMAGES: dict[str, Callable[[bytearray], None]] = {
    "cut": lambda content: content.__delitem__(slice(-200, None)),
    "flipped": lambda content: content.__setitem__(slice(900, 960), bytes(60)),
    "panics: a chunk for every point": put(LASZIP + 12, "<I", 1),
    "panics: no items": put(LASZIP + 32, "<H", 0),
    "aborts: four billion chunks": lambda content: put(
        struct.unpack_from("<q", content, POINTS)[0] + 4, "<I", 2**32 - 1
    )(content),
    "may abort: chunk table": damage_table,
}


@pytest.fixture(scope="module")
def laz(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A LAZ file of 3,000 points."""
    path = tmp_path_factory.mktemp("laz") / "good.laz"
    write_las(path, Cloud(np.random.default_rng(0).uniform(-30, 30, (3000, 3))))
    content = path.read_bytes()
    assert struct.unpack_from("<I", content, 96)[0] == POINTS
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


@pytest.mark.parametrize("verb", ["info", "import"])
def test_the_command_line_says_one_line_about_a_damaged_laz_file(tmp_path: Path, laz: bytes, verb: str) -> None:
    content = bytearray(laz)
    damage_count(content)
    path = tmp_path / "bad.laz"
    path.write_bytes(content)
    out = [tmp_path / "out"] if verb == "import" else []
    done = subprocess.run(mapvote(verb, path, *out), capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1
    assert len(done.stderr.strip().splitlines()) == 1
    assert "bad.laz" in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_file_that_may_not_be_read_or_is_gone(tmp_path: Path, good: Path) -> None:
    shutil.copytree(good / "drive", tmp_path / "d")
    for name in ("times.txt", "prior.txt", "drive.toml", "calib.txt"):
        (tmp_path / "d" / name).unlink()
        (tmp_path / "d" / name).mkdir()
    with pytest.raises(MapvoteError):
        open_drive(tmp_path / "d", rate_hz=None)
