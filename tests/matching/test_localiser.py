"""A vehicle votes only from places that it has made sure of, and finds its place when what it was told is wrong."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mapvote.config import Settings
from mapvote.core.geometry import from_xyz_rpy, transform
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, PosePrior, Scan
from mapvote.matching.localiser import LOCALISATION, Localiser
from mapvote.matching.ndt_map import NdtMap
from mapvote.matching.odometry import Fix
from mapvote.matching.pose_check import Verdict
from streets import path, street, sweep, twist_of

SETTINGS = Settings()
POSES = path(12)


@pytest.fixture(scope="module")
def point_map() -> PointMap:
    """The street, with a kiosk and a hoarding that make its places differ."""
    return map_from_points(world(1, 2.0))


def world(seed: int, density: float) -> F64:
    rng = np.random.default_rng(seed)
    kiosk = rng.uniform((-6, 8, 0), (-3, 10, 3), (int(1500 * density), 3))
    hoarding = rng.uniform((14, -11, 0), (17, -8.5, 4), (int(1500 * density), 3))
    return np.concatenate([street(seed, density), kiosk, hoarding])


def scan(i: int) -> Scan:
    return sweep(world(100 + i, 0.6), POSES[i], twist_of(POSES, i), (i + 1) * 100_000_000)


def localiser(point_map: PointMap, matcher: str = "ndt") -> Localiser:
    settings = SETTINGS.model_copy(update={"ndt": SETTINGS.ndt.model_copy(update={"matcher": matcher})})
    return Localiser(point_map, settings, SENSORS["hdl32e"])


def told(T_map_lidar: F64) -> PosePrior:
    return PosePrior(T_map_lidar, 1.0, np.radians(1.0))


def drive(localiser: Localiser, priors: F64 | None, scans: Sequence[Scan] | None = None) -> list[Fix]:
    fixes = []
    for i, one in enumerate(map(scan, range(len(POSES))) if scans is None else scans):
        fixes += localiser.push(one, None if priors is None else told(priors[i]))
    return fixes + localiser.flush()


def off(fixes: list[Fix]) -> F64:
    """(n,) metres off the truth."""
    return np.array(
        [np.linalg.norm(fix.registration.T_map_lidar[:3, 3] - T[:3, 3]) for fix, T in zip(fixes, POSES, strict=False)]
    )


def test_scans_wait_until_several_agree_and_leave_at_once_when_the_track_holds(point_map: PointMap) -> None:
    one = localiser(point_map)
    assert [len(one.push(scan(i), told(POSES[i]))) for i in range(9)] == [0, 0, 3, 0, 0, 1, 1, 1, 1]
    assert all(fix.trusted and fix.standing.holds for fix in one.flush())


def test_scans_of_a_track_that_a_look_refutes_are_taken_back_and_those_before_the_last_good_look_are_not(
    point_map: PointMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = localiser(point_map)
    given = [fix for i in range(9) for fix in one.push(scan(i), told(POSES[i]))]
    misfit = one.misfit
    monkeypatch.setattr(one.judge, "holds", lambda verdict: False)
    assert not any(fix.trusted for fix in one.flush())
    assert [fix.standing.holds for fix in given] == [True] * 3 + [False] * 4
    np.testing.assert_array_equal(one.misfit, misfit, "what was taken back teaches nothing")


def test_scans_before_a_doubt_stand_if_a_look_at_the_last_of_them_holds(
    point_map: PointMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = localiser(point_map)
    given = [fix for i in range(9) for fix in one.push(scan(i), told(POSES[i]))]
    answers = iter([False, False, True, True])  # quickly, of the newest scan, then of that verdict; the same before it
    monkeypatch.setattr(one.judge, "holds", lambda verdict: next(answers))
    one.flush()
    assert all(fix.standing.holds for fix in given)


def test_a_track_that_leaps_is_doubted(point_map: PointMap, monkeypatch: pytest.MonkeyPatch) -> None:
    one = localiser(point_map)
    given = [fix for i in range(8) for fix in one.push(scan(i), told(POSES[i]))]
    localise = one.tracker.localise

    def leap(newest: Scan, prior: PosePrior | None) -> Fix:
        fix = localise(newest, prior)
        T_map_lidar = fix.registration.T_map_lidar @ from_xyz_rpy(3.0, 0.0, 0.0)
        return replace(fix, registration=replace(fix.registration, T_map_lidar=T_map_lidar))

    monkeypatch.setattr(one.tracker, "localise", leap)
    monkeypatch.setattr(one.judge, "holds", lambda verdict: False)
    one.push(scan(8), told(POSES[8]))
    assert [fix.standing.holds for fix in given] == [True] * 3 + [False] * 3


def test_a_look_comes_before_the_filter_of_moving_objects_lets_a_scan_go(
    point_map: PointMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    moving = SETTINGS.moving.model_copy(update={"lookahead_s": 0.25})
    one, looks = Localiser(point_map, SETTINGS.model_copy(update={"moving": moving}), SENSORS["hdl32e"]), list[int]()
    judge = one.judge.judge

    def counting(ndt_map: NdtMap, few: F64, T_map_lidar: F64, quick: bool = False) -> Verdict:
        looks[-1] += 1
        return judge(ndt_map, few, T_map_lidar, quick)

    monkeypatch.setattr(one.judge, "judge", counting)
    for i in range(9):
        looks.append(0)
        one.push(scan(i), told(POSES[i]))
    assert looks == [1, 1, 1, 0, 0, 1, 0, 0, 1]


@pytest.mark.parametrize(
    ("matcher", "shift"),
    [(matcher, shift) for matcher in ("ndt", "vgicp") for shift in ((0.0, 0.0), (-8.0, 0.0), (10.0, 0.0))]
    + [("ndt", (3.0, 4.0))],  # VGICP loses most drives so (docs/measurements/localisation.md)
)
def test_a_prior_metres_off_moves_no_vehicle_and_silences_none(
    point_map: PointMap, matcher: str, shift: tuple[float, float]
) -> None:
    """A steady error of it is learned."""
    one = localiser(point_map, matcher)
    fixes = drive(one, np.array([T @ from_xyz_rpy(*shift, 0.0) for T in POSES]))
    assert len(fixes) == len(POSES)
    assert all(fix.trusted for fix in fixes)
    assert off(fixes).max() < 0.15
    assert abs(one.misfit[0]) >= 0.5 * abs(shift[0]) - 0.1


def test_a_track_that_holds_is_looked_at_quickly_and_with_care_where_that_leaves_a_doubt(
    point_map: PointMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, looks = localiser(point_map), []
    judge = one.judge.judge

    def doubting(ndt_map: NdtMap, few: F64, T_map_lidar: F64, quick: bool = False) -> Verdict:
        looks.append(quick)
        verdict = judge(ndt_map, few, T_map_lidar, quick)
        return replace(verdict, lead=0.0) if quick else verdict

    monkeypatch.setattr(one.judge, "judge", doubting)
    assert all(fix.trusted for fix in drive(one, POSES))
    first = looks.index(True)
    assert first == LOCALISATION.checks, "before the place is confirmed nothing is saved"
    assert looks[first:] == [True, False] * (len(looks[first:]) // 2)


def test_without_any_prior_the_vehicle_is_found(point_map: PointMap) -> None:
    fixes = drive(localiser(point_map), None, [scan(i) for i in range(5)])
    assert all(fix.trusted for fix in fixes)
    assert off(fixes).max() < 0.15


def test_a_prior_that_faces_backwards_is_overruled_by_the_map(point_map: PointMap) -> None:
    back = np.array([T @ from_xyz_rpy(0, 0, 0, 0, 0, np.pi) for T in POSES])
    fixes = drive(localiser(point_map), back)
    trusted = np.array([fix.trusted for fix in fixes])
    assert trusted[-4:].all()
    assert off(fixes)[trusted].max() < 0.15


def test_a_vehicle_in_a_street_that_the_map_does_not_show_never_votes(point_map: PointMap) -> None:
    elsewhere = transform(from_xyz_rpy(0, 0, 0, 0, 0, 1.2), street(5, 0.6)[::2] * [1.0, 2.5, 1.0])
    lost = [sweep(elsewhere, POSES[i], np.zeros(6), (i + 1) * 100_000_000) for i in range(8)]
    assert [fix.trusted for fix in drive(localiser(point_map), POSES, lost)] == [False] * 8


def test_between_two_endless_walls_nobody_knows_how_far_along_he_is() -> None:
    def tunnel(seed: int, n: int) -> F64:
        rng = np.random.default_rng(seed)
        sides = [rng.uniform((-80, y, 0), (80, y + 0.02, 5), (n, 3)) for y in (-5, 5)]
        return np.concatenate([*sides, rng.uniform((-80, -5, -0.02), (80, 5, 0), (n, 3))])

    seen = [sweep(tunnel(10 + i, 20_000), POSES[i], twist_of(POSES, i), (i + 1) * 100_000_000) for i in range(5)]
    fixes = drive(localiser(map_from_points(tunnel(1, 60_000))), POSES, seen)
    assert not any(fix.trusted for fix in fixes)


def test_a_blind_scan_in_the_middle_does_not_vote_and_does_no_harm(point_map: PointMap) -> None:
    scans = [scan(i) for i in range(12)]
    scans[5] = Scan(scans[5].stamp_ns, np.zeros((0, 3), dtype=np.float32), np.zeros(0, dtype=np.float32))
    fixes = drive(localiser(point_map), POSES, scans)
    assert [i for i, fix in enumerate(fixes) if not fix.trusted] == [5]
    assert np.delete(off(fixes), 5).max() < 0.15


def test_the_queue_of_waiting_scans_is_bounded(point_map: PointMap) -> None:
    one = localiser(point_map)
    empty = np.zeros((0, 3), dtype=np.float32)
    out = [len(one.push(Scan(i * 100_000_000, empty), told(POSES[0]))) for i in range(60)]
    assert sum(out) == 60 - LOCALISATION.wait_scans
