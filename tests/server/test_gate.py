"""The gate: a version that takes away what vehicles localise by is held; one that follows the street passes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import httpx2
import numpy as np
import pytest
from pydantic import ValidationError

from hand_made import two_walls
from live_server import serving_here
from mapvote.config import GateSettings, NdtSettings
from mapvote.core.geometry import from_xyz_rpy
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.types import F64, Drive, MapvoteError, Scan
from mapvote_server.gate import Localised, compare, gate, gate_by, pass_or_hold
from mapvote_server.store.keys import issue
from mapvote_server.store.policy import GatePolicy, Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import vote_gone
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
    drives = {"/srv/drives/north/ring": drive_through(STREET)}
    monkeypatch.setattr("mapvote_server.gate.open_drive", lambda path: drives[str(path)])
    asked = GatePolicy(drive="north/ring", **SETTINGS.model_dump())
    wrong = without(-22.0, 22.0)
    judge = gate_by(NDT, "/srv/drives")
    assert judge(asked, street_map(STREET), street_map(wrong)) != []
    assert judge(asked, street_map(STREET), street_map(STREET)) == []


def test_a_gate_drive_lies_below_the_folder_that_the_server_was_given(tmp_path: Path) -> None:
    """Nobody learns over HTTP which other paths exist, nor where the folder lies."""
    street = street_map(STREET)
    with pytest.raises(MapvoteError, match="start with --gate-drives DIR"):
        gate_by(NDT, "")(GatePolicy(drive="ring"), street, street)
    with pytest.raises(MapvoteError, match=r"^gate\.drive = ring, below the folder") as refused:
        gate_by(NDT, str(tmp_path))(GatePolicy(drive="ring"), street, street)
    assert str(tmp_path) not in str(refused.value)
    for name in ("/etc/passwd", "../ring", "a/../../ring", "..", "\0", "a//b", "C:\\ring"):
        with pytest.raises(ValidationError, match="below the folder of gate drives"):
            GatePolicy(drive=name)


def test_a_reader_learns_that_there_is_a_gate_and_not_its_drive(tmp_path: Path) -> None:
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", two_walls(), Policy(gate=GatePolicy(drive="north/ring")))
    vote_gone(store)
    publish(store, override=True, gate=lambda asked, old, new: [])
    keys = {role: issue(store, role, role) for role in ("reader", "reviewer")}
    store.close()
    seen = {}
    with serving_here(tmp_path / "s.db", log=tmp_path / "log") as url:
        for role, key in keys.items():
            bearer = {"Authorization": f"Bearer {key}"}
            asked = [httpx2.get(url + path, headers=bearer).json() for path in ("/v1/policy", "/v1/map/versions")]
            seen[role] = [asked[0]["policy"]["gate"]["drive"], asked[1]["versions"][-1]["policy"]["gate"]["drive"]]
    assert seen == {"reader": ["hidden", "hidden"], "reviewer": ["north/ring", "north/ring"]}
