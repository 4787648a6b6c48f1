"""The doctor looks at a ballot and at a store by themselves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest
import sqlalchemy as sa

from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.codec.ballot import encode
from mapvote.core.types import CellState
from mapvote.doctor.diagnosis import check_ballot, check_store
from mapvote.server.store import schema
from mapvote.server.store.keys import issue
from mapvote.server.store.store import Store

SAME, GONE = int(CellState.UNCHANGED_OCCUPIED), int(CellState.CHANGED_EMPTY)


def told(fill: int = SAME, **said: Any) -> list[str]:
    ballot = make_ballot(two_walls(), {(0, 0): Say(states_plane({(3, 4): GONE}, fill=fill))})
    return [f.what for f in check_ballot(encode(msgspec.structs.replace(ballot, **said)))]


def test_a_sound_ballot_is_not_blamed() -> None:
    assert told() == []


@pytest.mark.parametrize(
    ("said", "name"),
    [
        ({"end_ns": 0}, "the drive ends before it begins"),
        ({"scans_localised": 3}, "only 3 of 10 scans were localised"),
        ({"median_sigma_m": 0.4}, "knew where it was to 0.40 m only"),
        ({"prior_misfit_m": 2.0, "prior_sigma_m": 0.1}, "2.0 m off its prior"),
        ({"tiles": []}, "votes on no tile"),
        ({"fill": GONE}, "judges changed"),
    ],
)
def test_what_is_wrong_with_a_ballot_is_named(said: dict[str, Any], name: str) -> None:
    assert any(name in what for what in told(**said)), told(**said)


def test_a_ballot_cut_off_is_an_error() -> None:
    data = encode(make_ballot(two_walls(), {(0, 0): Say(states_plane())}))
    assert [f.severity for f in check_ballot(data[:-9])] == ["error"]


def test_a_store_is_read_to_the_last_byte(tmp_path: Path) -> None:
    store = Store.create(f"sqlite:///{tmp_path}/s.db", two_walls())
    try:
        assert any("no operator has a valid key" in f.what for f in check_store(store))
        issue(store, "boss", "operator")
        found = check_store(store)
        assert not [f for f in found if f.severity == "error"]
        assert any("version 1: 2 tiles, 0 ballots" in f.what for f in found)
        with store.database.writing() as connection:
            connection.execute(sa.update(schema.blobs).values(data=b"damaged"))
        errors = [f for f in check_store(store) if f.severity == "error"]
        assert any("damaged: plane" in f.what for f in errors)
        assert all("mapvote check STORE --mend" in f.mend for f in errors[:3])
    finally:
        store.close()
