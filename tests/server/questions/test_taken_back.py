"""A change that no vehicle voted for, because a rollback took a decision back, is called so at every place."""

from __future__ import annotations

from pathlib import Path

from command_line import typed
from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote_server.questions.changes import changes_between, page_between
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.rollback import rollback
from stores import NewStore, send


def test_a_rollback_is_told_as_no_vote(new_store: NewStore, tmp_path: Path) -> None:
    store = new_store(two_walls(), Policy(fuse=FuseSettings(max_deleted_share=1.0)))
    for name in "abc":
        say = Say(states_plane({(10, col): CellState.CHANGED_EMPTY for col in range(10, 14)}))
        send(store, make_ballot(store.point_map(), {(0, 0): say}, name, "d1", store.clock()))
    assert publish(store).points_deleted
    rollback(store, 1)
    voted, taken_back = changes_between(store, 1, 2), changes_between(store, 2, 3)
    assert [f.properties.votes_min for f in voted.features] == [3]
    assert [f.properties.kind for f in taken_back.features] == ["built"]
    assert "taken back" not in typed("log", tmp_path / "s.db", "--from", 1, "--to", 2)
    told = typed("log", tmp_path / "s.db", "--from", 2, "--to", 3)
    assert "none: taken back" in told
    assert "no vehicle voted for it, a rollback or a replay took" in told
    assert "no votes: a rollback or replay took a decision back" in page_between(store, 2, 3, taken_back)
