"""Whoever revokes a vehicle's key says what becomes of its votes, and the log says who that was."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.cli.operate import keys, policy
from mapvote.core.types import CellState
from mapvote.server.store.keys import ballots_standing, issue
from mapvote.server.store.store import Store
from mapvote.server.views.history import events_after, newest_event
from stores import send


class Terminal(io.StringIO):
    """Somebody sits there."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("typed", "said", "left"),
    [(Terminal("y\n"), None, 1), (Terminal("\n"), None, 0), (Terminal(), True, 1), (io.StringIO(), None, 0)],
    ids=["they are to count", "no answer", "said beforehand", "nobody there"],
)
def test_who_revokes_a_key_is_asked_what_becomes_of_the_votes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, typed: io.StringIO, said: bool | None, left: int
) -> None:
    store = Store.create(f"sqlite:///{tmp_path / 'fleet.db'}", two_walls())
    issue(store, "car_1", "vehicle")
    say = Say(states_plane({(10, 10): CellState.CHANGED_EMPTY}))
    send(store, make_ballot(two_walls(), {(0, 0): say}, "car_1", end_ns=1_700_000_000 * 10**9))
    monkeypatch.setattr("sys.stdin", typed)
    keys(str(tmp_path / "fleet.db"), "revoke", "car_1", keep_votes=said)
    assert ballots_standing(store).get("car_1", 0) == left
    store.close()


def test_the_log_names_who_was_logged_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store.create(f"sqlite:///{tmp_path / 'fleet.db'}", two_walls())
    monkeypatch.setenv("LOGNAME", "ann")
    keys(str(tmp_path / "fleet.db"), "issue", "car_1")
    policy(str(tmp_path / "fleet.db"), ["fuse.min_votes=3"], reason="more vehicles now")
    assert [event.actor for event in events_after(store, newest_event(store) - 2)] == ["ann", "ann"]
    store.close()
