"""Checks of a drive once it is localised: sound ones pass, those that were never sure of their place do not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hand_made import make_map, make_tile, wall
from mapvote.core.geometry import exp, from_xyz_rpy
from mapvote.core.types import F64
from mapvote.doctor.localised import LocalisedDrive, check_localised

N = 60


def _drive(bend: float = 0.02, step_m: float = 0.8) -> LocalisedDrive:
    """A bend at 8 m/s, with a GNSS prior."""
    T = np.array([exp(k * np.array([step_m, 0, 0, 0, 0, bend])) for k in range(N)])
    prior = T.copy()
    prior[:, :3, 3] += np.random.default_rng(0).normal(0, 0.6, (N, 3))
    return LocalisedDrive(np.arange(N) * 10**8, T, np.ones(N, dtype=np.bool_), prior, 0.67, 1.0)


def found(drive: LocalisedDrive) -> list[str]:
    return [finding.what for finding in check_localised(drive)]


def _prior(change: Callable[[F64], F64]) -> LocalisedDrive:
    drive = _drive()
    assert drive.T_prior is not None
    return replace(drive, T_prior=change(drive.T_prior.copy()))


def _moved(T: F64, by: F64) -> F64:
    T[:, :3, 3] += by
    return T


def _scattered(sigma_m: float) -> LocalisedDrive:
    drive = _drive()
    off = np.random.default_rng(2).normal(0, sigma_m, (N, 3)) * [1.0, 1.0, 0.0]
    return replace(drive, T_map_lidar=_moved(drive.T_map_lidar.copy(), off))


def _jittered(sigma_s: float) -> LocalisedDrive:
    drive = _drive()
    off_ns = np.random.default_rng(3).normal(0, sigma_s * 1e9, N).clip(-45e6, 45e6).astype(np.int64)
    return replace(drive, stamps_ns=drive.stamps_ns + off_ns)


SOUND = {
    "a bend": _drive(),
    "a U-turn": _drive(bend=np.pi / N),
    "three rounds": _drive(bend=6 * np.pi / N),
    "standing": _drive(bend=0.0, step_m=0.0),
    "walking pace": _drive(step_m=0.05),
    "a prior 8 m beside": _prior(lambda T: _moved(T, np.array([6.0, -5.0, 3.0]))),
    "a prior that drifts by its sigma": _prior(lambda T: _moved(T, np.linspace(0, 2.0, N)[:, None] * [1.0, 0.5, 0.0])),
    "places 0.1 m off": _scattered(0.1),
    "no prior": replace(_drive(), T_prior=None),
    "a third of the scans lost": replace(_drive(), sure=np.arange(N) % 3 > 0),
    "short": replace(_drive(), stamps_ns=np.arange(5) * 10**8, sure=np.zeros(5, dtype=np.bool_)),
}


@pytest.mark.parametrize("kind", SOUND)
def test_a_sound_drive_raises_no_alarm(kind: str) -> None:
    assert found(SOUND[kind]) == []


def _leaping() -> LocalisedDrive:
    drive = _drive()
    order = np.array(sorted(range(N), key=str))
    return replace(drive, T_map_lidar=drive.T_map_lidar[order], T_prior=None)


def _swapped() -> LocalisedDrive:
    """Two halves of a drive in the wrong order: each is localised by itself."""
    drive = _drive()
    return replace(drive, T_map_lidar=np.roll(drive.T_map_lidar, N // 2, axis=0), T_prior=None)


@pytest.mark.parametrize(
    ("drive", "named"),
    [
        (replace(_drive(), sure=np.arange(N) % 3 == 0), "could be localised"),
        (_leaping(), "the localised path leaps"),
        (_jittered(0.04), "of the steps of the localised path need an acceleration"),
        (_swapped(), "the localised path leaps once before scan 30"),
        (_prior(lambda T: T[np.random.default_rng(1).permutation(N)]), "prior differ in length"),
        (_prior(lambda T: T @ from_xyz_rpy(0, 0, 0, yaw=np.pi / 2)), "attitude differs by 90 deg"),
        (_prior(lambda T: T @ from_xyz_rpy(0, 0, 0, roll=np.pi)), "attitude differs by 180 deg"),
        (_prior(lambda T: T[::-1]), "attitude differs|prior differ in length|about its mean offset"),
    ],
)
def test_a_drive_that_did_not_know_its_place_is_an_error(drive: LocalisedDrive, named: str) -> None:
    findings = list(check_localised(drive))
    assert any(np.any([word in one.what for word in named.split("|")]) for one in findings)
    assert all(one.severity == "error" and one.mend for one in findings)


@pytest.mark.parametrize(("height_m", "errors"), [(0.0, 1), (-1.5, 1), (0.3, 0), (1.9, 0)])
def test_rays_that_begin_on_the_road_are_an_error(height_m: float, errors: int) -> None:
    """Points in the frame of the vehicle have their origin on the road."""
    drive = replace(_drive(), T_prior=None)
    drive = replace(drive, T_map_lidar=_moved(drive.T_map_lidar.copy(), np.array([5.0, 5.0, height_m])))
    ground = make_map({(0, 0): make_tile(wall([(1, 1)], [0.05]))})
    findings = list(check_localised(drive, ground))
    assert [one.what for one in findings if "the origin of the points lies" in one.what] == [
        one.what for one in findings
    ]
    assert len(findings) == errors
