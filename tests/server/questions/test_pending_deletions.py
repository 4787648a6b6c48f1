"""Deletions beyond the policy's budget: a publish leaves them, desk and cell tell of them, surer vehicles end them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hand_made import Say, make_ballot, make_map, make_tile, states_plane, two_walls
from mapvote.codec.ballot import MOST_STEPS, STEPS_PER_NAT
from mapvote.config import FuseSettings
from mapvote.core.types import CellState, MapvoteError
from mapvote.fusion.loss_budget import change_probability
from mapvote_server.questions.changes import changes_between
from mapvote_server.questions.desk import desk, review
from mapvote_server.questions.explain import CellStory, explain_cell
from mapvote_server.store import schema
from mapvote_server.store.integrity import check
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.rollback import replay
from mapvote_server.store.store import Store
from stores import WALL, NewStore, send, vote_gone

BUDGET = Policy(fuse=FuseSettings(max_deleted_share=1.0, false_deletions=0.01))
SURE, UNSURE = [20, 20, 20], [20, -MOST_STEPS, 20]


@pytest.fixture
def store(new_store: NewStore) -> Store:
    return new_store(two_walls(), BUDGET)


def vote(store: Store, drive: str, sure: list[int], vehicles: str = "ab") -> None:
    """These say that the wall of the first tile is gone, and how sure they are of each of its cells."""
    vote_gone(store, vehicles, drive, odds=np.array(sure, dtype=np.int8))


def middle(store: Store) -> CellStory:
    return explain_cell(store, 11.5 * 0.3, 10.5 * 0.3)


def test_a_cell_beyond_the_budget_keeps_its_points_until_vehicles_are_surer(store: Store) -> None:
    vote(store, "d1", UNSURE)
    now = desk(store)
    assert [f.properties.cells for f in now.answer.pending.features] == [1, 1], "the two of which they are sure"
    (waits,) = now.answer.waiting
    assert waits.properties.kind == "demolished"
    assert waits.properties.drive_by == [3.45, 3.15], "the middle of the cell"
    assert waits.properties.false_deletion is not None
    assert waits.properties.false_deletion > 0.01
    assert "the policy allows 0.01" in str(waits.properties.waits)
    assert publish(store).points_deleted == 6
    story = middle(store)
    assert "pending: the probability that emptying it deletes something that stands" in story.thing
    assert "stands: surveyed" in story.thing
    assert [w.id for w in desk(store).answer.waiting] == [waits.id], "though nothing has come since"
    assert not publish(store).published
    for name in "ab":  # both drive by again, and are sure of the cell in the middle now
        say = Say(states_plane({WALL[1]: CellState.CHANGED_EMPTY}), odds=np.array([20], np.int8))
        send(store, make_ballot(store.point_map(), {(0, 0): say}, name, "d2", end_ns=store.clock()))
    assert desk(store).answer.waiting == []
    assert publish(store).points_deleted == 3


def test_what_waits_is_nothing_that_a_reviewer_decides_about(store: Store) -> None:
    vote(store, "d1", UNSURE)
    (waits,) = desk(store).answer.waiting
    with pytest.raises(MapvoteError, match="pending any more"):
        review(store, waits.id, "accepted", by="anna")


def test_the_desk_says_in_which_system_its_coordinates_lie(new_store: NewStore) -> None:
    place = {"crs": "EPSG:32654", "offset": "300000.0,3900000.0,0.0"}
    pending = desk(new_store(replace(two_walls(), georeference=place), BUDGET)).answer.pending
    assert pending.georeference == place
    assert "EPSG:32654" in pending.frame


def test_a_policy_without_a_budget_lets_it_go(store: Store) -> None:
    vote(store, "d1", UNSURE)
    store.change_policy({"fuse.false_deletions": "1"}, by="boss")
    assert store.policy().fuse.false_deletions == 1.0
    assert desk(store).answer.waiting == []
    assert publish(store).points_deleted == 9
    with pytest.raises(MapvoteError, match=r"policy: fuse\.false_deletions = '0'"):
        store.change_policy({"fuse.false_deletions": "0"}, by="boss")


def test_how_sure_they_were_is_told_of_cells_and_changes_and_outlives_the_round(store: Store) -> None:
    vote(store, "d1", SURE, "a")
    vote(store, "d1", [5, 5, 5], "b")
    assert publish(store).points_deleted == 9
    story = middle(store)
    assert [vote.sure for vote in story.votes] == [
        pytest.approx(1 / (1 + np.exp(-steps / STEPS_PER_NAT)), abs=1e-4) for steps in (20, 5)
    ]
    one = np.ones(1, np.int64)
    told = change_probability(
        np.array([CellState.CHANGED_EMPTY], np.uint8), 2 * one, 0 * one, one, np.array([5], np.int8)
    )
    assert story.probability == pytest.approx(told[0], abs=1e-3), "as the one says who is less sure"
    (change,) = changes_between(store, 1, 2).features
    assert change.properties.probability == pytest.approx(story.probability, abs=1e-3)
    assert check(store) == []
    with store.database.writing() as connection:
        connection.execute(schema.decisions.update().values(odds=None))
    assert {damage.kind for damage in check(store)} == {"decision"}, "its sum covers how sure they were"


def test_ballots_that_do_not_say_are_told_by_their_votes(store: Store) -> None:
    vote_gone(store)
    assert publish(store).points_deleted == 9
    assert [vote.sure for vote in middle(store).votes] == [None, None]
    assert middle(store).probability is not None


def test_a_round_without_a_vehicle_waits_as_it_would_have(store: Store) -> None:
    vote(store, "d1", SURE, "ab")
    vote(store, "d1", UNSURE, "c")
    assert publish(store).points_deleted == 9, "two of three are sure"
    replay(store, "a", dry_run=False)
    assert middle(store).thing == "stands: surveyed", "without the liar one of two was not"
    assert not store.point_map().tiles[0, 0].obstacle_words[WALL[0]], "of the cell beside both were"


def test_what_spilled_over_goes_with_its_wall_and_its_story_says_that_nothing_changed_there(
    new_store: NewStore,
) -> None:
    y, z = np.meshgrid(np.arange(40.05, 43.0, 0.3), np.arange(0.45, 3.0, 0.3))
    wall = np.column_stack([np.full(y.size, 30.04), y.ravel(), z.ravel()]).astype(np.float32)
    spill = wall[::3] + np.array([-0.05, 0.1, 0.0], np.float32)  # a centimetre beyond the cells' border
    point_map = make_map({(0, 0): make_tile(np.concatenate([wall, spill]))})
    store = new_store(point_map, Policy(fuse=FuseSettings(max_deleted_share=1.0)))
    cells = sorted({(int(p[1] // 0.3), int(p[0] // 0.3)) for p in np.concatenate([wall, spill]).tolist()})
    states, odds = states_plane(dict.fromkeys(cells, CellState.CHANGED_EMPTY)), np.full(len(cells), 20, np.int8)
    for name in "ab":
        ballot = make_ballot(store.point_map(), {(0, 0): Say(states, odds=odds)}, name, "d1", end_ns=store.clock())
        send(store, ballot)
    beside, there = (explain_cell(store, x, 41.55) for x in (29.85, 30.15))
    assert "noise of a change in the next cell" in beside.thing
    assert "noise of" not in there.thing
    assert publish(store).points_deleted == len(wall) + len(spill)
    told = [explain_cell(store, x, 41.55).decisions for x in (29.85, 30.15)]
    assert [[decision.state for decision in each] for each in told] == [["unchanged_empty"], ["changed_empty"]]
