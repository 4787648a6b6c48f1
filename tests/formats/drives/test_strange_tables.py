"""Tables of poses and of times as programs of other people write them: read right, or refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy

from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.drives.options import drive_options
from mapvote.formats.drives.scan_folder import read_stamps, read_times_ns
from mapvote.formats.drives.trajectory import read_poses, read_trajectory
from mapvote.formats.geo.frame import poses_from_gnss
from mapvote.formats.listing import files_like

START_S = 1_759_323_600
T = np.array([from_xyz_rpy(10.0 + k, 0.02 * k, 0.5, 0.01, -0.02, 0.02 + 0.005 * k) for k in range(12)])
QUATERNIONS = scipy.spatial.transform.Rotation.from_matrix(T[:, :3, :3]).as_quat()
RPY = scipy.spatial.transform.Rotation.from_matrix(T[:, :3, :3]).as_euler("ZYX")[:, ::-1]


def rows(of: Callable[[int], list[object]], apart: str = ",") -> str:
    return "".join(apart.join(map(str, of(k))) + "\n" for k in range(len(T)))


def tum(k: int) -> list[object]:
    return [f"{START_S + k}.250000000", *T[k, :3, 3].tolist(), *QUATERNIONS[k].tolist()]


HEADER = "time,x,y,z,qx,qy,qz,qw\n"
ANGLES = "time,x,y,z,roll,pitch,yaw\n"


def degrees_of(k: int) -> list[object]:
    return [START_S + k + 0.25, *T[k, :3, 3].tolist(), *np.degrees(RPY[k]).tolist()]


@pytest.mark.parametrize(
    "data",
    [
        rows(tum, " ").encode("utf-16"),
        b"\xef\xbb\xbf" + rows(tum, " ").encode(),
        rows(tum, " ").replace("\n", "\r\n").encode(),
        rows(tum, ";").replace(".", ",").encode(),
        (HEADER.replace(",", ";") + rows(tum, ";").replace(".", ",")).encode(),
        (HEADER.replace(",", "\t") + rows(tum, "\t").replace(".", ",")).encode(),
        (HEADER + rows(lambda k: [f"2025-10-01T13:00:{k:02d}.25Z", *tum(k)[1:]])).encode(),
        (HEADER + rows(lambda k: [f"2025-10-01 15:00:{k:02d}.25+02:00", *tum(k)[1:]])).encode(),
        (ANGLES + rows(lambda k: [START_S + k + 0.25, *T[k, :3, 3].tolist(), *RPY[k].tolist()])).encode(),
        (ANGLES + rows(degrees_of)).encode(),
        (HEADER + "s,m,m,m,1,1,1,1\n" + rows(tum)).encode(),
        (ANGLES + "[s],[m],[m],[m],[deg],[deg],[deg]\n" + rows(degrees_of)).encode(),
        rows(lambda k: [tum(k)[0], *(f"{v:.12E}".replace("E", "D") for v in tum(k)[1:])], " ").encode(),
        (rows(tum, " ") + " ".join(map(str, tum(5))) + "\n").encode(),
    ],
    ids=["utf-16", "byte order mark", "CRLF", "decimal commas", "decimal commas, header", "tabs, decimal commas",
         "dates", "dates of another zone", "radians", "few degrees without a unit", "a row of units",
         "a row of units, degrees", "doubles of Fortran", "a row twice"],
)  # fmt: skip
def test_a_table_is_read_right_however_it_is_written(tmp_path: Path, data: bytes) -> None:
    file = tmp_path / "poses.csv"
    file.write_bytes(data)
    read = read_trajectory(file)
    np.testing.assert_allclose(read.times_ns, (START_S + np.arange(len(T)) + 0.25) * 1e9, atol=200)
    np.testing.assert_allclose(read.T_map, T, atol=1e-7)


def test_one_file_has_one_unit_of_angles(tmp_path: Path) -> None:
    """A yaw of 170 degrees makes a roll of 3 degrees too, not three radians."""

    def of(k: int) -> list[object]:
        return [START_S + k, float(-k), 0.0, 0.0, 3.0, 0.0, 170.0]

    file = tmp_path / "poses.csv"
    file.write_text(ANGLES + rows(of))
    np.testing.assert_allclose(read_trajectory(file).T_map[3, 2, 1], np.sin(np.radians(3.0)), atol=1e-9)


def matrix_rows(of: Callable[[F64], F64]) -> str:
    return "".join(" ".join(f"{v:.9f}" for v in of(one).ravel()) + "\n" for one in T)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (matrix_rows(lambda one: one.T), "pose 0 does not end in 0 0 0 1: .*column by column"),
        (matrix_rows(lambda one: np.array([1.0, *one[:3].ravel()])), ":1: 13 numbers, .*an index or a time"),
        ("\n".join(matrix_rows(lambda one: one).split()), ":1: 1 numbers, but a row has 12"),
        (matrix_rows(lambda one: one[:3]).rsplit(" ", 5)[0], ":12: 7 numbers, but a row has 12; copy it again"),
        (matrix_rows(lambda one: one[:3]).replace("0.500000000", "n/a"), ":1: not a number: 'n/a'"),
        (matrix_rows(lambda one: one[:3, 3]), ":1: 3 numbers, .*in one line"),
    ],
)
def test_rows_of_another_kind_are_refused_by_line_cause_and_mend(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "prior.txt").write_text(text)
    with pytest.raises(MapvoteError, match=said):
        read_poses(tmp_path / "prior.txt")


def test_two_tracks_of_one_time_are_refused(tmp_path: Path) -> None:
    """Whichever counted would be a guess."""
    file = tmp_path / "p.tum"
    file.write_text(rows(tum, " ") + " ".join(map(str, [tum(3)[0], 22.0, *tum(3)[2:]])) + "\n")
    with pytest.raises(MapvoteError, match=r"p\.tum: row 13 lies 9\.0 m off row 4, which has its time"):
        read_trajectory(file)


def test_a_position_that_is_no_number_is_refused_by_its_line(tmp_path: Path) -> None:
    (tmp_path / "p.tum").write_text(rows(tum, " ").replace(" 14.0 ", " nan "))
    with pytest.raises(MapvoteError, match=r"p\.tum:5: not a number: 'nan'"):
        read_trajectory(tmp_path / "p.tum")


@pytest.mark.parametrize(
    ("text", "toml", "said"),
    [
        ("1759323600.0\n1759323600.1\n", f"start_ns = {START_S * 10**9}", "count from 1970 already.*leave it out"),
        ("0.0\n0.1\n", f"start_ns = {START_S}", f"looks like seconds since 1970: write nanoseconds, {START_S * 10**9}"),
        ("0.0\n0.1\n", f"start_ns = {START_S * 10**3}", "looks like milliseconds"),
        ("0.0\n0.1\n", "prior_sigma_m = nan", "must be positive numbers"),
        ("0.0\n0.1\n", "prior_sigma_deg = inf", "must be positive numbers"),
        ("2025-10-01 13:00\n2025-10-01 13:01\n", "", r"times.txt:1: not a date and time"),
    ],
)
def test_stamps_of_another_unit_or_counted_twice_are_refused(tmp_path: Path, text: str, toml: str, said: str) -> None:
    (tmp_path / "times.txt").write_text(text)
    (tmp_path / "drive.toml").write_text(toml)
    with pytest.raises(MapvoteError, match=said):
        read_stamps(tmp_path, [tmp_path / "0.bin", tmp_path / "1.bin"], drive_options(tmp_path))


def test_a_date_in_another_zone_is_the_same_moment(tmp_path: Path) -> None:
    (tmp_path / "times.txt").write_text("2025-10-01 13:00:00.5\n2025-10-01T15:00:00.5+02:00\n2025-10-01T13:00:00.5Z\n")
    assert read_times_ns(tmp_path / "times.txt").tolist() == [START_S * 10**9 + 500_000_000] * 3


@pytest.mark.parametrize(
    ("lonlat", "said"),
    [
        (np.array([[0.1466, 0.8552, 110.0], [0.1466, 0.8553, 110.0]]), "lies in the sea .*radians"),
        (np.zeros((2, 3)), "no fixes at all"),
        (np.array([[35.6, 139.7, 1.0]]), "latitude of 139.7 degrees: are latitude and longitude swapped"),
        (np.array([[84_000_000.0, 490_000_000.0, 1.0]]), "write decimal degrees"),
        (np.array([[8.4, np.nan, 1.0]]), "needs a place for every row"),
    ],
)
def test_fixes_that_are_no_degrees_are_refused(lonlat: F64, said: str) -> None:
    with pytest.raises(MapvoteError, match=said):
        poses_from_gnss(lonlat, np.zeros((len(lonlat), 3)), None)


def test_a_link_to_nothing_is_a_scan_that_cannot_be_read_and_no_missing_one(tmp_path: Path) -> None:
    (tmp_path / "0.bin").write_bytes(b"")
    (tmp_path / "1.bin").symlink_to(tmp_path / "gone")
    assert [file.name for file in files_like(tmp_path, "*.bin")] == ["0.bin", "1.bin"]
