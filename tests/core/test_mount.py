"""A mount that poses state is undone: x ahead, z up, and every point where it was in the map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.mount import mount_of_prior
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, Drive, Scan

POINTS = np.random.default_rng(1).uniform(-20, 20, (50, 3)).astype(np.float32)
ANGLES = st.integers(0, 359)
STEPS = st.sampled_from(range(0, 360, 45))


def driven(rpy_deg: tuple[int, int, int]) -> tuple[F64, F64]:
    """(C, poses T_map_lidar (30, 4, 4)) of a bend, uphill, whose prior errs by a degree; C turns the usual axes."""
    rng = np.random.default_rng(sum(rpy_deg))
    C = from_xyz_rpy(0, 0, 0, *np.radians(rpy_deg).tolist())
    T = [from_xyz_rpy(3, 4, 5, pitch=-0.03)]
    for _ in range(29):
        T.append(T[-1] @ from_xyz_rpy(0.7, 0, 0, yaw=0.01))
    errs = [from_xyz_rpy(0, 0, 0, *rng.normal(0, 0.01, 3).tolist()) for _ in T]
    return C, np.array([one @ err @ inverse(C) for one, err in zip(T, errs, strict=True)])


def drive_of(T: F64) -> Drive:
    stamps_ns = np.arange(len(T)) * 10**8
    scan = Scan(0, POINTS, origin=np.array([1.0, 0, 0]), others=((20, np.array([0.0, 2.0, 0.0])),))
    return Drive(Path("d"), "v", "d", SENSORS["hdl32e"], stamps_ns, lambda i: scan, T)


@given(st.tuples(ANGLES, ANGLES, ANGLES))
def test_turning_a_drive_moves_no_point_of_the_map(rpy_deg: tuple[int, int, int]) -> None:
    _, T = driven(rpy_deg)
    mount = mount_of_prior(T)
    if mount is None:
        return
    for one in (mount, mount.in_steps()):
        turned, drive = one.turned(drive_of(T)), drive_of(T)
        assert turned.T_map_lidar_prior is not None
        scan, own = turned.read_scan(3), drive.read_scan(3)
        assert np.allclose(transform(turned.T_map_lidar_prior[3], scan.points), transform(T[3], own.points), atol=1e-4)
        assert np.allclose(scan.origin_map(turned.T_map_lidar_prior[3]), own.origin_map(T[3]), atol=1e-6)
        assert np.allclose(scan.others[0][1], one.C[:3, :3] @ own.others[0][1])
        base = drive.T_map_lidar_prior[3] @ inverse(drive.T_base_lidar)  # type: ignore[index]
        assert np.allclose(turned.T_map_lidar_prior[3] @ inverse(turned.T_base_lidar), base)


@given(st.tuples(STEPS, STEPS, STEPS))
def test_mounts_in_steps_of_45_degrees_are_undone_to_the_last_digit(rpy_deg: tuple[int, int, int]) -> None:
    C, T = driven(rpy_deg)
    mount = mount_of_prior(T)
    undone = np.eye(4) if mount is None else mount.in_steps().C
    assert np.allclose(undone @ C, np.eye(4), atol=1e-9)


@pytest.mark.parametrize("rpy_deg", [(0, 0, 0), (5, 10, 0), (0, 0, 15)])
def test_a_sensor_in_the_usual_axes_is_left_alone(rpy_deg: tuple[int, int, int]) -> None:
    assert mount_of_prior(driven(rpy_deg)[1]) is None


def test_poses_without_a_steady_way_up_state_no_mount() -> None:
    tumbling = np.array([from_xyz_rpy(i, 0, 0, roll=0.5 * i) for i in range(20)])
    assert mount_of_prior(tumbling) is None


def test_a_vehicle_that_stands_states_what_is_up() -> None:
    standing = np.tile(from_xyz_rpy(0, 0, 0, roll=np.pi), (5, 1, 1))
    mount = mount_of_prior(standing)
    assert mount is not None
    assert mount.lean_deg == pytest.approx(180.0)
    assert np.allclose((standing @ inverse(mount.C))[:, 2, 2], 1.0)
