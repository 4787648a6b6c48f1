"""The doctor names each illness of a drive, and calls a healthy drive sound.

The street: a road, two rows of walls with gaps, poles; the car turns gently, so that a mirror would show.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mapvote.core import geometry
from mapvote.core.grid import Lattice
from mapvote.core.point_map import PointMap, cut_tiles, map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.tile import Tile
from mapvote.core.types import F64, Drive, Scan
from mapvote.doctor import Finding
from mapvote.doctor.diagnosis import diagnose
from mapvote.doctor.map_fit import MapEvidence, in_another_unit
from mapvote.doctor.prior import CAMERA_TO_LIDAR
from mapvote.formats import DriveWriter
from mapvote.formats.drives.kitti import write_poses

N = 24


def world() -> F64:
    """Points on a road, walls and poles, map metres; seeded."""
    rng = np.random.default_rng(5)
    road = np.column_stack([rng.uniform(-60, 90, 60_000), rng.uniform(-40, 60, 60_000), rng.normal(0, 0.01, 60_000)])
    parts = [road]
    for _ in range(60):
        x, y = rng.uniform(-60, 90), rng.choice([-1, 1]) * rng.uniform(9, 30)
        along, height = rng.uniform(2, 12), rng.uniform(2, 8)
        heading = rng.uniform(0, np.pi)
        s, z = rng.uniform(0, along, 900), rng.uniform(0, height, 900)
        parts.append(np.column_stack([x + s * np.cos(heading), y + s * np.sin(heading), z]))
    return np.concatenate(parts)


def poses() -> F64:
    """A gentle left turn at 8 m/s, the sensor 1.8 m above the road."""
    T = [geometry.from_xyz_rpy(0, 0, 1.8)]
    for _ in range(N - 1):
        T.append(T[-1] @ geometry.from_xyz_rpy(0.8, 0, 0, yaw=0.03))
    return np.stack(T)


@pytest.fixture(scope="module")
def scans() -> list[F64]:
    rng = np.random.default_rng(9)
    points = world()
    out = []
    for T in poses():
        local = geometry.transform(geometry.inverse(T), points)
        near = local[(np.linalg.norm(local, axis=1) < 40) & (np.linalg.norm(local, axis=1) > 3)]
        chosen = near[rng.random(len(near)) < 0.5]
        out.append(chosen + rng.normal(0, 0.02, chosen.shape))
    return out


def same(x: F64) -> F64:
    return x


def scaled(factor: float) -> Callable[[F64], F64]:
    def change(T: F64) -> F64:
        out = T.copy()
        out[:3, 3] *= factor
        return out

    return change


def transposed(T: F64) -> F64:
    out = T.copy()
    out[:3, :3] = T[:3, :3].T
    return out


def compass(T: F64) -> F64:
    return geometry.from_xyz_rpy(T[0, 3], T[1, 3], T[2, 3], yaw=np.pi / 2 - np.arctan2(T[1, 0], T[0, 0]))


def write(
    path: Path,
    scans: list[F64],
    pose: Callable[[F64], F64] = same,
    point: Callable[[F64], F64] = same,
    step_ns: int = 100_000_000,
) -> Path:
    writer = DriveWriter(path, "v", SENSORS["hdl32e"], start_ns=0).open()
    for i, scan in enumerate(scans):
        writer.write_scan(i, point(scan).astype(np.float32))
    writer.close(np.arange(N) * step_ns, np.stack([pose(T) for T in poses()]))
    return path


def serious(found: list[Finding]) -> list[str]:
    return [f.what for f in found if f.severity != "note"]


def test_a_healthy_drive_is_sound(tmp_path: Path, scans: list[F64]) -> None:
    found = diagnose(write(tmp_path / "d", scans)).findings
    assert serious(found) == []
    assert any("mistakes of the prior show from 31% of scale" in f.what for f in found), found  # 18 m, sigma 1 m
    assert serious(diagnose(tmp_path / "d", None, map_from_points(world())).findings) == []


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (geometry.inverse, "inverse poses"),
        (transposed, "transposed"),
        (compass, "compass bearing"),
        (scaled(1000), "millimetres"),
        (scaled(100), "centimetres"),
        (scaled(0.001), "kilometres"),
        (lambda T: CAMERA_TO_LIDAR.T @ T @ CAMERA_TO_LIDAR, "camera poses"),
        (lambda T: np.eye(4), "does not move"),
    ],
)
def test_a_prior_read_wrongly_is_named(
    tmp_path: Path, scans: list[F64], change: Callable[[F64], F64], name: str
) -> None:
    found = diagnose(write(tmp_path / "d", scans, pose=change)).findings
    assert any(name in what for what in serious(found)), found


@pytest.mark.parametrize(
    ("factors", "name"),
    [
        ((1, -1, 1), "left-handed"),
        ((1, -1, -1), "upside down"),
        ((-1, -1, 1), "face backwards"),
        ((1000, 1000, 1000), "millimetres"),
        ((100, 100, 100), "centimetres"),
    ],
)
def test_axes_and_units_of_points_are_named(
    tmp_path: Path, scans: list[F64], factors: tuple[float, float, float], name: str
) -> None:
    found = diagnose(write(tmp_path / "d", scans, point=lambda p: p * np.array(factors))).findings
    assert any(name in what for what in serious(found)), found


def test_points_in_camera_axes_are_named(tmp_path: Path, scans: list[F64]) -> None:
    found = diagnose(write(tmp_path / "d", scans, point=lambda p: p @ CAMERA_TO_LIDAR[:3, :3])).findings
    errors = [f.what for f in found if f.severity == "error"]
    assert errors == ["the points' axis -y points up (the road lies 1.8 m along its opposite), not z"]


@pytest.mark.parametrize(
    ("step_ns", "name"),
    [(100_000_000_000, "milliseconds, not seconds"), (100_000, "divided by 1000"), (450_000_000, "0.450 s apart")],
)
def test_units_of_times_are_named(tmp_path: Path, scans: list[F64], step_ns: int, name: str) -> None:
    found = diagnose(write(tmp_path / "d", scans, step_ns=step_ns)).findings
    assert any(name in f.what for f in found), found


def test_a_broken_prior_does_not_hide_other_ills(tmp_path: Path, scans: list[F64]) -> None:
    write(tmp_path / "d", scans, point=lambda p: p * np.array([1, -1, -1]))
    write_poses(tmp_path / "d" / "prior.txt", 2 * poses())
    what = " ".join(serious(diagnose(tmp_path / "d").findings))
    assert "not orthonormal" in what
    assert "upside down" in what


def test_jumps_bodies_and_thin_scans_are_named(tmp_path: Path, scans: list[F64]) -> None:
    jumping = poses()
    jumping[10, 0, 3] += 40.0
    write(tmp_path / "d", [np.concatenate([s[::90], 0.01 * s[::300] + [1.5, 0, 0]]) for s in scans])
    write_poses(tmp_path / "d" / "prior.txt", jumping)
    found = " ".join(serious(diagnose(tmp_path / "d").findings))
    for illness in ("jumps 2 times", "own body", "few for a hdl32e"):
        assert illness in found


@pytest.mark.parametrize(
    ("numbers", "name"),
    [(1 / 0.3048, "in feet"), (1 / 0.0254, "in inches"), (0.3048, "converted as if they were feet")],
)
def test_of_a_map_that_is_not_in_metres_the_unit_is_named(scans: list[F64], numbers: float, name: str) -> None:
    points = world()
    points = points[(np.abs(points[:, :2] - [8.0, 5.0]) < 30.0).all(axis=1)]
    stamps_ns = np.arange(N) * 100_000_000
    drive = Drive(Path("d"), "v", "d", SENSORS["hdl32e"], stamps_ns, lambda i: Scan(0, scans[i].astype(np.float32)))
    tiles = {}
    for index, mine in cut_tiles(numbers * points, Lattice()):
        empty = Tile.empty(Lattice().tile(index))
        tiles[index] = empty.but(points=empty.window.from_map(numbers * points[mine]))
    found = in_another_unit(MapEvidence(drive, poses(), PointMap("m", Lattice(), tiles)))
    assert found is not None
    assert name in found.what
    assert "fits 6 of 6 scans" in found.what


@pytest.mark.slow
def test_drive_and_map_that_do_not_belong_together(tmp_path: Path, scans: list[F64]) -> None:
    write(tmp_path / "d", scans)
    elsewhere = map_from_points(world() + np.array([5000.0, 0, 0]))
    assert "do not overlap" in serious(diagnose(tmp_path / "d", None, elsewhere).findings)[0]
    lower = map_from_points(world() - np.array([0, 0, 40.0]))
    assert (
        "shifted by 40.00 m (x -0.00, y +0.00, z -40.00" in serious(diagnose(tmp_path / "d", None, lower).findings)[0]
    )
    larger = map_from_points(1.04 * world())
    found = serious(diagnose(tmp_path / "d", None, larger).findings)
    assert any("scaled by 1.0" in what for what in found), found
    feet = map_from_points(world()[::4] / 0.3048)
    assert "the map is in feet" in serious(diagnose(tmp_path / "d", None, feet).findings)[0]
    bare = world()
    bare = bare[bare[:, 0] < -30]
    corner = map_from_points(np.concatenate([bare, [[10.0, 5.0, 0.0]]]))
    assert "fits the map nowhere" in serious(diagnose(tmp_path / "d", None, corner).findings)[0]


def test_nothing_there_is_one_error() -> None:
    found = diagnose(Path("/nowhere")).findings
    assert [f.severity for f in found] == ["error"]
