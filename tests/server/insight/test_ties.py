"""A vote that ties says the same on the page, in the story and in the decision: undetermined."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hand_made import Say, make_ballot, two_walls
from mapvote.codec.ballot import encode
from mapvote.core.types import N_STATES, NO_VOTE, CellState
from mapvote.core.voting import VOTE_UNIT
from mapvote.server.insight.clouds import evidence
from mapvote.server.insight.explain import explain_cell, states_of
from mapvote.server.store.admission import Intake, examine
from mapvote.server.store.ballots import Receipt
from mapvote.server.store.fusion_jobs import unpack_tally_plane
from mapvote.server.store.policy import Policy, RoundPolicy
from mapvote.server.store.publish import preview
from mapvote.server.store.store import Store

TIE, CLEAR = (10, 10), (10, 11)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    policy = Policy(round=RoundPolicy(stage="one-stage"))
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", two_walls(), policy)
    yield store
    store.close()


def test_a_tie_of_a_one_stage_ballot_is_undetermined_everywhere(store: Store) -> None:
    tally = np.zeros((256, 256, N_STATES), dtype=np.uint16)
    for state in (CellState.UNCHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        tally[TIE][state] = 3 * VOTE_UNIT
    tally[CLEAR][CellState.CHANGED_EMPTY] = 3 * VOTE_UNIT
    ballot = make_ballot(store.point_map(), {(0, 0): Say(tally=tally)}, end_ns=store.clock())
    (receipt,) = Intake(store).accept([examine(encode(ballot))])
    assert isinstance(receipt, Receipt), receipt
    said = [explain_cell(store, (c + 0.5) * 0.3, (r + 0.5) * 0.3).votes[0].state for r, c in (TIE, CLEAR)]
    assert said == ["undetermined", "changed_empty"]
    page = evidence(store, (0, 0))
    assert [page[TIE][3], page[CLEAR][3]] == [NO_VOTE, CellState.CHANGED_EMPTY]
    (fused,) = preview(store).fused
    assert unpack_tally_plane(fused.tally)[TIE].any()
    assert states_of(fused.states)[TIE] == CellState.UNDETERMINED
