"""A vehicle drives past a wall that was built and one that was taken down; its ballot says so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from hand_made import AtOnce, at_least, unpack_all
from mapvote.codec.ballot import (
    decode,
    encode,
    unpack_offer,
    unpack_points,
    unpack_states,
    unpack_sureness,
    unpack_tally,
)
from mapvote.codec.planes import unpack_sparse
from mapvote.config import FuseSettings, Settings, VotingSettings
from mapvote.core.grid import TILE_CELLS
from mapvote.core.point_map import PointMap, all_fields, all_points, map_from_points
from mapvote.core.reference import reference_window
from mapvote.core.sensors import SENSORS
from mapvote.core.types import F64, NO_VOTE, CellState, Drive, MapvoteError, PosePrior, Registration, Scan
from mapvote.fusion.fuse import update_map
from mapvote.matching.odometry import Fix
from mapvote.perception.frontend import DriveReport
from mapvote.vehicle import Cuts, RoadDriven, Vehicle, vote_in_stretches

RNG = np.random.default_rng(7)
SENSOR_HEIGHT = 1.8


def wall(x: float, y0: float, y1: float, n: int = 4000) -> F64:
    """Points on a wall that stands across x, 3 m high."""
    return np.column_stack([np.full(n, x), RNG.uniform(y0, y1, n), RNG.uniform(0.0, 3.0, n)])


def road() -> F64:
    xy = RNG.uniform(-30.0, 30.0, (40_000, 2))
    return np.column_stack([xy, np.zeros(len(xy))])


OLD, NEW, BACK = wall(8.25, -3.0, 0.0), wall(8.25, 2.0, 5.0), wall(20.25, -12.0, 12.0, 12_000)


def street_map() -> PointMap:
    return map_from_points(np.vstack([road(), OLD, BACK]))


def scan_of(x: float, i: int) -> tuple[Scan, F64]:
    """Points visible from (x, 0): the new wall, and the back wall where the new one does not hide it."""
    behind = BACK[~((BACK[:, 1] / (20.25 - x) * (8.25 - x) > 1.9) & (BACK[:, 1] / (20.25 - x) * (8.25 - x) < 5.1))]
    near_road = RNG.uniform([-5.0, -8.0], [7.9, 8.0], (8000, 2))
    points = np.vstack([NEW, behind, np.column_stack([near_road, np.zeros(len(near_road))])])
    T_map_lidar = np.eye(4)
    T_map_lidar[:3, 3] = x, 0.0, SENSOR_HEIGHT
    return Scan(i * 10**8, (points - T_map_lidar[:3, 3]).astype(np.float32)), T_map_lidar


def exactly(scan: Scan, prior: PosePrior | None) -> Fix:
    """The prior is the truth."""
    assert prior is not None
    return Fix(scan, Registration(prior.T_map_lidar, np.zeros((6, 6)), 1.0, 1.0, 0, True), np.zeros(6), True)


PAPER = Settings(voting=VotingSettings(method="paper"))


def make(point_map: PointMap, settings: Settings = PAPER, **more: Any) -> Vehicle:
    return Vehicle("v1", SENSORS["hdl32e"], point_map, settings, **{"localise": AtOnce(exactly), **more})


def drive(vehicle: Vehicle) -> Vehicle:
    for i in range(6):
        vehicle.observe(*scan_of(-1.0 + 0.1 * i, i))
    vehicle.finish()
    return vehicle


def state_at(vehicle: Vehicle, x: float, y: float) -> int:
    ballot = vehicle.ballot()
    for tile in ballot.tiles:
        grid = vehicle.point_map.lattice.tile(tile.tile)
        rows, cols, inside = grid.indices_of(np.array([[x, y]]))
        if inside[0]:
            assert tile.states is not None
            return int(unpack_states(tile.states)[rows[0], cols[0]])
    raise AssertionError("no tile there")


def test_a_ballot_tells_what_was_built_and_taken_down() -> None:
    vehicle = drive(make(street_map()))
    assert state_at(vehicle, 8.25, 3.5) == CellState.CHANGED_OCCUPIED
    assert state_at(vehicle, 8.25, -1.5) == CellState.CHANGED_EMPTY
    assert state_at(vehicle, 20.25, -2.0) == CellState.UNCHANGED_OCCUPIED
    assert state_at(vehicle, 4.0, 0.0) == CellState.UNCHANGED_EMPTY
    assert state_at(vehicle, 20.25, 9.0) == NO_VOTE, "scans abstain behind the new wall"


def test_by_surfaces_a_ballot_says_how_sure_it_is_of_every_changed_cell_and_by_no_other_method() -> None:
    told: dict[tuple[str, bool], set[bool]] = {}
    asked: list[tuple[Literal["surfaces", "paper"], bool]]
    asked = [("surfaces", True), ("surfaces", False), ("paper", True)]
    for method, stages in asked:
        voting = VotingSettings(method=method, two_stage=stages)
        ballot = decode(encode(drive(make(street_map(), Settings(voting=voting))).ballot()))
        unpack_all(ballot)
        told[method, stages] = {tile.odds is not None for tile in ballot.tiles}
        for tile in ballot.tiles if stages and method == "surfaces" else []:
            assert tile.states is not None
            states = unpack_states(tile.states)
            odds = unpack_sureness(tile.odds, states)
            assert odds is not None
            assert len(odds[1]) == np.isin(states, [CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY]).sum()
            if len(odds[1]) > 20:
                assert odds[1].max() > 0, "in the middle of a wall"
    assert told.pop(("surfaces", True)) == {True}
    assert set().union(*told.values()) == {False}


def test_new_points_lie_in_changed_occupied_cells_one_to_a_voxel() -> None:
    vehicle = drive(make(street_map()))
    total = 0
    for tile in vehicle.ballot().tiles:
        if tile.new_points is None:
            continue
        points = unpack_points(tile.new_points)
        assert tile.states is not None
        cells = np.floor(points.astype(np.float64) / 0.3).astype(int)
        states = unpack_states(tile.states)
        assert (states[cells[:, 1], cells[:, 0]] == CellState.CHANGED_OCCUPIED).all()
        assert len(np.unique(cells, axis=0)) == len(points)
        total += len(points)
    assert total >= 60  # ten columns of the wall, nine voxels above the ground in each, seen from inside the fan


@pytest.mark.parametrize("kind", [np.uint8, np.float32, None])
def test_new_points_have_the_sensors_intensity_if_the_map_holds_one(kind: type | None) -> None:
    """Old walls and roads are dark, the new wall is bright: 0.8 of the scale on which the map's points are."""
    point_map, dark = street_map(), 0.2 * (1.0 if kind is np.float32 else 255.0)
    if kind is not None:
        street = all_points(point_map)
        point_map = map_from_points(street, fields={"intensity": np.full(len(street), dark, dtype=kind)})
    vehicle = make(point_map)
    for i in range(6):
        scan, pose = scan_of(-1.0 + 0.1 * i, i)
        bright = np.where(np.arange(len(scan.points)) < len(NEW), 0.8, 0.2).astype(np.float32)
        vehicle.observe(replace(scan, fields={"intensity": bright}), pose)
    vehicle.finish()
    ballot = decode(encode(vehicle.ballot()))
    offers = [unpack_offer(tile.new_points, tile.fields) for tile in ballot.tiles if tile.new_points is not None]
    if kind is None:
        assert all(fields == {} for _, fields in offers)
        return
    assert {int(v) for _, fields in offers if fields for v in fields["intensity"]} == {204}
    after, _ = update_map(point_map, [ballot], FuseSettings(min_votes=1))
    new = np.abs(all_points(after)[:, 0] - 8.25) + np.abs(all_points(after)[:, 1] - 3.5) < 1.2
    found = all_fields(after)["intensity"][new & (all_points(after)[:, 2] > 0.3)]
    assert len(found) > 10
    np.testing.assert_allclose(found, 0.8 * (1.0 if kind is np.float32 else 255.0), atol=1e-6)


def test_the_paper_takes_no_new_points_from_beyond_its_local_grid_where_no_filter_looks() -> None:
    """The new wall stands 8.25 m ahead; a grid of 12 m ends before it."""
    narrow = VotingSettings(method="paper", window_m=12.0), VotingSettings(window_m=12.0)
    for voting, there in zip(narrow, (False, True), strict=True):
        points = drive(make(street_map(), Settings(voting=voting)))._new_points.by_tile()
        assert any((points((row, 0))[:, 0] > 8.0).any() for row in (-1, 0)) == there


def test_a_one_stage_ballot_carries_the_tally_and_leaves_the_decision_to_the_server() -> None:
    ballot = drive(make(street_map(), Settings(voting=VotingSettings(method="paper", two_stage=False)))).ballot()
    assert all(t.states is None and t.tally is not None for t in ballot.tiles)
    assert ballot.tiles[0].tally is not None
    assert unpack_tally(ballot.tiles[0].tally).shape == (TILE_CELLS, TILE_CELLS, 5)


def test_a_lost_scan_casts_no_vote() -> None:
    def lost_at_first(scan: Scan, prior: PosePrior | None) -> Fix:
        return replace(exactly(scan, prior), trusted=scan.stamp_ns >= 2 * 10**8)

    vehicle = make(street_map(), localise=AtOnce(lost_at_first))
    for i in range(2):
        vehicle.observe(*scan_of(-1.0, i))
    with pytest.raises(MapvoteError, match="none of 2 scans could be localised"):
        vehicle.ballot()
    vehicle.observe(*scan_of(-1.0, 2))
    with pytest.raises(MapvoteError, match="no scan has voted yet"):
        vehicle.ballot()
    vehicle.finish()
    assert vehicle.report.lost == [0, 1]
    assert vehicle.ballot().scans_localised == 1
    assert vehicle.ballot().scans == 3


@pytest.mark.slow
@pytest.mark.parametrize("method", ["paper", "surfaces"])
def test_asking_for_a_ballot_in_mid_drive_says_what_has_voted_so_far_and_changes_nothing(
    method: Literal["paper", "surfaces"],
) -> None:
    scans, point_map = [scan_of(-1.0 + 0.1 * i, i) for i in range(15)], street_map()
    asked, left_alone = (make(point_map, Settings(voting=VotingSettings(method=method))) for _ in range(2))
    for i, (scan, pose) in enumerate(scans):
        asked.observe(scan, pose)
        left_alone.observe(scan, pose)
        if i in (10, 14):  # the filter decides a scan when it has seen a second more
            assert encode(asked.ballot()) == encode(asked.ballot())
            assert (asked.ballot().scans, asked.ballot().scans_localised) == (i + 1, i - 9)
    asked.finish()
    left_alone.finish()
    said = encode(asked.ballot())
    assert said == encode(left_alone.ballot()), "and two vehicles with the same scans say the same bytes"
    assert asked.ballot().scans_localised == 15
    with pytest.raises(MapvoteError, match="this drive has ended"):
        asked.observe(*scans[0])
    asked.finish()
    assert encode(asked.ballot()) == said


def test_by_surfaces_a_ballot_tells_what_was_taken_down_and_which_voxels_are_gone() -> None:
    vehicle = drive(make(street_map(), Settings()))
    assert state_at(vehicle, 8.25, -1.5) == CellState.CHANGED_EMPTY
    assert state_at(vehicle, 20.25, -2.0) == CellState.UNCHANGED_OCCUPIED
    for tile in vehicle.ballot().tiles:
        assert tile.gone is not None
        assert tile.states is not None
        gone, states = at_least([unpack_sparse(tile.gone, "gone")], 1), unpack_states(tile.states)
        window = vehicle.point_map.lattice.tile(tile.tile)
        mapped = reference_window(vehicle.point_map, window).occupied
        assert not (gone & ~mapped).any()
        assert (gone[states != CellState.CHANGED_EMPTY] == 0).all()


def long_drive(n: int = 60) -> Drive:
    """Past the wall and back, 0.4 m a scan."""
    there = np.concatenate([np.linspace(-12.0, 0.0, n // 2), np.linspace(0.0, -12.0, n - n // 2)])
    seen = [scan_of(float(x), i) for i, x in enumerate(there)]
    stamps, prior = np.array([scan.stamp_ns for scan, _ in seen]), np.array([T for _, T in seen])
    return Drive(Path("d"), "v1", "d", SENSORS["hdl32e"], stamps, lambda i: seen[i][0], prior)


def test_a_drive_cut_into_ballots_has_every_scan_in_exactly_one_whenever_they_are_written() -> None:
    """The ballot of a stretch is fixed when it is cut: nothing that comes later changes a bit of it."""
    drive_, point_map, cuts = long_drive(), street_map(), Cuts(length_m=7.0)
    ballots = [stretch.written() for stretch in vote_in_stretches(drive_, make(point_map), cuts)]
    assert [ballot.drive for ballot in ballots] == ["d-001", "d-002", "d-003"]
    assert sum(ballot.scans_localised for ballot in ballots) == sum(b.scans for b in ballots) == len(drive_)
    assert [b.end_ns < later.start_ns for b, later in pairwise(ballots)] == [True] * 2
    assert all(6.5 < (b.length_m or 0.0) < 7.5 for b in ballots[:-1])
    later = [stretch.written() for stretch in list(vote_in_stretches(drive_, make(point_map), cuts))]
    assert list(map(encode, ballots)) == list(map(encode, later))


def test_a_ballot_is_closed_by_road_by_time_and_by_a_stop_whichever_comes_first() -> None:
    def closes(cuts: Cuts, x_of: Callable[[int], float]) -> int | None:
        report, road = DriveReport(), RoadDriven(cuts)
        for i in range(400):
            T = np.eye(4)
            T[0, 3] = x_of(i)
            report.stamps_ns.append(i * 10**9)
            report.T_map_lidar.append(T)
            if road.is_full(report, i + 1):
                return i
        return None

    assert closes(Cuts(length_m=100.0), float) == 100
    assert closes(Cuts(time_s=50.0), float) == 50
    assert closes(Cuts(), lambda i: float(min(i, 30))) == 30 + 120
    assert closes(Cuts(), lambda i: 0.01 * (i % 2)) is None, "who has not driven has not stopped"
    assert closes(Cuts(), float) is None
