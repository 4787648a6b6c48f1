"""PointCloud2 as other drivers write them: fields listed in any order, in capitals, in any byte order, with padding."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mapvote.core.sensors import SENSORS
from mapvote.core.types import F32, MapvoteError
from mapvote.formats.drives.packets import direction_of
from mapvote.formats.drives.point_fields import PointReader, _sort_out, point_cloud_table, scan_from_point_cloud2

POINTS = np.random.default_rng(4).uniform([3, 3, -1], [30, 20, 4], (200, 3)).astype(np.float32)
FLOAT = 7


@dataclass
class Field:
    """One sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int = FLOAT
    count: int = 1


def message(fields: list[Field], points: F32 = POINTS, big: bool = False, step: int = 16) -> Any:
    """A PointCloud2 whose x, y, z lie at the offsets 0, 4 and 8 of each point."""
    rows = np.zeros((len(points), step), np.uint8)
    rows[:, :12] = np.ascontiguousarray(points, dtype=">f4" if big else "<f4").view(np.uint8).reshape(-1, 12)
    stamp = SimpleNamespace(sec=1, nanosec=0)
    return SimpleNamespace(
        header=SimpleNamespace(frame_id="lidar", stamp=stamp),
        width=len(points),
        height=1,
        point_step=step,
        row_step=0,
        fields=fields,
        is_bigendian=big,
        data=rows.tobytes(),
    )


XYZ = [Field("x", 0), Field("y", 4), Field("z", 8)]
SOUND = {
    "as usual": message(XYZ),
    "capitals": message([Field("X", 0), Field("Y", 4), Field("Z", 8)]),
    "listed backwards": message([Field("intensity", 12), *XYZ[::-1]]),
    "overlapping": message([*XYZ, Field("intensity", 8)]),
    "big-endian": message(XYZ, big=True),
    "padding": message(XYZ, step=48),
    "COUNT 0": message([replace(field, count=0) for field in XYZ]),
}


@pytest.mark.parametrize("kind", SOUND)
def test_every_layout_of_fields_gives_the_same_points_and_the_same_direction(kind: str) -> None:
    scan = scan_from_point_cloud2(SOUND[kind], SENSORS["hdl32e"])
    np.testing.assert_array_equal(scan.points, POINTS)
    middle_rad, share = direction_of(point_cloud_table("a cloud", SOUND[kind]))
    assert 0.0 < middle_rad < np.pi / 2
    assert share < 0.3


def test_a_warmed_up_vehicle_compiles_nothing_for_the_layout_of_its_clouds() -> None:
    """Points lie apart or side by side, in bytes of a message or in a table that may be written to."""
    table = np.zeros(len(POINTS), [(axis, "<f4") for axis in "xyz"])
    for cloud in (*SOUND.values(), message(XYZ, step=12)):
        table["x"], table["y"], table["z"] = scan_from_point_cloud2(cloud, SENSORS["hdl32e"]).points.T
        PointReader("table").scan("table", 0, 0, table, SENSORS["hdl32e"])
    assert len(_sort_out.signatures) <= 2


def test_a_field_of_three_numbers_is_no_x_y_z() -> None:
    table = point_cloud_table("a cloud", message([Field("xyz", 0, count=3)]))
    with pytest.raises(MapvoteError, match="no field x, y, z among xyz; points need x, y and z"):
        direction_of(table)


def test_numbers_that_are_none_have_no_direction() -> None:
    """Signalling NaN, as bytes in the wrong order make them; warnings are errors here."""
    bad = np.full((200, 3), np.array([0x7FA00000], np.uint32).view(np.float32)[0])
    assert direction_of(point_cloud_table("a cloud", message(XYZ, bad))) == (0.0, 0.0)
