"""A map tells whether the times of points straighten the scans of a drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mapvote.core.point_map import map_from_points
from mapvote.core.types import Drive, Scan, TimesTold
from mapvote.doctor.bent_scans import check_bent, window_for
from mapvote.matching.prepare import deskew
from streets import drive_along, path, street, twist_of

POSES = path(24)
MAP = map_from_points(street(1))
BENT = drive_along(POSES, 1)


def with_scans(change: Callable[[Scan, int], Scan], how: str = "none") -> Drive:
    told = TimesTold(how, "")  # type: ignore[arg-type]
    return replace(BENT, read_scan=lambda i: replace(change(BENT.read_scan(i), i), times=told))


def straight(scan: Scan, i: int) -> Scan:
    return replace(scan, points=deskew(scan, twist_of(POSES, i)))


def without(scan: Scan, _: int) -> Scan:
    return replace(scan, time_s=None)


def backwards(scan: Scan, _: int) -> Scan:
    assert scan.time_s is not None
    return replace(scan, time_s=-scan.time_s)


SOUND = {
    "bent, with its times": with_scans(lambda scan, _: scan, "field"),
    "straight, without times": with_scans(lambda scan, i: without(straight(scan, i), i)),
}
WRONG = {
    "bent, without times": (with_scans(without), "error: the points are not motion-compensated", "= false"),
    "bent, stated to be straight": (with_scans(without, "compensated"), "error: the points are not", "= false"),
    "bent, times backwards": (with_scans(backwards, "field"), "error: the times of points do not belong", '"none" and'),
    "straight, with times": (with_scans(straight, "field"), "error: the points are motion-compensated already", "true"),
    "bent, from azimuths of the wrong turn": (with_scans(backwards, "azimuth"), "error: the points are not", "false"),
}


@pytest.mark.parametrize("kind", SOUND)
def test_scans_that_are_straight_fit_best_as_they_are(kind: str) -> None:
    assert list(check_bent(SOUND[kind], list(POSES), window_for(MAP, True))) == []


@pytest.mark.parametrize("kind", WRONG)
def test_scans_that_are_bent_fit_better_with_other_times(kind: str) -> None:
    drive, what, mend = WRONG[kind]
    (finding,) = check_bent(drive, list(POSES), window_for(MAP, True))
    assert f"{finding.severity}: {finding.what}".startswith(what)
    assert mend in finding.mend
    assert "scans fit the map better" in finding.what


@pytest.mark.parametrize("kind", [*SOUND, *WRONG])
@pytest.mark.slow
def test_poses_of_a_prior_tell_the_same_unless_they_jump(kind: str) -> None:
    """The prior is off by .5 m, as satellites have it, and then jumps by .4 m from scan to scan."""
    drive = SOUND[kind] if kind in SOUND else WRONG[kind][0]
    prior = POSES.copy()
    prior[:, :2, 3] += [0.4, 0.3]
    found = list(check_bent(drive, list(prior), window_for(MAP, False)))
    assert [f.what for f in found] == [f.what for f in check_bent(drive, list(POSES), window_for(MAP, True))] or (
        len(found) == 1 and kind in WRONG and found[0].severity == WRONG[kind][1].split(":")[0]
    )
    prior[:, :2, 3] += np.random.default_rng(1).normal(0.0, 0.4, (len(prior), 2))
    assert kind in WRONG or list(check_bent(drive, list(prior), window_for(MAP, False))) == []


def test_a_slow_drive_a_short_one_and_one_of_no_rings_tell_nothing() -> None:
    drive = WRONG["bent, without times"][0]
    standing = np.tile(POSES[:1], (len(POSES), 1, 1))
    assert list(check_bent(drive, list(standing), window_for(MAP, True))) == []
    assert list(check_bent(drive, list(POSES[:2]), window_for(MAP, True))) == []
    ringless = replace(drive, sensor=replace(drive.sensor, rings=False))
    assert list(check_bent(ringless, list(POSES), window_for(MAP, True))) == []
