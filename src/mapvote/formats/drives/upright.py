"""A drive in axes with x ahead and z up, whatever way its sensor is mounted: what surveys and vehicles localise."""

from __future__ import annotations

from dataclasses import replace

from mapvote.core.mount import Mount, mount_of_drive
from mapvote.core.types import Drive
from mapvote.formats.drives.sensor_estimate import sensor_upright


def upright(drive: Drive) -> tuple[Drive, Mount | None]:
    """(the drive as a sensor in the usual axes would have recorded it, with the model of its sensor in them; the mount
    by which points and poses were turned, in steps). A usual mount, None, changes nothing.

    Points C p and poses T C^-1 have the same points in the map: a pose T of the turned drive is T C of the first.
    """
    mount = mount_of_drive(drive)
    if mount is None or not len(drive):
        return drive, None
    mount = mount.in_steps()
    turned = mount.turned(drive)
    measured = drive.sensor_told.startswith("measured")
    first = turned.read_scan(0).by_lidar()[0][1]  # as a live drive measures it
    return replace(turned, sensor=sensor_upright(drive.sensor, measured, first, mount.lean_deg)), mount
