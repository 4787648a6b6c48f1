"""Tables of poses whose header names the columns, in whatever order and unit; fixes that are none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from numpy.typing import NDArray

from mapvote.core.geometry import exp
from mapvote.core.types import MapvoteError
from mapvote.formats.drives.trajectory import read_trajectory
from mapvote.formats.geo.frame import sound_fixes

N = 12
T = np.array([exp(k * np.array([0.9, 0, 0.01, 0.002, 0.001, 0.12])) for k in range(N)])
Q = scipy.spatial.transform.Rotation.from_matrix(T[:, :3, :3]).as_quat()
EULER = scipy.spatial.transform.Rotation.from_matrix(T[:, :3, :3]).as_euler("ZYX")
VALUES: dict[str, NDArray[Any]] = {
    "ns": 1_700_000_000_000_000_000 + np.arange(N) * 10**8,
    "s": np.arange(N) * 0.1,
    "x": T[:, 0, 3], "y": T[:, 1, 3], "z": T[:, 2, 3], "mm": 1000.0 * T[:, 0, 3],
    "qx": Q[:, 0], "qy": Q[:, 1], "qz": Q[:, 2], "qw": Q[:, 3],
    "yaw": EULER[:, 0], "pitch": EULER[:, 1], "roll": EULER[:, 2],
    "yaw_deg": np.degrees(EULER[:, 0]), "pitch_deg": np.degrees(EULER[:, 1]), "roll_deg": np.degrees(EULER[:, 2]),
    "0": np.zeros(N),
}  # fmt: skip


def _write(file: Path, header: str, columns: str, comma: str = ",") -> Path:
    rows = [comma.join(str(VALUES[name][i].item()) for name in columns.split()) for i in range(N)]
    file.write_text("\n".join([header, *rows]) + "\n")
    return file


@pytest.mark.parametrize(
    ("header", "columns"),
    [
        (
            "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
            "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]",
            "ns x y z qw qx qy qz 0 0 0",
        ),
        (
            "%time,field.header.seq,field.header.stamp,field.pose.pose.position.x,field.pose.pose.position.y,"
            "field.pose.pose.position.z,field.pose.pose.orientation.x,field.pose.pose.orientation.y,"
            "field.pose.pose.orientation.z,field.pose.pose.orientation.w,field.twist.twist.linear.x",
            "0 0 ns x y z qx qy qz qw 0",
        ),
        ("timestamp,x,y,z,qx,qy,qz,qw", "s x y z qx qy qz qw"),
        ("qw,qx,qy,qz,z,y,x,t", "qw qx qy qz z y x s"),
        ('"stamp";"rot_w";"rot_x";"rot_y";"rot_z";"pos_x";"pos_y";"pos_z"', "s qw qx qy qz x y z"),
        ("time,northing,easting,altitude,roll [deg],pitch [deg],yaw [deg]", "s y x z roll_deg pitch_deg yaw_deg"),
        ("time,x,y,z,roll_rad,pitch_rad,yaw_rad", "s x y z roll pitch yaw"),
        ("time,x [mm],y [m],z [m],qx,qy,qz,qw", "s mm y z qx qy qz qw"),
        ("t,orientation.w,orientation.x,orientation.y,orientation.z,x,y,z", "s qw qx qy qz x y z"),
        ("timestamp,transform.translation.x,transform.translation.y,transform.translation.z,transform.rotation.x,"
         "transform.rotation.y,transform.rotation.z,transform.rotation.w", "s x y z qx qy qz qw"),
    ],
)  # fmt: skip
def test_whatever_order_and_unit_a_header_names_is_obeyed(tmp_path: Path, header: str, columns: str) -> None:
    found = read_trajectory(_write(tmp_path / "poses.csv", header, columns))
    np.testing.assert_allclose(found.T_map, T, atol=1e-6)
    assert np.diff(found.times_ns).tolist() == pytest.approx([10**8] * (N - 1), abs=1)
    if " ns " in f" {columns} ":
        assert found.times_ns[0] == VALUES["ns"][0]


def test_the_comment_of_a_tum_file_names_its_order(tmp_path: Path) -> None:
    file = _write(tmp_path / "poses.txt", "# made by us\n# timestamp tx ty tz qw qx qy qz", "s x y z qw qx qy qz", " ")
    np.testing.assert_allclose(read_trajectory(file).T_map, T, atol=1e-6)


def test_without_a_header_the_order_shows_by_the_way_driven_and_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bend = [exp(k * np.array([0.9, 0, 0, 0, 0, 0.12])) for k in range(40)]
    rows = []
    for k, T_k in enumerate(bend):
        x, y, z, w = scipy.spatial.transform.Rotation.from_matrix(T_k[:3, :3]).as_quat()
        rows.append(" ".join(map(str, (0.1 * k, *T_k[:3, 3], w, x, y, z))))
    (tmp_path / "poses.txt").write_text("\n".join(rows))
    np.testing.assert_allclose(read_trajectory(tmp_path / "poses.txt").T_map, bend, atol=1e-6)
    assert "qw, qx, qy, qz" in caplog.text


def test_an_unknown_header_is_one_error_that_says_what_to_name(tmp_path: Path) -> None:
    file = _write(tmp_path / "poses.csv", "alpha,beta,gamma,delta,a,b,c,d", "s x y z qx qy qz qw")
    with pytest.raises(MapvoteError, match=r"poses.csv:1: no known header.*name a time, x, y, z"):
        read_trajectory(file)


def test_fixes_that_are_none_are_left_out_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    fixes = np.array([[0, 0, 0], [8.4, 49.0, 110], [8.4, 49.0, np.nan], [8.4, 49.0, 114], [np.nan] * 3, [8.4, 49, 1]])
    keep, place = sound_fixes("bag: /fix", fixes, np.array([0.0, 0, 0, 0, 0, -1]))
    assert keep.tolist() == [False, True, True, True, False, False]
    assert place[:, 2].tolist() == [110, 112, 114]
    assert "3 of 6 fixes are left out: 1 by their status, 1 at latitude 0, longitude 0" in caplog.text
    assert "1 of 3 fixes have no altitude" in caplog.text


def test_altitudes_that_are_all_missing_are_told(caplog: pytest.LogCaptureFixture) -> None:
    _, place = sound_fixes("bag: /fix", np.array([[8.4, 49.0, np.nan]] * 2))
    assert place[:, 2].tolist() == [0.0, 0.0]
    assert "taken as 0 m" in caplog.text
    with pytest.raises(MapvoteError, match="none of its 2 fixes is valid"):
        sound_fixes("bag: /fix", np.zeros((2, 3)))
