"""Every format, listed once: how it is recognised, read and written. A new one is a file of its own and a line here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from mapvote.core.types import Drive
from mapvote.formats.drives import bag_files, datasets, rosbag, scan_folder
from mapvote.formats.drives.options import DriveOptions
from mapvote.formats.maps import autoware, copc, e57, las, pcd, ply
from mapvote.formats.maps.cloud import Cloud, CloudPieces


@dataclass(frozen=True, slots=True)
class DriveFormat:
    """A layout of recorded drives."""

    recognised: Callable[[Path], object]
    """Whether this format lies at the path: True, or its scans; opens no scan."""
    open: Callable[[Path, DriveOptions], Drive]


@dataclass(frozen=True, slots=True)
class MapFormat:
    """A format that holds a map's points."""

    recognised: Callable[[Path], bool]
    stream: Callable[[Path], Iterator[Cloud]]
    """Piece by piece, where the format allows it: for maps larger than memory."""


@dataclass(frozen=True, slots=True)
class MapWriter:
    """A format that ``mapvote export`` writes under a suffix."""

    name: str
    write: Callable[[Path, CloudPieces], None]
    """Whole or not at all."""
    classes: bool = False
    """Whether the format has a place for ASPRS classes."""
    single: bool = False
    """Whether it holds coordinates in float32."""


def _file(*suffixes: str) -> Callable[[Path], bool]:
    return lambda path: path.is_file() and path.suffix.lower() in suffixes


def _holds(*folders: str) -> Callable[[Path], bool]:
    return lambda path: any((path / folder).is_dir() for folder in folders)


DRIVES: dict[str, DriveFormat | datasets.Dataset] = {
    "KITTI drive folder": DriveFormat(_holds("velodyne"), scan_folder.open_kitti),
    "KITTI raw or KITTI-360 recording": DriveFormat(_holds("velodyne_points/data"), datasets.open_kitti_raw),
    "nuScenes": DriveFormat(datasets.is_nuscenes, datasets.open_nuscenes),
    **datasets.DATASETS,
    "Oxford RobotCar traversal": DriveFormat(_holds(*datasets.OXFORD_LIDARS), datasets.open_oxford),
    "ROS bag": DriveFormat(bag_files.is_bag, rosbag.open_rosbag),
    "folder of PCD scans": DriveFormat(scan_folder.pcd_scans, scan_folder.open_pcd_scans),
    "folder of PLY, LAS, npy or bin scans": DriveFormat(scan_folder.cloud_scans, scan_folder.open_cloud_scans),
    "ROS bag without metadata.yaml": DriveFormat(bag_files.is_bag_without_metadata, rosbag.open_rosbag),
}
"""In the order in which they are tried."""


def drive_format(path: Path) -> DriveFormat | datasets.Dataset | None:
    """The layout of the drive at ``path``; None if no drive lies there."""
    return next((layout for layout in DRIVES.values() if layout.recognised(path)), None)


MAPS: dict[str, MapFormat] = {
    "Autoware tile folder": MapFormat(autoware.is_autoware, autoware.stream_autoware),
    "Autoware default folder": MapFormat(autoware.is_autoware_default, autoware.stream_autoware_default),
    "PCD file": MapFormat(_file(".pcd"), pcd.stream_pcd),
    "folder of PCD tiles": MapFormat(pcd.is_pcd_tiles, pcd.stream_pcd_tiles),
    "LAS or LAZ file": MapFormat(_file(".las", ".laz"), las.stream_las),
    "folder of LAS or LAZ tiles": MapFormat(las.is_las_tiles, las.stream_las_tiles),
    "PLY file": MapFormat(_file(".ply"), ply.stream_ply),
    "E57 file": MapFormat(_file(".e57"), e57.stream_e57),
}
"""Maps that are only points, in the order in which they are tried."""

WRITERS: dict[str, MapWriter] = {
    ".pcd": MapWriter("PCD file", pcd.write_pcd, single=True),
    ".las": MapWriter("LAS file", las.write_las, classes=True),
    ".laz": MapWriter("LAZ file", las.write_las, classes=True),
    ".copc.laz": MapWriter("COPC", copc.write_copc, classes=True),
    ".ply": MapWriter("PLY file", ply.write_ply),
    "": MapWriter("Autoware tile folder", autoware.write_autoware, single=True),
}
"""By the suffix of the path; a folder has none."""
