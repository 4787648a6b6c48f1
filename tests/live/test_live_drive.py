"""A drive without an end, in one process: scans come as DDS would bring them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hand_made import make_map, make_tile, wall
from live.test_outbox import said
from mapvote.codec.ballot import Ballot, decode
from mapvote.core.point_map import PointMap, map_from_points
from mapvote.core.types import F64, Drive, MapvoteError, Scan
from mapvote.live.drive import Counts, FirstSeconds, LiveDrive, WaitingScan
from mapvote.live.outbox import OUTBOX_SIZES, Outbox, OutboxSizes, ballot_of
from mapvote.live.road_map import OneMap
from mapvote.live.thinning import THINNING, Thinning
from mapvote.vehicle import Cuts, Vehicle
from streets import drive_along, path, street

SCANS = 26


@cache
def recorded() -> tuple[PointMap, Drive, list[Scan], F64]:
    poses = path(SCANS)
    drive = drive_along(poses, 1, prior=poses)
    return map_from_points(street(1)), drive, list(drive), poses


class Live:
    """A live drive on the street, and the folder that its ballots go to."""

    def __init__(self, tmp_path: Path, sizes: OutboxSizes = OUTBOX_SIZES, **more: Any) -> None:
        self.point_map, drive, self.scans, self.poses = recorded()
        self.said: list[str] = []
        (tmp_path / "out").mkdir(exist_ok=True)
        self.outbox = Outbox(tmp_path / "state", "car", folder=tmp_path / "out", say=self.said.append, sizes=sizes)
        self.live = LiveDrive(
            lambda point_map: Vehicle("car", drive.sensor, point_map),
            more.pop("maps", OneMap(self.point_map)),
            self.outbox,
            name="day",
            **more,
        )

    def give(self, i: int, shift_ns: int = 0, read: Callable[[], Scan] | None = None) -> None:
        scan = self.scans[i]
        stamp_ns = 1_700_000_000 * 10**9 + scan.stamp_ns + shift_ns
        self.live.on_pose(stamp_ns, self.poses[i])
        moved = Scan(stamp_ns, scan.points, scan.time_s)
        self.live.on_scan(WaitingScan(stamp_ns, stamp_ns, read or (lambda: moved)))

    def drain(self) -> None:
        while self.live.step():
            pass

    def finish(self) -> Counts:
        self.live.finish()
        self.outbox.close()
        return self.live.counts


def test_every_other_scan_is_left_out_evenly_if_they_come_twice_as_fast_as_votes() -> None:
    thinning, waiting, admitted = Thinning(), 0.0, []
    for i in range(2000):
        thinning.cost(0.2)
        if thinning.admits(0.1 * i, int(waiting)):
            admitted.append(i)
            waiting += 1
        waiting = max(0.0, waiting - 0.5)
    gaps = [b - a for a, b in pairwise(admitted) if a > 200]
    assert 0.42 < len([i for i in admitted if i > 200]) / 1800 <= 0.51
    assert max(gaps) <= 3
    assert waiting < 35


def test_a_stop_of_two_seconds_costs_no_scan() -> None:
    thinning = Thinning()
    assert all(thinning.admits(0.1 * i, waiting) for i, waiting in enumerate([0] * 50 + list(range(20)) + [1] * 50))


@pytest.mark.parametrize("cost_s", [0.12, 0.4, 1.5])
def test_a_computer_that_becomes_too_slow_votes_with_scans_of_the_last_seconds_only(cost_s: float) -> None:
    """After ten seconds at 10 Hz each scan takes longer than the time between two."""
    thinning = Thinning()
    waiting = deque[float]()
    now_s = 0.0
    number = 0
    ages_s: list[float] = []
    left_out = 0
    while now_s < 180.0:
        while 0.1 * number <= now_s:
            if thinning.admits(0.1 * number, len(waiting)):
                waiting.append(0.1 * number)
            else:
                left_out += 1
            number += 1
        if not waiting:
            now_s += 0.01
            continue
        came_s = waiting.popleft()
        took_s = 0.03 if now_s < 10.0 else cost_s
        now_s += took_s
        ages_s.append(now_s - came_s)
        thinning.cost(took_s)
        left_out += thinning.shed(waiting)
    assert number == len(ages_s) + left_out + len(waiting), "each scan is counted once"
    assert max(ages_s) < 2.0 * THINNING.longest_s
    assert np.median(ages_s[len(ages_s) // 2 :]) < THINNING.longest_s + cost_s
    assert len(ages_s) * cost_s > 0.8 * 170.0, "the computer is used"


def test_one_slow_scan_such_as_a_search_of_the_map_costs_no_other() -> None:
    thinning = Thinning()
    for _ in range(20):
        thinning.cost(0.04)
    thinning.cost(8.0)
    waiting = deque(range(80))
    assert thinning.shed(waiting) == 0
    assert list(waiting) == list(range(80))


def test_scans_are_shed_evenly_and_the_oldest_and_newest_stay() -> None:
    thinning = Thinning()
    for _ in range(20):
        thinning.cost(0.6)
    waiting = deque(range(91))
    assert thinning.shed(waiting) == 81
    assert list(waiting) == list(range(0, 91, 10))


@pytest.mark.parametrize("checked", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_no_ballot_leaves_of_a_road_on_which_the_vehicle_did_not_know_where_it_was(
    tmp_path: Path, checked: bool
) -> None:
    """Scans and poses come in another order than they were driven: each finds its place, and the path leaps."""
    live = Live(tmp_path, first=FirstSeconds("stated") if checked else None)
    order = np.roll(np.arange(SCANS), SCANS // 2).tolist()
    scans, poses = [live.scans[k] for k in order], live.poses[order]
    live.poses = poses
    live.scans = [replace(scan, stamp_ns=live.scans[i].stamp_ns) for i, scan in enumerate(scans)]
    for i in range(SCANS):
        live.give(i)
        live.drain()
    live.live.first_findings()
    live.live.finish()
    live.outbox.close()
    assert len(list((tmp_path / "out").iterdir())) == (0 if checked else 1)
    assert not list((tmp_path / "state/car").glob("*.journal"))
    assert any("the localised path leaps" in line and "--unchecked" in line for line in live.said) == checked


def test_a_clock_that_jumps_back_or_ahead_closes_the_ballot_and_the_drive_goes_on(tmp_path: Path) -> None:
    hour = 3600 * 10**9
    live = Live(tmp_path)
    for i in range(SCANS):
        live.give(i)
    for shift_ns in (-hour, 2 * hour):
        for i in range(SCANS):
            live.give(i, shift_ns)
    counts = live.finish()
    assert (counts.clock_jumps, counts.late, counts.ballots, counts.scans) == (2, 4, 3, 3 * SCANS)
    assert said(tmp_path / "out") == {"day-001": SCANS, "day-002": SCANS - 2, "day-003": SCANS - 2}
    assert counts.localised + counts.lost == 3 * SCANS - 4
    assert counts.localised > 2 * SCANS


def test_the_journal_after_a_kill_holds_the_last_state_of_each_tile(
    tmp_path: Path,
) -> None:
    live = Live(tmp_path, OutboxSizes(journal_s=0.0))
    for i in range(SCANS):
        live.give(i)
    live.drain()
    while live.live._touched:
        live.live.step()
    assert live.live.vehicle is not None
    stated: Ballot = live.live.vehicle.ballot()
    live.outbox.close()  # what it was given is on disk; nobody finishes the drive
    found = ballot_of(tmp_path / "state/car/day-001.journal")
    assert found == stated


def test_a_scan_that_cannot_be_read_and_one_an_hour_off_are_two_scans_less_and_the_drive_goes_on(
    tmp_path: Path,
) -> None:
    def damaged() -> Scan:
        raise MapvoteError("cut off")

    live = Live(tmp_path)
    for i in range(SCANS):
        live.give(i, 3600 * 10**9 if i == 9 else 0, read=damaged if i == 5 else None)
    counts = live.finish()
    assert (counts.clock_jumps, counts.late, counts.unusable, counts.observed, counts.ballots) == (
        0,
        1,
        1,
        SCANS - 2,
        1,
    )
    assert live.live.latencies_s


def test_each_waiting_scan_finds_its_pose_in_odometry_of_500_hz(tmp_path: Path) -> None:
    live, period_ns = Live(tmp_path), 2_000_000
    first_ns = 1_700_000_000 * 10**9 + live.scans[0].stamp_ns
    live.live.on_pose(first_ns - period_ns, live.poses[0])
    for i in range(SCANS):
        live.give(i)
        for k in range(1, 50):
            live.live.on_pose(first_ns + i * 100_000_000 + k * period_ns, live.poses[i])
    counts = live.finish()
    assert (counts.without_pose, counts.observed) == (0, SCANS)


def test_a_new_version_of_the_map_holds_from_the_next_ballot_on(tmp_path: Path) -> None:

    class Versions:
        version = 1

        def current(self) -> PointMap:
            return replace(recorded()[0], version=self.version)

        def covers(self, position: F64 | None) -> bool:
            return True

    maps = Versions()
    live = Live(tmp_path, maps=maps, cuts=Cuts(length_m=4.0))
    for i in range(SCANS):
        maps.version = 1 + (i > 4)
        live.give(i)
        live.drain()
    counts = live.finish()
    versions = [decode(f.read_bytes()).version for f in sorted((tmp_path / "out").iterdir())]
    assert versions[0] == 1
    assert set(versions[1:]) == {2}
    assert counts.localised == SCANS


def test_computed_values_of_a_tile_are_dropped_300_m_away_and_its_points_stay() -> None:
    given = make_map({(0, c): make_tile(wall([(10, 10)], [0.05]), 0.0, (0, c)) for c in range(12)})
    maps = OneMap(given)
    tile, tiles = (0, 0), maps.current().tiles
    maps.covers(np.array([38.0, 38.0, 0.0]))
    assert "columns" not in tiles[tile].__dict__
    worked_out = tiles[tile].columns[0]
    maps.covers(np.array([300.0, 38.0, 0.0]))
    assert tiles[tile].columns[0] is worked_out
    maps.covers(np.array([800.0, 38.0, 0.0]))
    assert "columns" not in tiles[tile].__dict__ | given.tiles[tile].__dict__
    assert np.shares_memory(tiles[tile].points, given.tiles[tile].points)
