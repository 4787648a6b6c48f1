"""Writes one drive in every format that holds fields of points: PCD, PLY, LAS, LAZ, npy, bin, bags, CustomMsg."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import tomli_w
from numpy.typing import NDArray

from bag_recorder import CLOUD, Recorder
from mapvote.core.types import F64, I64, Scan
from mapvote.formats.drives.scan_folder import write_poses

Tables = list[NDArray[np.void]]
"""Points (n,) of each scan with x, y, z and other fields."""
LIVOX = "livox_ros_driver2/msg/CustomMsg"


def with_times(scan: Scan, field: str, of: Callable[[F64], NDArray[np.generic]]) -> NDArray[np.void]:
    """The points of a scan with x, y, z, intensity and one field more: ``of`` their times after the stamp, seconds."""
    assert scan.time_s is not None
    values = of(scan.time_s.astype(np.float64))
    kinds = [(name, "<f4") for name in ("x", "y", "z", "intensity")]
    table = np.zeros(len(scan.points), dtype=[*kinds, (field, values.dtype)])
    table["x"], table["y"], table["z"] = scan.points.T
    if "intensity" in scan.fields:
        table["intensity"] = scan.fields["intensity"]
    table[field] = values
    return table


def write_pcd(file: Path, table: NDArray[np.void]) -> None:
    """Binary, as PCL writes it."""
    kinds = [table.dtype[name] for name in table.dtype.names or ()]
    lines = (
        "VERSION .7",
        f"FIELDS {' '.join(table.dtype.names or ())}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {len(table)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(table)}\nDATA binary\n",
    )
    file.write_bytes("\n".join(lines).encode() + table.tobytes())


def write_ply(file: Path, table: NDArray[np.void]) -> None:
    """PLY knows no 64-bit integers: they are written as doubles."""
    import plyfile

    names = table.dtype.names or ()
    kinds = [(name, "<f8" if table.dtype[name].str[1:] in ("i8", "u8") else table.dtype[name]) for name in names]
    plyfile.PlyData([plyfile.PlyElement.describe(table.astype(kinds), "vertex")]).write(file)


def write_las(file: Path, table: NDArray[np.void]) -> None:
    """x, y, z to a hundredth of a millimetre; other fields as extra bytes, gps_time in its own place."""
    import laspy

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 1e-5)
    others = [name for name in table.dtype.names or () if name not in ("x", "y", "z", "intensity", "gps_time")]
    header.add_extra_dims([laspy.ExtraBytesParams(name, table.dtype[name]) for name in others])
    las = laspy.LasData(header)
    las.x, las.y, las.z = table["x"], table["y"], table["z"]
    for name in [*others, *({"gps_time"} & set(table.dtype.names or ()))]:
        las[name] = table[name]
    las.write(str(file))


def write_bin(file: Path, table: NDArray[np.void]) -> None:
    """Columns of float32."""
    np.column_stack([table[name] for name in table.dtype.names or ()]).astype("<f4").tofile(file)


WRITERS: dict[str, Callable[[Path, NDArray[np.void]], None]] = {
    ".pcd": write_pcd,
    ".ply": write_ply,
    ".las": write_las,
    ".laz": write_las,
    ".npy": lambda file, table: np.save(file, table),
    ".bin": write_bin,
}


def livox_message(table: NDArray[np.void], stamp_ns: int, frame: str = "livox") -> bytes:
    """A CustomMsg in CDR of x, y, z, offset_time (ns), reflectivity, tag, line: as the driver's definition has them."""
    name = frame.encode() + b"\0"
    head = b"\0\1\0\0" + struct.pack("<III", stamp_ns // 10**9, stamp_ns % 10**9, len(name)) + name
    head += b"\0" * (-(len(head) - 4) % 8)
    head += struct.pack("<QIB3xI", stamp_ns, len(table), 0, len(table))
    points = np.zeros(len(table), dtype=[("t", "<u4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rest", "u1", 4)])
    for ours, theirs in (("t", "offset_time"), ("x", "x"), ("y", "y"), ("z", "z")):
        points[ours] = table[theirs]
    return head + points.tobytes()[:-1]


def write_bag(path: Path, tables: Tables, stamps_ns: I64, T_map_lidar: F64, *, livox: bool = False) -> Path:
    """One topic of clouds, /points, and poses at /odom."""
    bag = Recorder(path)
    if livox:
        bag.register(LIVOX_TYPES)
    for table, stamp_ns, T in zip(tables, stamps_ns.tolist(), T_map_lidar, strict=True):
        bag.pose("/odom", stamp_ns, T, stamp_ns)
        if livox:
            bag.write_raw("/points", LIVOX, stamp_ns, livox_message(table, stamp_ns))
        else:
            bag.write("/points", CLOUD, stamp_ns, bag.cloud_of(table, stamp_ns))
    bag.bag.close()
    return path


LIVOX_TYPES = {
    "livox_ros_driver2/msg/CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\n"
    "uint8 tag\nuint8 line",
    LIVOX: "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "livox_ros_driver2/CustomPoint[] points",
}


def write_drive(path: Path, suffix: str, tables: Tables, stamps_ns: I64, T_map_lidar: F64, **toml: object) -> Path:
    """The drive as a folder of files that end so, or as a "bag" or "livox" bag; ``toml``: keys of drive.toml."""
    if suffix in ("bag", "livox"):
        write_bag(path, tables, stamps_ns, T_map_lidar, livox=suffix == "livox")
        toml.setdefault("prior", "/odom")
    else:
        path.mkdir(parents=True)
        for i, table in enumerate(tables):
            WRITERS[suffix](path / f"{i:06d}{suffix}", table)
        write_poses(path / "prior.txt", T_map_lidar)
        lines = [f"{ns // 10**9}.{ns % 10**9:09d}\n" for ns in stamps_ns.tolist()]
        (path / "times.txt").write_text("".join(lines))
    if suffix == ".bin":
        toml.setdefault("columns", ",".join(tables[0].dtype.names or ()))
    (path / "drive.toml").write_text(tomli_w.dumps(toml))
    return path
