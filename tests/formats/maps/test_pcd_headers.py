"""PCD files as PCL and its many writers make them: each is read to the last digit, or refused with line and mend."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lzf
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hand_made import save_pcd
from mapvote.core.point_map import all_points
from mapvote.core.types import MapvoteError
from mapvote.formats import read_map, stream_cloud
from mapvote.formats.maps.cloud import joined
from mapvote.formats.maps.pcd import read_pcd_table, read_viewpoint

N = 40
KINDS = {"x": "<f4", "y": "<f4", "z": "<f4", "intensity": "<f4"}
HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z intensity
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH 40
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 40
DATA binary
"""
Head = Callable[[str], str]


def table(kinds: dict[str, str] | None = None, seed: int = 0) -> NDArray[np.void]:
    rng = np.random.default_rng(seed)
    out = np.zeros(N, dtype=list((kinds or KINDS).items()))
    for name in out.dtype.names or ():
        kind = out.dtype[name]
        values = rng.uniform(-90, 90, (N, *kind.shape)) if kind.base.kind in "fi" else rng.integers(0, 99, N)
        out[name] = values.astype(kind.base)
    return out


def text(rows: NDArray[np.void], blank: str = " ", end: str = "\n") -> str:
    return "".join(blank.join(repr(v.item()) for v in row) + end for row in rows)


def without(*keywords: str) -> Head:
    return lambda h: "".join(line for line in h.splitlines(True) if line.split()[0] not in keywords)


def swapped(old: str, new: str) -> Head:
    return lambda h: h.replace(old, new)


SOUND: dict[str, Head] = {
    "as PCL writes it": lambda h: h,
    "COUNT missing": without("COUNT"),
    "VIEWPOINT missing": without("VIEWPOINT"),
    "VERSION missing": without("VERSION"),
    "POINTS missing": without("POINTS"),
    "WIDTH and HEIGHT missing": without("WIDTH", "HEIGHT"),
    "HEIGHT missing": without("HEIGHT"),
    "SIZE, TYPE and COUNT missing, as in version .5": without("SIZE", "TYPE", "COUNT"),
    "VERSION .6": swapped("VERSION 0.7", "VERSION .6"),
    "VERSION 0.5": swapped("VERSION 0.7", "VERSION 0.5"),
    "VERSION 7 with words": swapped("VERSION 0.7", "VERSION v7 of my driver"),
    "COLUMNS for FIELDS": swapped("FIELDS", "COLUMNS"),
    "TYPE in small letters": swapped("TYPE F F F F", "TYPE f f f f"),
    "keywords in small letters": lambda h: "".join(
        line if line[0] == "#" else line.split()[0].lower() + line[len(line.split()[0]) :]
        for line in h.splitlines(True)
    ),
    "tabs": lambda h: h.replace(" ", "\t"),
    "several blanks": lambda h: h.replace(" ", "   "),
    "blanks at both ends": lambda h: "".join(f"  {line.rstrip()}  \n" for line in h.splitlines()),
    "CRLF": lambda h: h.replace("\n", "\r\n"),
    "comments between the lines": lambda h: "\n# written by a driver\n".join(h.splitlines()) + "\n",
    "comments after the first line": lambda h: h.replace("VERSION", "#\n#VERSION 9\nVERSION"),
    "empty lines": lambda h: h.replace("\nSIZE", "\n\n  \nSIZE"),
    "a byte order mark": lambda h: "\ufeff" + h,
    "WIDTH and HEIGHT last": lambda h: without("WIDTH", "HEIGHT")(h).replace("DATA", "HEIGHT 1\nWIDTH 40\nDATA"),
    "POINTS first": lambda h: "POINTS 40\n" + without("POINTS")(h),
    "TYPE before SIZE": lambda h: h.replace("SIZE 4 4 4 4\n", "").replace("COUNT", "SIZE 4 4 4 4\nCOUNT"),
    "an image of 4 rows": lambda h: h.replace("WIDTH 40", "WIDTH 10").replace("HEIGHT 1", "HEIGHT 4"),
}


@pytest.mark.parametrize("name", SOUND)
@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_every_header_that_pcl_reads_is_read(tmp_path: Path, name: str, encoding: str) -> None:
    rows, file = table(), tmp_path / "a.pcd"
    header = SOUND[name](HEADER.replace("DATA binary", f"DATA {encoding}")).encode()
    file.write_bytes(header + BODIES[encoding](rows))
    after = read_pcd_table(file)
    assert all(np.array_equal(after[one], rows[one]) for one in KINDS)
    cloud = joined(stream_cloud(file))
    assert np.array_equal(cloud.points, np.column_stack([rows["x"], rows["y"], rows["z"]]))
    assert np.array_equal(cloud.fields["intensity"], rows["intensity"])


def as_text(rows: NDArray[np.void]) -> bytes:
    return text(rows).encode()


def packed(rows: NDArray[np.void]) -> bytes:
    raw = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names or ())
    squeezed = lzf.compress(raw, 2 * len(raw))
    return struct.pack("<II", len(squeezed), len(raw)) + bytes(squeezed)


BODIES: dict[str, Callable[[NDArray[np.void]], bytes]] = {
    "ascii": as_text,
    "binary": lambda rows: rows.tobytes(),
    "binary_compressed": packed,
}


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.permutations(["x", "y", "z", "intensity", "_", "ring", "_", "t"]),
    st.sampled_from(["<f4", "<f8", "<i2", "<i4"]),
    st.sampled_from(["ascii", "binary", "binary_compressed", "binary_compressed as PCL"]),
    st.integers(1, 7),
)
def test_fields_in_any_order_and_type_with_padding_between_them(
    tmp_path: Path, order: list[str], kind: str, encoding: str, padding: int
) -> None:
    """PCL's own binary_compressed files hold no padding, though the header tells of it."""
    kinds: dict[str, Any] = {"x": kind, "y": kind, "z": kind, "intensity": "<f4", "ring": "<u2", "t": "<u8"}
    entries = [(f"_{i}", "u1", (padding,)) if name == "_" else (name, kinds[name], ()) for i, name in enumerate(order)]
    rows = np.zeros(N, dtype=entries)
    for name, column in zip(kinds, table(kinds).dtype.names or (), strict=True):
        rows[name] = table(kinds)[column]
    header = (
        f"FIELDS {' '.join(order)}\n"
        f"SIZE {' '.join(str(rows.dtype[name].base.itemsize) for name, _, _ in entries)}\n"
        f"TYPE {' '.join(rows.dtype[name].base.kind.upper() for name, _, _ in entries)}\n"
        f"COUNT {' '.join(str(padding if name[0] == '_' else 1) for name, _, _ in entries)}\n"
        f"WIDTH {N}\nHEIGHT 1\nPOINTS {N}\nDATA {encoding.split()[0]}\n"
    ).encode()
    real = rows[[name for name in rows.dtype.names or () if name[0] != "_"]]
    numbers = [[str(v) for value in row for v in np.ravel(value)] for row in rows.tolist()]
    data = {
        "ascii": "\n".join(" ".join(line) for line in numbers).encode(),
        "binary": rows.tobytes(),
        "binary_compressed": packed(rows),
        "binary_compressed as PCL": packed(real),
    }
    (tmp_path / "a.pcd").write_bytes(header + data[encoding])
    after = read_pcd_table(tmp_path / "a.pcd")
    for name in kinds:
        assert after[name].dtype == rows[name].dtype
        assert np.array_equal(after[name], rows[name])
    cloud = joined(stream_cloud(tmp_path / "a.pcd"))
    assert np.array_equal(cloud.points, np.column_stack([rows[axis].astype(np.float64) for axis in "xyz"]))


def test_a_field_with_count_0_takes_no_bytes_as_in_files_of_an_ouster(tmp_path: Path) -> None:
    names = "x y z _ intensity t reflectivity ring _ noise _ range _"
    sizes, counts = "4 4 4 1 4 4 2 1 1 2 1 4 1", "1 1 1 4 1 1 1 1 0 1 0 1 15"
    kinds: dict[str, Any] = {
        "x": "<f4", "y": "<f4", "z": "<f4", "_3": ("u1", 4), "intensity": "<f4", "t": "<u4", "reflectivity": "<u2",
        "ring": "u1", "noise": "<u2", "range": "<u4", "_12": ("u1", 15),
    }  # fmt: skip
    rows = np.zeros(N, dtype=list(kinds.items()))
    for name in ("x", "y", "z", "intensity", "t", "ring", "range"):
        rows[name] = np.arange(N)
    head = (
        f"VERSION 0.7\nFIELDS {names}\nSIZE {sizes}\nTYPE F F F U F U U U U U U U U\nCOUNT {counts}\n"
        f"WIDTH 20\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {N}\nDATA binary\n"
    )
    (tmp_path / "a.pcd").write_bytes(head.encode() + rows.tobytes())
    after = read_pcd_table(tmp_path / "a.pcd")
    assert np.array_equal(after["range"], np.arange(N))
    assert np.array_equal(after["t"], np.arange(N))
    assert len(joined(stream_cloud(tmp_path / "a.pcd")).points) == N - 1, "the ray at (0, 0, 0) has no return"


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_count_0_of_old_converters_that_wrote_the_value_is_one_element(tmp_path: Path, encoding: str) -> None:
    rows = table()
    head = HEADER.replace("COUNT 1 1 1 1", "COUNT 1 1 1 0").replace("DATA binary", f"DATA {encoding}").encode()
    data = BODIES[encoding](rows)
    (tmp_path / "a.pcd").write_bytes(head + data)
    assert np.array_equal(read_pcd_table(tmp_path / "a.pcd")["intensity"], rows["intensity"])


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.replace(" ", "\t"),
        lambda t: t.replace(" ", "  \t "),
        lambda t: t.replace("\n", "\r\n"),
        lambda t: t.replace("\n", "  \n\n"),
        lambda t: t.replace(" ", ", "),
        lambda t: t.rstrip("\n"),
    ],
    ids=["tabs", "several blanks", "CRLF", "empty lines", "commas", "no line break at the end"],
)
def test_rows_of_text_are_split_as_pcl_splits_them(tmp_path: Path, change: Head) -> None:
    rows = table()
    (tmp_path / "a.pcd").write_text(HEADER.replace("binary", "ascii") + change(text(rows)), newline="")
    assert np.array_equal(read_pcd_table(tmp_path / "a.pcd"), rows)


def test_whole_numbers_written_as_reals_and_nan_are_read_as_pcl_reads_them(tmp_path: Path) -> None:
    head = "FIELDS x y z ring t\nSIZE 4 4 4 2 4\nTYPE F F F U U\nWIDTH 3\nHEIGHT 1\nDATA ascii\n"
    (tmp_path / "a.pcd").write_text(head + "1 2 3 4.0 5\nnan -nan inf nan 6e1\n7 8 9 10 11\n")
    after = read_pcd_table(tmp_path / "a.pcd")
    assert after["ring"].tolist() == [4, 0, 10]
    assert after["t"].tolist() == [5, 60, 11]
    assert np.isnan(after["y"][1])


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_an_image_with_rays_without_return_is_a_map_of_the_others(
    tmp_path: Path, encoding: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A fifth of an Ouster's rays meet nothing; some drivers write NaN, others (0, 0, 0)."""
    rng = np.random.default_rng(1)
    points = rng.uniform([-40, -40, 0], [40, 40, 6], (4000, 3)).astype(np.float32)
    points[rng.permutation(4000)[:800]] = np.nan
    points[:40] = 0.0
    save_pcd(tmp_path / "a.pcd", points, encoding)
    head = (tmp_path / "a.pcd").read_bytes().replace(b"WIDTH 4000\nHEIGHT 1\n", b"WIDTH 500\nHEIGHT 8\n")
    (tmp_path / "a.pcd").write_bytes(head)
    kept = points[np.isfinite(points).all(axis=1) & points.any(axis=1)]
    read = all_points(read_map(tmp_path / "a.pcd"))
    assert np.allclose(read[np.lexsort(read.T)], kept[np.lexsort(kept.T)], atol=1e-5)
    assert f"an image of 500 by 8 rays; {4000 - len(kept)} of them without return are left out" in caplog.text


REFUSED = [
    (without("DATA"), "no line DATA"),
    (without("FIELDS"), "no line FIELDS"),
    (without("WIDTH", "POINTS"), "neither WIDTH nor POINTS"),
    (swapped("POINTS 40", "POINTS 39"), r":10: POINTS .*: WIDTH 40 times HEIGHT 1 is not POINTS 39; correct the one"),
    (swapped("WIDTH 40", "WIDTH forty"), r":7: WIDTH .*: 'forty'; whole numbers are needed"),
    (swapped("WIDTH 40", "WIDTH -40"), r":7: WIDTH"),
    (swapped("SIZE 4 4 4 4", "SIZE 4 4 4"), r":4: SIZE .*: 3 values; one for each of the 4 FIELDS"),
    (swapped("TYPE F F F F", "TYPE F F F Q"), r":5: TYPE .*: no number has TYPE Q and SIZE 4"),
    (swapped("SIZE 4 4 4 4", "SIZE 4 4 4 3"), r":5: TYPE .*: no number has TYPE F and SIZE 3"),
    (swapped("COUNT 1 1 1 1", "COUNT 1 1 1 99999999999"), r":6: COUNT .*: 99999999999 elements of one field"),
    (swapped("VIEWPOINT 0 0 0 1 0 0 0", "VIEWPOINT 0 0 0"), r":9: VIEWPOINT .*: 3 values; 7 needed"),
    (swapped("VIEWPOINT 0 0 0 1 0 0 0", "VIEWPOINT a 0 0 1 0 0 0"), r":9: VIEWPOINT .*; 7 numbers are needed"),
    (swapped("DATA binary", "DATA base64"), r":11: DATA .*: 'base64' is no encoding; write ascii, binary"),
    (swapped("SIZE", "SIEZ"), r":4: 'SIEZ' is no line of a PCD header"),
    (swapped("COUNT 1 1 1 1", "COUNT 1 1 1 2"), "cut off: 32 points, but its header says 40"),
    (swapped("WIDTH 40", "WIDTH 30"), "WIDTH 30 times HEIGHT 1 is not POINTS 40"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "said"), REFUSED, ids=[said[:30] for _, said in REFUSED])
def test_a_header_that_cannot_be_read_is_refused_with_its_line(tmp_path: Path, change: Head, said: str) -> None:
    (tmp_path / "a.pcd").write_bytes(change(HEADER).encode() + table().tobytes())
    for read in (read_pcd_table, read_map):
        with pytest.raises(MapvoteError, match=said) as caught:
            read(tmp_path / "a.pcd")
        assert "\n" not in str(caught.value)


def test_a_row_that_is_none_is_named_by_its_line(tmp_path: Path) -> None:
    rows = text(table()).splitlines()
    for row, said in (("1 2 3", ":16: 3 values, but FIELDS and COUNT make 4"), ("1 2 3 a", ":16: '1 2 3 a' is no row")):
        body = "\n".join([*rows[:4], row, *rows[5:]]) + "\n"
        (tmp_path / "a.pcd").write_text(HEADER.replace("binary", "ascii") + body)
        with pytest.raises(MapvoteError, match=said):
            read_pcd_table(tmp_path / "a.pcd")


def test_the_viewpoint_is_read_from_any_header(tmp_path: Path) -> None:
    head = HEADER.replace("VIEWPOINT 0 0 0 1 0 0 0", "viewpoint\t1.5 -2e0  3 0.5 0.5 0.5 0.5")
    (tmp_path / "a.pcd").write_bytes(head.encode() + table().tobytes())
    assert read_viewpoint(tmp_path / "a.pcd").tolist() == [1.5, -2.0, 3.0, 0.5, 0.5, 0.5, 0.5]
