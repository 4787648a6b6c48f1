"""Voxels trimmed beside a wall that stands: who voted for it is told at the desk, in the log and of the cell."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hand_made import Say, make_ballot, states_plane, two_walls, words_plane
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote.fusion.decision_record import pack_edit_votes, unpack_edit_votes
from mapvote.fusion.edit import EditVotes
from mapvote_server.questions.changes import changes_between
from mapvote_server.questions.desk import desk
from mapvote_server.questions.explain import Edit, explain_cell
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import NewStore, send

CELL = (10, 10)
STANDS = CellState.UNCHANGED_OCCUPIED


@pytest.fixture
def store(new_store: NewStore) -> Store:
    """Three of four vehicles call two voxels of a standing cell gone, the third one of them only."""
    store = new_store(two_walls(), Policy(fuse=FuseSettings(max_deleted_share=1.0)))
    for name, mask in (("a", 0b1100), ("b", 0b1100), ("c", 0b1100), ("d", 0b1000)):
        say = Say(states_plane({CELL: STANDS}), gone=words_plane({CELL: mask}))
        now = store.clock()
        send(store, make_ballot(store.point_map(), {(0, 0): say}, name, "d1", now))
    return store


def test_the_desk_names_it_and_counts_the_votes_on_its_voxels(store: Store) -> None:
    (change,) = desk(store).answer.pending.features
    told = change.properties
    assert (told.kind, told.cells, told.trimmed, told.points) == ("demolished", 1, 1, 2)
    assert (told.votes_min, told.votes_median, told.against_median) == (3, 3.0, 1.0)
    assert "trimmed: the cell stands, and 3 of 4 vehicles" in explain_cell(store, 3.1, 3.1).thing


def test_log_and_cell_name_who_voted_for_it_once_it_is_published(store: Store) -> None:
    assert publish(store).points_deleted == 2
    (change,) = changes_between(store, 1, 2).features
    told = change.properties
    assert (told.trimmed, told.votes_min, told.against_median, told.versions) == (1, 3, 1.0, [2])
    assert told.first_seen is not None
    assert told.probability is None, "the curve knows cells that change, not cells that stand"
    story = explain_cell(store, 3.1, 3.1)
    (decision,) = story.decisions
    assert (decision.state, decision.edit) == ("unchanged_occupied", Edit("changed_empty", 3, 1))
    assert [vote.marks for vote in story.votes] == [2, 2, 2, 1]


@given(st.lists(st.tuples(st.integers(0, 65535), st.sampled_from([2, 3]), *[st.integers(0, 10_000)] * 2)))
def test_edit_votes_come_back_as_they_were(rows: list[tuple[int, int, int, int]]) -> None:
    unique = sorted({row[0]: row for row in rows}.values())
    columns = np.array(unique, dtype=np.int64).reshape(-1, 4).T
    edits = EditVotes(columns[0], *(columns[k].astype(t) for k, t in ((1, np.uint8), (2, np.int32), (3, np.int32))))
    packed = pack_edit_votes(edits)
    assert (packed is None) == (not rows)
    back = EditVotes.none() if packed is None else unpack_edit_votes(packed)
    assert all(getattr(back, name).tolist() == getattr(edits, name).tolist() for name in EditVotes.__slots__)
