"""PLY and E57 as other programs write them: types, byte order, lists, names, colours of 16 bits."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapvote.core.types import MapvoteError
from mapvote.formats import stream_cloud
from mapvote.formats.maps.cloud import Cloud, ReadSizes, joined
from mapvote.formats.maps.e57 import stream_e57

XYZ = [[1.5, 2.0, 3.0], [4.0, 5.0, 6.25]]
HEAD = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


def ply(tmp_path: Path, data: bytes | str) -> Cloud:
    (tmp_path / "a.ply").write_bytes(data.encode() if isinstance(data, str) else data)
    return joined(stream_cloud(tmp_path / "a.ply"))


@pytest.mark.parametrize(
    "data",
    [
        HEAD + "1.5 2 3\n4 5 6.25\n",
        (HEAD + "1.5 2 3\n4 5 6.25\n").replace("\n", "\r\n"),
        HEAD + "1.5\t2   3  \n\n4 5 6.25",
        HEAD.replace("element", "comment made by\nobj_info a scanner\nelement") + "1.5 2 3\n4 5 6.25\n",
        HEAD.replace("float", "float64") + "1.5 2 3\n4 5 6.25\n",
        HEAD.replace("element vertex 2", "element face 1\nproperty list uchar int vertex_indices\nelement vertex 2")
        + "3 0 1 1\n1.5 2 3\n4 5 6.25\n",
        HEAD.replace("end_header", "element face 1\nproperty list uchar int vertex_indices\nend_header")
        + "1.5 2 3\n4 5 6.25\n3 0 1 1\n",
        HEAD.replace("float x", "float X").replace("float y", "float Y").replace("float z", "float Z")
        + "1.5 2 3\n4 5 6.25\n",
    ],
    ids=["plain", "CRLF", "tabs, blanks", "comments", "float64", "faces before", "faces behind", "capitals"],
)  # fmt: skip
def test_text_is_read_as_others_write_it(tmp_path: Path, data: str) -> None:
    assert ply(tmp_path, data).points.tolist() == XYZ


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("lists", [True, False])
def test_cloud_compares_names_doubles_lists_and_16_bit_colours(tmp_path: Path, order: str, lists: bool) -> None:
    faces = "element face 2\nproperty list uchar int vertex_indices\n"
    head = (
        f"ply\nformat binary_{order}_endian 1.0\n{faces}element vertex 2\n"
        + ("property list uchar float seen_from\n" if lists else "")
        + "property double x\nproperty double y\nproperty double z\nproperty ushort red\nproperty ushort green\n"
        "property ushort blue\nproperty float scalar_Intensity\nproperty float scalar_Classification\n"
        "property double scalar_GpsTime\nproperty float scalar_Return_Number\nproperty uchar alpha\nend_header\n"
    )
    e = "<" if order == "little" else ">"
    data = struct.pack(e + "B3i", 3, 0, 1, 1) + struct.pack(e + "B4i", 4, 0, 1, 1, 0)
    for k, place in enumerate(XYZ):
        data += struct.pack(e + "B2f", 2, 0.5, 0.25) if lists else b""
        data += struct.pack(e + "3d3H2fdfB", *place, 65535 - k, 7, 8 + k, 0.5, 2, 1e8 + k, 1, 255)
    cloud = ply(tmp_path, head.encode() + data)
    assert cloud.points.tolist() == XYZ
    assert {name: column.tolist() for name, column in cloud.fields.items()} == {
        "red": [65535, 65534], "green": [7, 7], "blue": [8, 9], "intensity": [0.5, 0.5], "classification": [2, 2],
        "gps_time": [1e8, 1e8 + 1], "return_number": [1, 1],
    }  # fmt: skip
    assert cloud.fields["red"].dtype == np.uint16
    assert cloud.dropped == ("alpha",)


@pytest.mark.parametrize("names", ["red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b"])
def test_colours_have_three_kinds_of_names(tmp_path: Path, names: str) -> None:
    added = "".join(f"property uchar {name}\n" for name in names.split())
    cloud = ply(tmp_path, HEAD.replace("end_header", added + "end_header") + "1 2 3 9 8 7\n4 5 6 6 5 4\n")
    assert [cloud.fields[name].tolist() for name in ("red", "green", "blue")] == [[9, 6], [8, 5], [7, 4]]


@pytest.mark.parametrize("binary", [True, False])
def test_vertices_that_the_header_does_not_count_are_named(tmp_path: Path, binary: bool) -> None:
    head = HEAD.replace("ascii", "binary_little_endian") if binary else HEAD
    row = struct.pack("<3f", 1, 2, 3) if binary else b"1 2 3\n"
    with pytest.raises(MapvoteError, match=r"data follow the elements that its header counts \(2 vertex\); correct"):
        ply(tmp_path, head.encode() + 3 * row)
    with pytest.raises(MapvoteError, match="not a whole PLY"):
        ply(tmp_path, head.encode() + row)
    ply(tmp_path, head.encode() + 2 * row + b"\n")


def write_e57(file: Path, colours: np.ndarray[Any, Any], limit: int, intensity: tuple[float, float]) -> None:
    """By libE57 itself, for pye57's own writer knows 8 bits only."""
    import pye57

    made = pye57.E57(str(file), mode="w")
    lib, out = pye57.libe57, made.image_file
    n = len(colours)
    scan, points = lib.StructureNode(out), lib.StructureNode(out)
    columns: dict[str, np.ndarray[Any, Any]] = {f"cartesian{axis}": np.arange(n) + 0.5 for axis in "XYZ"}
    columns |= {f"color{name}": colours[:, k].astype(float) for k, name in enumerate(("Red", "Green", "Blue"))}
    columns["intensity"] = np.linspace(*intensity, n)
    columns["cartesianInvalidState"] = np.arange(n) % 5 // 4 * 2.0
    for name in columns:
        if name.startswith("color"):
            points.set(name, lib.IntegerNode(out, 0, 0, limit))
        elif name.endswith("State"):
            points.set(name, lib.IntegerNode(out, 0, 0, 2))
        else:
            points.set(name, lib.FloatNode(out, 0.0, lib.E57_DOUBLE, -1e9, 1e9))
    box = lib.StructureNode(out)
    for name in ("Red", "Green", "Blue"):
        box.set(f"color{name}Minimum", lib.IntegerNode(out, 0))
        box.set(f"color{name}Maximum", lib.IntegerNode(out, limit))
    scan.set("colorLimits", box)
    limits = lib.StructureNode(out)
    limits.set("intensityMinimum", lib.FloatNode(out, intensity[0]))
    limits.set("intensityMaximum", lib.FloatNode(out, intensity[1]))
    scan.set("intensityLimits", limits)
    scan.set("guid", lib.StringNode(out, "{1}"))
    codecs = lib.VectorNode(out, True)
    vector = lib.CompressedVectorNode(out, points, codecs)
    scan.set("points", vector)
    made.data3d.append(scan)
    buffers = lib.VectorSourceDestBuffer()
    for name, column in columns.items():
        buffers.append(lib.SourceDestBuffer(out, name, np.ascontiguousarray(column), n, True, True))
    writer = vector.writer(buffers)
    writer.write(n)
    writer.close()
    made.close()


@pytest.mark.parametrize(("limit", "kind"), [(255, np.uint8), (65535, np.uint16)])
@pytest.mark.parametrize("block", [7, 1000])
def test_e57_colours_have_the_bits_that_the_scan_names(tmp_path: Path, limit: int, kind: type, block: int) -> None:
    pytest.importorskip("pye57")
    colours = np.random.default_rng(0).integers(0, limit + 1, (40, 3))
    write_e57(tmp_path / "a.e57", colours, limit, (-100.0, 100.0))
    cloud = joined(stream_e57(tmp_path / "a.e57", ReadSizes(block=block)))
    valid = np.arange(40) % 5 < 4
    assert np.array_equal(cloud.points[:, 0], (np.arange(40) + 0.5)[valid])
    for k, name in enumerate(("red", "green", "blue")):
        assert cloud.fields[name].dtype == kind
        assert np.array_equal(cloud.fields[name], colours[valid, k])
    assert np.allclose(cloud.fields["intensity"], np.linspace(0, 200, 40)[valid], atol=1e-4), "counted from its limit"
