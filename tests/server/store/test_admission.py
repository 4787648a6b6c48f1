"""Conditions on a ballot: founded on enough scans, borne out by its priors, within what can be and what its vehicle may
leave in the store. Unpacked votes are remembered, within bounds."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from hand_made import SHAPE, Say, make_ballot, make_map, make_tile, states_plane, two_walls, wall
from mapvote.codec.ballot import Ballot, Planes, encode
from mapvote.core.grid import TileIndex
from mapvote.core.types import CellState, MapvoteError
from mapvote.fusion.tile_vote import DAY_NS
from mapvote_server.api.problems import refuse
from mapvote_server.errors import TooMany
from mapvote_server.questions.history import events_after, newest_event
from mapvote_server.store.admission import Intake, Quota, Receipt
from mapvote_server.store.database import Remembered
from mapvote_server.store.examination import Examination, examine
from mapvote_server.store.place import refuse_out_of_reach
from mapvote_server.store.policy import Policy, RoundPolicy
from mapvote_server.store.store import Store
from stores import Clock


def ballot(**more: object) -> Ballot:
    says = {(0, 0): Say(states_plane({(10, 10): CellState.UNCHANGED_OCCUPIED}))}
    return msgspec.structs.replace(make_ballot(two_walls(), says), **more)


NAN, FAR = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"scans_localised": 1}, "only 1 of 10 scans were localised"),
        ({"scans_localised": 11}, "11 of 10 scans were localised: more than there are"),
        ({"prior_misfit_m": 9.8, "prior_sigma_m": 1.0}, r"held back.* 9\.8 m apart .* claim 1\.00 m"),
        ({"prior_misfit_m": NAN, "prior_sigma_m": 1.0}, "prior_misfit_m"),
        *(({"median_sigma_m": sigma_m}, r"median_sigma_m = .* is no distance") for sigma_m in (-0.01, NAN, FAR)),
    ],
)
def test_a_ballot_without_foundation_is_refused_or_held_back_and_told_so(more: dict[str, Any], why: str) -> None:
    with pytest.raises(MapvoteError, match=why):
        examine(encode(ballot(**more)))


@pytest.mark.parametrize(("misfit_m", "sigma_m"), [(None, None), (1.5, 1.0), (9.8, 10.0)])
def test_a_prior_unsaid_as_good_as_it_claims_or_openly_bad_is_no_reason_to_hold_back(
    misfit_m: float | None, sigma_m: float | None
) -> None:
    assert examine(encode(ballot(prior_misfit_m=misfit_m, prior_sigma_m=sigma_m))).ballot.length_m is None


@pytest.mark.parametrize("n", [64, 65])
def test_a_cell_has_64_voxels_and_no_more_new_points(n: int) -> None:
    plane = states_plane({(10, 10): CellState.CHANGED_OCCUPIED})
    say = Say(plane, new_points=wall([(10, 10)], list(np.linspace(0.4, 19.0, n))))
    sent = encode(make_ballot(two_walls(), {(0, 0): say}))
    with pytest.raises(MapvoteError, match="more than 64 points in one cell") if n > 64 else nullcontext():
        assert len(examine(sent).ballot.tiles) == 1


def at_height(z: float, tile: tuple[int, int] = (0, 0)) -> Ballot:
    say = Say(states_plane({(10, 10): CellState.CHANGED_OCCUPIED}), new_points=wall([(10, 10)], [z]))
    return make_ballot(two_walls(), {tile: say})


@pytest.mark.parametrize("tile", [(0, 0), (0, 2), (1, 1)])
def test_new_points_lie_at_a_height_where_something_can_be(tmp_path: Path, tile: tuple[int, int]) -> None:
    """The ground of the map lies at 0 m."""
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", two_walls())
    for z, taken in ((-11.0, False), (121.0, False), (-9.0, True), (119.0, True)):
        (answer,) = Intake(store).write([examine(encode(at_height(z, tile)))])
        told = "within 10 m below to 120 m above the map's lowest ground there, 0.0 m" in str(answer)
        assert (isinstance(answer, Receipt), told) == (taken, not taken)
    store.close()


def test_a_drive_is_no_older_than_the_map_and_not_of_tomorrow(tmp_path: Path) -> None:
    now = 1_700_000_000 * 10**9
    first = replace(two_walls(), surveyed_ns=now - 100)
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", first, clock=lambda: now)
    stamps = {now - 101: "before the map was surveyed", now + 301 * 10**9: "ends in the future"}
    for end_ns, why in stamps.items():
        (answer,) = Intake(store).write([examine(encode(ballot(start_ns=0, end_ns=end_ns)))])
        assert why in str(answer)
    for end_ns in (now - 100, now + 299 * 10**9):
        (answer,) = Intake(store).write([examine(encode(ballot(start_ns=0, end_ns=end_ns)))])
        assert isinstance(answer, Receipt), answer
    assert Store.open(f"sqlite:///{tmp_path / 's.db'}").point_map().surveyed_ns == now - 100
    store.close()


def drive(vehicle: str, name: str, tiles: int = 1) -> Examination:
    says = {(0, col): Say(states_plane({(3, 3): CellState.UNCHANGED_EMPTY})) for col in range(tiles)}
    return examine(encode(make_ballot(two_walls(), says, vehicle, name)))


def test_so_many_drives_a_day_each_vehicle_for_itself_and_a_restart_forgets_nothing(database_url: str) -> None:
    clock = Clock(1_800_000_000_000_000_000)
    store = Store.create(database_url, two_walls(), clock=clock)
    quota = Quota(drives_a_day=3, tiles_a_drive=2, stored_bytes=1 << 40)
    intake = Intake(store, quota)
    for i in range(3):
        assert isinstance(intake.write([drive("a", f"d{i}")])[0], Receipt)
    for again in (intake, Intake(store, quota)):
        (refused,) = again.write([drive("a", "d3")])
        assert isinstance(refused, TooMany)
        assert "try again tomorrow" in str(refused)
        assert refuse(refused, "/v1").headers["retry-after"] == "3600", "it is counted again once an hour"
        (repeated,) = again.write([drive("a", "d0")])
        assert isinstance(repeated, Receipt)
        assert repeated.result == "repeated"
    assert isinstance(intake.write([drive("b", "d0")])[0], Receipt)
    clock.now += DAY_NS + 1
    assert isinstance(intake.write([drive("a", "d3")])[0], Receipt)
    store.close()


@pytest.mark.contract
def test_so_many_tiles_a_drive_and_so_many_bytes_in_all(database_url: str) -> None:
    store = Store.create(database_url, two_walls())
    intake = Intake(store, Quota(drives_a_day=9, tiles_a_drive=2, stored_bytes=1 << 40))
    (refused,) = intake.write([drive("c", "d", tiles=3)])
    assert "3 tiles, the limit is 2" in str(refused)
    assert isinstance(intake.write([drive("c", "d", tiles=2)])[0], Receipt)
    one = drive("a", "d0")
    intake = Intake(store, Quota(drives_a_day=99, tiles_a_drive=9, stored_bytes=2 * one.size + 1))
    receipts = [intake.write([drive("a", f"d{i}")])[0] for i in range(3)]
    assert [isinstance(receipt, Receipt) for receipt in receipts] == [True, True, False]
    assert "bytes in the store" in str(receipts[2])
    store.close()


MAP = {(0, 0), (0, 1)}


def votes_on(*tiles: TileIndex, cell: tuple[int, int] | None = None) -> Mapping[TileIndex, bytes]:
    fill = CellState.UNCHANGED_EMPTY
    plane = states_plane(fill=fill) if cell is None else states_plane({cell: fill})
    return examine(encode(make_ballot(two_walls(), dict.fromkeys(tiles, Say(plane))))).spoken


@pytest.mark.parametrize("tile", [(0, 5), (-5, 0), (4000, 4000), (0, -5)])
def test_a_vote_at_the_other_end_of_the_world_is_not(tile: TileIndex) -> None:
    refused = refuse_out_of_reach(votes_on((0, 0), tile), MAP)
    assert refused is not None
    assert "more than 200 m from the map" in str(refused)


def test_it_is_the_cell_that_counts_not_its_tile() -> None:
    """Tile 0,4 begins 153.6 m from the map and ends 230.4 m from it: the limit is in its column 154."""
    assert refuse_out_of_reach(votes_on((0, 0), (0, 1), (0, 2), (1, 2), (-1, 0)), MAP) is None
    assert refuse_out_of_reach(votes_on((0, 1), (0, 3), (0, 4), cell=(0, 153)), MAP) is None
    assert refuse_out_of_reach(votes_on((0, 1), (0, 3), (0, 4), cell=(0, 155)), MAP) is not None


def test_one_drive_is_one_way() -> None:
    long_map = {(0, col) for col in range(40)}
    assert refuse_out_of_reach(votes_on(*[(0, col) for col in range(0, 40, 3)]), long_map) is None
    assert refuse_out_of_reach(votes_on((0, 1)), MAP) is None
    refused = refuse_out_of_reach(votes_on((0, 0), (0, 1), (0, 5), (0, 6)), long_map)
    assert refused is not None
    assert "send each part as a drive of its own" in str(refused)
    assert "0,5" in str(refused)


BYTES = SHAPE[0] * SHAPE[1]


def unpacked(state: int) -> Planes:
    return Planes(states=np.full(SHAPE, state, dtype=np.uint8))


def test_what_was_not_asked_for_longest_is_forgotten_first_and_never_more_is_kept_than_may_be() -> None:
    remembered = Remembered(2 * BYTES)
    remembered.put("a", unpacked(0))
    remembered.put("b", unpacked(1))
    assert remembered.get(["a", "c"]).keys() == {"a"}
    remembered.put("c", unpacked(2))
    remembered.put("a", unpacked(0))
    assert remembered.get("abc").keys() == {"a", "c"}
    assert remembered.bytes == 2 * BYTES
    for name in "defg":
        remembered.put(name, unpacked(3))
    assert remembered.get("abcdefg").keys() == {"f", "g"}
    remembered = Remembered(BYTES - 1)
    remembered.put("a", unpacked(0))
    assert (remembered.get("a"), remembered.bytes) == ({}, 0), "larger than all that may be kept"


ROW = make_map({(0, col): make_tile(wall([(3, 3)], [0.5]), index=(0, col)) for col in range(60)})


def far_drive(name: str, tile: TileIndex, end_s: float, vehicle: str = "v1") -> Examination:
    """Ten seconds on one tile of a map of 60 tiles in a row."""
    says = {tile: Say(states_plane({(3, 3): CellState.UNCHANGED_EMPTY}))}
    sent = make_ballot(ROW, says, vehicle, name, end_ns=round(end_s * 1e9))
    return examine(encode(msgspec.structs.replace(sent, start_ns=sent.end_ns - 10**10)))


@pytest.mark.parametrize(
    ("tile", "end_s", "vehicle", "told"),
    [
        ((0, 45), 1000.0, "v1", True),
        ((0, 45), 1005.0, "v1", True),
        ((0, 45), 1020.0, "v1", True),
        ((0, 45), 1070.0, "v1", False),
        ((0, 45), 5000.0, "v1", False),
        ((0, 10), 1000.0, "v1", False),
        ((0, 45), 1000.0, "v2", False),
    ],
)
@pytest.mark.parametrize("together", [True, False])
def test_one_key_at_two_places_at_the_same_time_is_told_to_the_operator(
    tmp_path: Path, tile: TileIndex, end_s: float, vehicle: str, told: bool, together: bool
) -> None:
    """Column 45 begins 3.4 km from column 0: a drive of the same vehicle there within a minute is not its own."""
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", ROW)
    before = newest_event(store)
    drives = [far_drive("d0", (0, 0), 1000.0), far_drive("d1", tile, end_s, vehicle)]
    for batch in [drives] if together else [[one] for one in drives]:
        assert all(isinstance(answer, Receipt) for answer in Intake(store).write(batch))
    events = events_after(store, before)
    warned = [event for event in events if event.kind == "two places"]
    assert len(warned) == told
    for event in warned:
        assert (event.actor, "3.4 km apart" in event.detail) == ("v1", True)
    assert [event.seq for event in events] == list(range(before + 1, before + 3 + told)), "the log has no gap"
    store.close()


def early(intake: Intake, sent: Ballot) -> str | None:
    refused = intake.refuse_early(Examination(encode(sent)))
    return None if refused is None else str(refused)


def test_an_envelope_is_refused_before_a_plane_is_unpacked_and_by_the_present_state(tmp_path: Path) -> None:
    clock = Clock(1_800_000_000_000_000_000)
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", two_walls(), clock=clock)
    intake = Intake(store, Quota(drives_a_day=2, tiles_a_drive=2, stored_bytes=1 << 40))
    says = Say(states_plane({(3, 3): CellState.UNCHANGED_EMPTY}))
    good = make_ballot(two_walls(), {(0, 0): says}, "a", "d0")
    refused = {
        "more than 200 m from the map": make_ballot(two_walls(), {(0, 9): says}, "a"),
        "3 tiles, the limit is 2": make_ballot(two_walls(), {(0, col): says for col in range(3)}, "a"),
        "uses method paper": make_ballot(two_walls(), {(0, 0): says}, "a", method="paper"),
        "no version 7 yet": make_ballot(two_walls(), {(0, 0): says}, "a", version=7),
        "the base of tile 0,0": make_ballot(two_walls(), {(0, 0): says}, "a", base={(0, 0): "f" * 64}),
        "ends in the future": make_ballot(two_walls(), {(0, 0): says}, "a", end_ns=clock.now + 10**12),
    }
    for broken in (b"", b"no frame", bytes(100)):
        for reason, ballot in refused.items():
            tiles = [msgspec.structs.replace(tile, states=broken) for tile in ballot.tiles]
            told = early(intake, msgspec.structs.replace(ballot, tiles=tiles))
            assert told is not None
            assert reason in told
    assert early(intake, good) is None
    for i in range(2):
        assert isinstance(intake.write([examine(encode(msgspec.structs.replace(good, drive=f"d{i}")))])[0], Receipt)
    assert "2 drives in 24 hours" in str(early(intake, msgspec.structs.replace(good, drive="d2")))
    assert early(intake, good) is None, "what stands already is answered by its receipt"
    store.set_policy(Policy(round=RoundPolicy(method="paper")))
    assert "drives in 24 hours" in str(early(intake, refused["uses method paper"])), "the policy of now holds"
    store.close()


def test_a_ballot_unpacked_in_slices_is_the_ballot_unpacked_at_once() -> None:
    says = {(0, col): Say(states_plane({(3, col): CellState.UNCHANGED_EMPTY})) for col in range(5)}
    data = encode(make_ballot(two_walls(), says, "a"))
    sliced, slices = Examination(data), 1
    while not sliced.go_on(0.0):
        slices += 1
    assert slices == 5
    assert vars(sliced) == vars(examine(data))
