"""The gate: a version that takes away what vehicles localise by is held; one that follows the street passes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapvote.config import GateSettings, NdtSettings
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.types import F64, Drive, MapvoteError, Scan
from mapvote_server.gate import Localised, compare, gate, gate_by, pass_or_hold
from mapvote_server.store.policy import GatePolicy
from streets import drive_along, path, street, sweep, twist_of

NDT, SETTINGS = NdtSettings(), GateSettings()


STREET, POSES = street(1), path(20, -10.0)


def without(low_x: float, high_x: float) -> F64:
    """The street without the house fronts between two places along it."""
    x, y = STREET[:, 0], np.abs(STREET[:, 1])
    return STREET[~((y > 11.0) & (x > low_x) & (x < high_x))]


def drive_through(world: F64) -> Drive:
    """Scans 1 m apart of what stands within 40 m, each of other points; priors off by up to half a metre."""
    errors = np.random.default_rng(2).uniform([-0.3, -0.3, -0.01], [0.3, 0.3, 0.01], (20, 3))
    prior = [T @ from_xyz_rpy(x, y, 0.0, yaw=yaw) for T, (x, y, yaw) in zip(POSES, errors.tolist(), strict=True)]

    def read_scan(i: int) -> Scan:
        some = world[np.random.default_rng(i).random(len(world)) < 0.5]
        return sweep(some, POSES[i], twist_of(POSES, i), int(drive.stamps_ns[i]))

    drive = drive_along(POSES, 1, np.stack(prior))
    return replace(drive, read_scan=read_scan)


def street_map(points: F64) -> PointMap:
    return map_from_points(points, map_id="street")


def run(old: F64, new: F64, world: F64) -> tuple[str, list[str]]:
    return gate(street_map(old), street_map(new), drive_through(world), SETTINGS, NDT)


def test_a_map_that_followed_when_a_house_was_lost_or_built_passes() -> None:
    gap = without(-22.0, 0.0)
    lost, built = run(STREET, gap, world=gap), run(gap, STREET, world=STREET)
    assert (lost[0], built[0]) == ("pass", "pass"), (lost, built)
    assert any(told.startswith("inlier share") and "(gain +0." in told for told in built[1])


def test_a_version_that_demolishes_houses_that_still_stand_is_held_and_says_why() -> None:
    wrong = without(-22.0, 22.0)
    verdict, reasons = run(STREET, wrong, world=STREET)
    assert verdict == "hold"
    assert any("inlier share" in reason for reason in reasons)


def test_a_drive_elsewhere_says_nothing() -> None:
    far = np.concatenate([STREET, [[500.0, 500.0, 1.0]]])
    verdict, reasons = run(STREET, far, world=STREET)
    assert verdict == "abstain"
    assert "only 0 of 20 scans" in reasons[0]
    assert "needs 20" in reasons[0]


def test_without_priors_or_with_another_map_it_says_what_to_do() -> None:
    street = street_map(STREET)
    with pytest.raises(MapvoteError, match="prior poses"):
        gate(street, street, replace(drive_through(STREET), T_map_lidar_prior=None), SETTINGS, NDT)
    with pytest.raises(MapvoteError, match="not versions of one map"):
        gate(street, replace(street, map_id="other"), drive_through(STREET), SETTINGS, NDT)


def pairs(gains: list[float]) -> list[tuple[Localised, Localised]]:
    """Scans that differ only in their inlier share."""
    return [(Localised(0.5, 0.8, 0.01, 1.0), Localised(0.5, 0.8 + gain, 0.01, 1.0)) for gain in gains]


@pytest.mark.parametrize(
    ("gains", "verdict"),
    [
        ([0.0] * 20, "pass"),
        ([-0.009] * 20, "pass"),
        ([-0.011] * 20, "hold"),
        ([0.1] * 20, "pass"),
        ([-0.2] * 5 + [0.06] * 15, "abstain"),
        ([-0.2] * 10 + [0.1] * 10, "hold"),
    ],
)
def test_within_tolerance_passes_worse_holds_and_between_it_abstains(gains: list[float], verdict: str) -> None:
    assert pass_or_hold(compare(pairs(gains), SETTINGS))[0] == verdict


def test_the_gate_judges_by_the_drive_that_the_policy_names(monkeypatch: pytest.MonkeyPatch) -> None:
    drives = {"/drives/ring": drive_through(STREET)}
    monkeypatch.setattr("mapvote_server.gate.open_drive", lambda path: drives[str(path)])
    asked = GatePolicy(drive="/drives/ring", **SETTINGS.model_dump())
    wrong = without(-22.0, 22.0)
    assert gate_by(NDT)(asked, street_map(STREET), street_map(wrong)) != []
    assert gate_by(NDT)(asked, street_map(STREET), street_map(STREET)) == []
