"""Where one more pass decides something: exactly the cells in which one more vote changes what is decided."""

from __future__ import annotations

import json
from pathlib import Path

import httpx2
import msgspec
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from command_line import typed
from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.codec.ballot import encode, pack_path
from mapvote.core.grid import TILE_CELLS, Lattice
from mapvote.core.types import NO_VOTE, U8, CellState
from mapvote.fusion.next_pass import Witness, one_vote_short, stretches
from mapvote_server.api.app import URL, in_process
from mapvote_server.store.store import Store

CO, CE = CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY
SAID = st.sampled_from([*map(int, CellState), NO_VOTE])


def decided(votes: list[int], quorum: int) -> int:
    """The decision of ``votes`` on a change of one cell, by the words of docs/method.md; NO_VOTE for none."""
    determined = [v for v in votes if v not in (NO_VOTE, CellState.UNDETERMINED)]
    for change in (CO, CE):
        if votes.count(change) >= quorum and 2 * votes.count(change) > len(determined):
            return int(change)
    return NO_VOTE


@given(st.lists(arrays(np.uint8, (2, 3), elements=SAID), min_size=1, max_size=5), st.integers(1, 3))
@settings(max_examples=150, deadline=None)
def test_a_cell_is_one_vote_short_if_one_more_vote_for_a_change_that_somebody_saw_decides_it(
    states: list[U8], quorum: int
) -> None:
    short = one_vote_short(states, quorum)
    for cell in np.ndindex(2, 3):
        votes = [int(said[cell]) for said in states]
        would = {c for c in (CO, CE) if c in votes and decided([*votes, int(c)], quorum) == c}
        would = set() if decided(votes, quorum) in would else would
        assert (int(short[cell]) in would) if would else short[cell] == NO_VOTE


def test_the_road_to_drive_is_that_of_the_vehicle_that_saw_the_change_in_its_direction() -> None:
    window = Lattice().tile((0, 0))
    nothing = np.full((TILE_CELLS, TILE_CELLS), NO_VOTE, np.uint8)
    saw = nothing.copy()
    saw[100, 100:110] = CE
    east = np.column_stack([np.arange(0.0, 75.0, 5.0), np.full(15, 25.0)])
    found = stretches(window, [Witness(saw, [east]), Witness(nothing, [east[::-1]])], quorum=2)
    assert [(s.heading_rad, s.cells, s.gone, s.built) for s in found] == [(0.0, 10, 10, 0)]
    assert found[0].path_m[0, 0] <= 30.0 < 33.0 <= found[0].path_m[-1, 0], "past the cells at 30 to 33 m"
    both = stretches(window, [Witness(saw, [east]), Witness(saw, [east[::-1]])], quorum=3)
    assert sorted(round(float(np.degrees(s.heading_rad))) for s in both) == [0, 180]
    assert not stretches(window, [Witness(saw, [east]), Witness(saw, [east])], quorum=2), "decided"


def test_a_store_tells_where_to_drive_as_its_server_does(tmp_path: Path) -> None:
    store = Store.create(f"sqlite:///{tmp_path / 'store.db'}", two_walls())
    cells = {(10, c): CE for c in range(10, 14)}
    ballot = make_ballot(two_walls(), {(0, 0): Say(states_plane(cells))}, "v1", "d1")
    path = [np.array([x, 6.0]) for x in np.arange(0.0, 20.0, 2.0)]
    ballot = msgspec.structs.replace(ballot, path=pack_path(path, store.lattice))
    with in_process(store, owner="kim") as transport, httpx2.Client(transport=transport, base_url=URL) as client:
        assert client.put("/v1/ballots/v1/d1", content=encode(ballot)).status_code == 201
        asked = client.get("/v1/coverage/passes").json()
    store.close()
    told = tmp_path / "next.geojson"
    typed("coverage", tmp_path / "store.db", "--out", told)
    assert json.loads(told.read_text()) == asked
    (feature,) = asked["features"]
    assert feature["properties"] == {"row": 0, "col": 0, "heading_deg": 0, "cells": 4, "built": 0, "gone": 4}
    assert feature["geometry"]["type"] == "LineString"
