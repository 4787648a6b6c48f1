"""Every format, listed once: how it is recognised, read and written. A new one is a file of its own and a line here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from mapvote.core.types import Drive
from mapvote.formats.drives.datasets import (
    BOREAS,
    MULRAN,
    NEWER_COLLEGE,
    Dataset,
    is_kitti_raw,
    is_nuscenes,
    is_oxford,
    open_kitti_raw,
    open_nuscenes,
    open_oxford,
)
from mapvote.formats.drives.kitti import is_kitti_folder, open_kitti
from mapvote.formats.drives.options import DriveOptions
from mapvote.formats.drives.rosbag import is_rosbag, open_rosbag
from mapvote.formats.drives.scan_folder import is_cloud_scans, is_pcd_drive, open_cloud_scans, open_pcd_drive
from mapvote.formats.maps.autoware import (
    is_autoware,
    is_autoware_default,
    stream_autoware,
    stream_autoware_default,
    write_autoware,
)
from mapvote.formats.maps.cloud import Cloud, CloudPieces
from mapvote.formats.maps.e57 import is_e57, stream_e57
from mapvote.formats.maps.las import is_las, stream_las, write_las
from mapvote.formats.maps.pcd import is_pcd, is_pcd_tiles, stream_pcd, stream_pcd_tiles, write_pcd
from mapvote.formats.maps.ply import is_ply, stream_ply, write_ply


@dataclass(frozen=True, slots=True)
class DriveFormat:
    """A layout of recorded drives."""

    recognised: Callable[[Path], bool]
    """By what lies at the path; opens no scan."""
    open: Callable[[Path, DriveOptions], Drive]


@dataclass(frozen=True, slots=True)
class MapFormat:
    """A format that holds a map's points."""

    recognised: Callable[[Path], bool]
    stream: Callable[[Path], Iterator[Cloud]]
    """Piece by piece, where the format allows it: for maps larger than memory."""


@dataclass(frozen=True, slots=True)
class MapWriter:
    """What ``mapvote export`` writes under a suffix."""

    name: str
    write: Callable[[Path, CloudPieces], None]
    """Whole or not at all."""
    classes: bool = False
    """Whether the format has a place for ASPRS classes."""


DRIVES: dict[str, DriveFormat | Dataset] = {
    "KITTI drive folder": DriveFormat(is_kitti_folder, open_kitti),
    "KITTI raw or KITTI-360 recording": DriveFormat(is_kitti_raw, open_kitti_raw),
    "nuScenes": DriveFormat(is_nuscenes, open_nuscenes),
    "Boreas sequence": BOREAS,
    "MulRan sequence": MULRAN,
    "Newer College experiment": NEWER_COLLEGE,
    "Oxford RobotCar traversal": DriveFormat(is_oxford, open_oxford),
    "ROS bag": DriveFormat(is_rosbag, open_rosbag),
    "folder of PCD scans": DriveFormat(is_pcd_drive, open_pcd_drive),
    "folder of PLY, LAS, npy or bin scans": DriveFormat(is_cloud_scans, open_cloud_scans),
}
"""In the order in which they are tried."""

MAPS: dict[str, MapFormat] = {
    "Autoware tile folder": MapFormat(is_autoware, stream_autoware),
    "Autoware default folder": MapFormat(is_autoware_default, stream_autoware_default),
    "PCD file": MapFormat(is_pcd, stream_pcd),
    "folder of PCD tiles X_Y.pcd": MapFormat(is_pcd_tiles, stream_pcd_tiles),
    "LAS or LAZ file": MapFormat(is_las, stream_las),
    "PLY file": MapFormat(is_ply, stream_ply),
    "E57 file": MapFormat(is_e57, stream_e57),
}
"""Maps that are only points, in the order in which they are tried."""

WRITERS: dict[str, MapWriter] = {
    ".pcd": MapWriter("PCD file", write_pcd),
    ".las": MapWriter("LAS file", write_las, classes=True),
    ".laz": MapWriter("LAZ file", write_las, classes=True),
    ".ply": MapWriter("PLY file", write_ply),
    "": MapWriter("Autoware tile folder", write_autoware),
}
"""By the suffix of the path; a folder has none."""
