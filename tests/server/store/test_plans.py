"""However large a store grows: what is asked often reads by an index what it needs, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.config import FuseSettings
from mapvote.core.types import CellState
from mapvote_server.questions.changes import changes_between
from mapvote_server.questions.coverage import waiting_votes, wanted_passes
from mapvote_server.questions.vehicles import vehicle_standings
from mapvote_server.store.admission import Intake
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import publish
from mapvote_server.store.store import Store
from stores import send

LARGE = ("ballots", "ballot_tiles", "version_tiles", "blobs", "decisions", "events")
"""Tables that grow with the fleet, the map and time."""


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    """A publish has been, and one tile has new votes."""
    store = Store.create(
        f"sqlite:///{tmp_path / 's.db'}", two_walls(), Policy(fuse=FuseSettings(max_deleted_share=1.0))
    )
    intake = Intake(store)
    vote(store, intake, "d1", (10, 10))
    assert publish(store).published
    vote(store, intake, "d2", (10, 11))
    yield store
    store.close()


def vote(store: Store, intake: Intake, drive: str, cell: tuple[int, int], vehicles: str = "ab") -> None:
    say = Say(states_plane({cell: CellState.CHANGED_EMPTY}))
    base = store.point_map()
    send(intake, *[make_ballot(base, {(0, 0): say}, vehicle, drive) for vehicle in vehicles])


def scans(store: Store, act: Callable[[], object]) -> list[str]:
    """The plan of every statement that reads the whole of a large table, by the database's own account."""
    found: list[str] = []

    def explain(_: Any, cursor: Any, statement: str, parameters: Any, *__: Any) -> None:
        if not statement.lstrip().upper().startswith(("SELECT", "UPDATE", "DELETE")):
            return
        asked = cursor.connection.cursor()
        plan = asked.execute(f"EXPLAIN QUERY PLAN {statement}", parameters).fetchall()
        found.extend(f"{row[3]}: {statement[:200]}" for row in plan if reads_all(row[3]))

    sa.event.listen(store.database.engine, "before_cursor_execute", explain)
    try:
        act()
    finally:
        sa.event.remove(store.database.engine, "before_cursor_execute", explain)
    return found


def reads_all(step: str) -> bool:
    """SQLite calls it SCAN; where it reads an index from one end until it has enough (a newest one) it says so too."""
    words = step.split()
    return words[0] == "SCAN" and words[1] in LARGE


def test_the_test_sees_a_scan(store: Store) -> None:
    def count() -> None:
        with store.database.reading() as connection:
            connection.execute(sa.text("SELECT count(*) FROM ballots WHERE settings_hash = 'x'"))

    assert len(scans(store, count)) == 1


def test_a_ballot_is_taken_in_without_reading_the_others(store: Store) -> None:
    intake = Intake(store)
    vote(store, intake, "d3", (10, 12))
    publish(store)
    base = {(0, 0): store.tiles()[0, 0].points}
    say = Say(states_plane({(10, 12): CellState.UNCHANGED_EMPTY}))
    ballot = make_ballot(two_walls(), {(0, 0): say}, "c", "d4", base=base, version=store.current())
    assert scans(store, lambda: send(intake, ballot)) == []


def test_a_publish_a_manifest_since_a_version_and_changes_between_two_read_what_changed(store: Store) -> None:
    store.manifest()
    assert scans(store, lambda: publish(store)) == []
    assert scans(store, lambda: store.manifest(since=1)) == []
    assert scans(store, lambda: changes_between(store, 1, store.current())) == []


@pytest.mark.parametrize("question", [vehicle_standings, waiting_votes, wanted_passes])
def test_a_question_asked_again_reads_what_an_event_touched(store: Store, question: Callable[[Store], object]) -> None:
    question(store)
    assert scans(store, lambda: question(store)) == []
    vote(store, Intake(store), "d3", (10, 12))
    assert scans(store, lambda: question(store)) == []
