"""How much one vehicle may leave in a store, on SQLite and on PostgreSQL."""

from __future__ import annotations

import pytest

from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.codec.ballot import encode
from mapvote.core.types import CellState
from mapvote.fusion.tile_vote import DAY_NS
from mapvote.server.errors import TooMany
from mapvote.server.http.schemas import refuse
from mapvote.server.store.admission import Incoming, Intake, Quota, Receipt, examine
from mapvote.server.store.store import Store
from standing_clock import Clock


def drive(vehicle: str, name: str, tiles: int = 1) -> Incoming:
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
        assert refuse(refused).headers["retry-after"] == "3600", "it is counted again once an hour"
        (repeated,) = again.write([drive("a", "d0")])
        assert isinstance(repeated, Receipt)
        assert repeated.result == "repeated"
    assert isinstance(intake.write([drive("b", "d0")])[0], Receipt)
    clock.now += DAY_NS + 1
    assert isinstance(intake.write([drive("a", "d3")])[0], Receipt)
    store.close()


def test_so_many_tiles_a_drive(database_url: str) -> None:
    store = Store.create(database_url, two_walls())
    intake = Intake(store, Quota(drives_a_day=9, tiles_a_drive=2, stored_bytes=1 << 40))
    (refused,) = intake.write([drive("a", "d", tiles=3)])
    assert "3 tiles, the limit is 2" in str(refused)
    assert isinstance(intake.write([drive("a", "d", tiles=2)])[0], Receipt)
    store.close()


@pytest.mark.contract
def test_so_many_bytes_in_all(database_url: str) -> None:
    store = Store.create(database_url, two_walls())
    one = drive("a", "d0")
    intake = Intake(store, Quota(drives_a_day=99, tiles_a_drive=9, stored_bytes=2 * one.size + 1))
    receipts = [intake.write([drive("a", f"d{i}")])[0] for i in range(3)]
    assert [isinstance(receipt, Receipt) for receipt in receipts] == [True, True, False]
    assert "bytes in the store" in str(receipts[2])
    store.close()
