"""The gate: a version that takes away what vehicles localise by is held; one that follows the street passes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapvote.config import GateSettings, NdtSettings
from mapvote.core.geometry import from_xyz_rpy, inverse, transform
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, Drive, MapvoteError, Scan
from mapvote.server.store.policy import GatePolicy
from mapvote.server.views.localisation_gate import GateResult, Localised, compare, gate, gate_by, pass_or_hold

NDT, SETTINGS = NdtSettings(), GateSettings()


def box(x: float, y: float, width: float, depth: float, height: float, rng: np.random.Generator) -> F64:
    """Points on the four walls of a house, 25 a square metre."""
    points = []
    for (x0, y0), (x1, y1) in (
        ((x, y), (x + width, y)),
        ((x + width, y), (x + width, y + depth)),
        ((x + width, y + depth), (x, y + depth)),
        ((x, y + depth), (x, y)),
    ):
        n = int(25 * height * max(abs(x1 - x0), abs(y1 - y0)))
        t = rng.random(n)
        points.append(np.column_stack([x0 + t * (x1 - x0), y0 + t * (y1 - y0), rng.random(n) * height]))
    return np.concatenate(points)


def houses(rng: np.random.Generator) -> list[F64]:
    """A street along x: a house every 15 m on both sides, none like the other."""
    row = []
    for x in np.arange(-45.0, 46.0, 15.0):
        for side in (-1, 1):
            y = side * rng.uniform(9.0, 12.0)
            row.append(
                box(x + rng.uniform(0, 3), min(y, y + side * 8.0), rng.uniform(6, 11), 8.0, rng.uniform(4, 9), rng)
            )
    return row


def road(rng: np.random.Generator) -> F64:
    xy = rng.uniform([-60.0, -9.0], [60.0, 9.0], (20_000, 2))
    return np.column_stack([xy, np.zeros(len(xy))])


RNG = np.random.default_rng(1)
HOUSES, ROAD = houses(RNG), road(RNG)
STREET = np.concatenate([ROAD, *HOUSES])


def drive_through(world: F64, n: int = 20) -> Drive:
    """Scans 1 m apart of what stands within 40 m, with 2 cm of noise; priors off by up to half a metre."""
    rng = np.random.default_rng(2)
    true = [from_xyz_rpy(x, 0.0, 1.8, 0.0, 0.0, 0.0) for x in np.linspace(-10.0, 9.0, n)]

    def read_scan(i: int) -> Scan:
        near = world[np.linalg.norm(world[:, :2] - true[i][:2, 3], axis=1) < 40.0]
        seen = near[np.random.default_rng(i).random(len(near)) < 0.3]
        points = transform(inverse(true[i]), seen) + np.random.default_rng(i).normal(0, 0.02, seen.shape)
        return Scan(i * 10**8, points.astype(np.float32))

    errors = rng.uniform([-0.3, -0.3, -0.01], [0.3, 0.3, 0.01], (n, 3))
    prior = [
        T @ from_xyz_rpy(float(x), float(y), 0.0, yaw=float(yaw)) for T, (x, y, yaw) in zip(true, errors, strict=True)
    ]
    return Drive(
        path=Path("reference"),
        vehicle="operator",
        drive_id="r1",
        sensor=SENSORS["hdl32e"],
        stamps_ns=np.arange(n, dtype=np.int64) * 10**8,
        read_scan=read_scan,
        T_map_lidar_prior=np.stack(prior),
    )


def street_map(points: F64) -> PointMap:
    return map_from_points(points, map_id="street")


def run(old: F64, new: F64, world: F64) -> GateResult:
    return gate(street_map(old), street_map(new), drive_through(world), SETTINGS, NDT)


def test_a_map_that_followed_when_a_house_was_lost_or_built_passes() -> None:
    without = np.concatenate([ROAD, *HOUSES[:7], *HOUSES[8:]])
    lost, built = run(STREET, without, world=without), run(without, STREET, world=STREET)
    assert (lost.verdict, lost.scans_compared, built.verdict) == ("pass", 20, "pass"), (lost.reasons, built.reasons)
    assert {m.name: m.gain for m in built.measures}["inlier share"] > 0.0


def test_a_version_that_demolishes_houses_that_still_stand_is_held_and_says_why() -> None:
    wrong = np.concatenate([ROAD, *HOUSES[:4], *HOUSES[10:]])
    result = run(STREET, wrong, world=STREET)
    assert result.verdict == "hold"
    assert any("inlier share" in reason for reason in result.reasons)


def test_a_drive_elsewhere_says_nothing() -> None:
    far = np.concatenate([STREET, [[500.0, 500.0, 1.0]]])
    result = run(STREET, far, world=STREET)
    assert result.verdict == "abstain"
    assert "only 0 of 20 scans" in result.reasons[0]
    assert "needs 20" in result.reasons[0]


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
    monkeypatch.setattr("mapvote.server.views.localisation_gate.open_drive", lambda path: drives[str(path)])
    asked = GatePolicy(drive="/drives/ring", **SETTINGS.model_dump())
    wrong = np.concatenate([ROAD, *HOUSES[:4], *HOUSES[10:]])
    assert gate_by(NDT)(asked, street_map(STREET), street_map(wrong)) != []
    assert gate_by(NDT)(asked, street_map(STREET), street_map(STREET)) == []
