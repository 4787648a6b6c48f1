"""The order and the times of scans by their names, as recorders and scripts write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.types import MapvoteError
from mapvote.formats import is_cloud, open_drive, write_pcd
from mapvote.formats.drives.scan_names import in_natural_order, numbers_of, stamps_of_names_ns
from mapvote.formats.maps.cloud import Cloud


def ordered(names: list[str]) -> list[str]:
    shuffled = [Path(names[i]) for i in np.random.default_rng(0).permutation(len(names))]
    return [file.name for file in in_natural_order(shuffled)]


@pytest.mark.parametrize(
    "names",
    [
        [f"scan_{i}_hdl32.pcd" for i in range(12)],
        [f"{i}_of_120.pcd" for i in range(12)],
        [f"lidar2_{i}.ply" for i in range(12)],
        ["1.pcd", "02.pcd", "003.pcd", "10.pcd"],
        [f"scan_{i}.pcd" for i in range(-12, 12)],
        [f"scan-{i}.pcd" for i in range(1, 12)],
        [f"{i:x}.bin" for i in range(300)],
        [f"scan_{i:04x}_left.bin" for i in range(300)],
        [f"2026-11-26-13-59-{s}.pcd" for s in (1, 9, 10)],
        ["899.911149430.pcd", "900.11149430.pcd", "900.111149430.pcd", "900.211149430.pcd"],
        [f"{i * 0.1:.10g}.pcd" for i in range(30)],
        [f"1599048323_{ns}.pcd" for ns in (9, 100000009, 200000009)],
        [f"drive_3_scan_{i}.pcd" for i in (2, 10)] + [f"drive_20_scan_{i}.pcd" for i in (1, 11)],
        ["a1.pcd", "a2.pcd", "a10.pcd", "b1.pcd", "b10.pcd"],
    ],
)
def test_scans_are_in_the_natural_order_of_their_whole_names(names: list[str]) -> None:
    assert ordered(names) == names


@given(st.lists(st.integers(0, 10**12), min_size=2, max_size=20, unique=True), st.integers(0, 14))
def test_padding_changes_no_order(numbers: list[int], width: int) -> None:
    counted = [f"scan_{number:0{width}d}_32.pcd" for number in sorted(numbers)]
    assert ordered(counted) == counted


@given(st.integers(0, 10**9), st.lists(st.integers(0, 10**9 - 1), min_size=2, max_size=20, unique=True))
def test_padded_nanoseconds_are_exact(second: int, parts: list[int]) -> None:
    second += 10**9
    files = [Path(f"{second}.{ns:09d}.pcd") for ns in sorted(parts)]
    stamps_ns = stamps_of_names_ns(files)
    assert stamps_ns is not None
    assert stamps_ns.tolist() == [second * 10**9 + ns for ns in sorted(parts)]


@pytest.mark.parametrize(
    ("names", "stamps_ns"),
    [
        (["1317042145.964", "1317042146.1"], [1317042145964000000, 1317042146100000000]),
        (["cloud_1317042145964", "cloud_1317042146100"], [1317042145964000000, 1317042146100000000]),
        (["1599048323_10115000", "1599048323_110115000"], [1599048323010115000, 1599048323110115000]),
        (["1599048323_010115", "1599048323_110115"], [1599048323010115000, 1599048323110115000]),
        (["899.11149430", "899.111149430", "899.211149430"], [899011149430, 899111149430, 899211149430]),
        (["1970-01-01_00-00-59.5", "1970-01-01_00-01-00.5"], None),
        (["2026-11-26_13-00-59.5", "2026-11-26_13-01-00.5"], [1795698059500000000, 1795698060500000000]),
        (["000001", "000002"], None),
        (["v1.1", "v1.2"], [1100000000, 1200000000]),
    ],
)
def test_times_in_names_are_read_to_the_nanosecond(names: list[str], stamps_ns: list[int] | None) -> None:
    found = stamps_of_names_ns([Path(f"{name}.pcd") for name in names])
    assert (None if found is None else found.tolist()) == stamps_ns


def test_the_number_of_a_scan_is_the_one_that_counts() -> None:
    assert numbers_of([Path(f"scan_{i}_hdl32.pcd") for i in (2, 10)]).tolist() == [2, 10]
    assert numbers_of([Path("left.pcd"), Path("right.pcd")]).tolist() == [-1, -1]


def _cloud(folder: Path, name: str, x: float, y: float) -> None:
    rng = np.random.default_rng(len(name))
    folder.mkdir(exist_ok=True)
    points = rng.uniform(-8.0, 8.0, (2000, 3)) + np.array([x, y, 0.0])
    write_pcd(folder / f"{name}.pcd", Cloud(points), double=True)


@pytest.mark.parametrize("names", ["{x}_{y}", "map_{i}_{j}", "tile-{i}-{j}", "{x}.0_{y}.0"])
def test_tiles_named_by_a_place_are_a_map(tmp_path: Path, names: str) -> None:
    for i in range(2):
        for j in range(2):
            x, y = 412340 + 20 * i, 5423980 + 20 * j
            _cloud(tmp_path / "tiles", names.format(i=i, j=j, x=x, y=y), x, y)
    assert is_cloud(tmp_path / "tiles")


def test_scans_named_like_tiles_are_a_drive(tmp_path: Path) -> None:
    for i in range(4):
        _cloud(tmp_path / "scans", f"scan_{i}_0", 0.0, 0.0)
    assert not is_cloud(tmp_path / "scans")
    assert len(open_drive(tmp_path / "scans", rate_hz=10.0)) == 4


def test_names_without_times_ask_for_a_rate(tmp_path: Path) -> None:
    for i in range(3):
        _cloud(tmp_path / "scans", f"scan_{i}_hdl32", 0.0, 0.0)
    with pytest.raises(MapvoteError, match="--rate"):
        open_drive(tmp_path / "scans")
