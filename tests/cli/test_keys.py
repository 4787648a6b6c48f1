"""Whoever revokes a vehicle's key says what becomes of its votes, and the log says who that was."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from mapvote_server.questions.history import events_after, newest_event
from mapvote_server.store.keys import ballots_standing, issue
from mapvote_server.verbs import keys, policy
from stores import NewStore, vote_gone


class Terminal(io.StringIO):
    """Somebody sits there."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("typed", "said", "left"),
    [(Terminal("y\n"), None, 1), (Terminal("\n"), None, 0), (Terminal(), True, 1), (io.StringIO(), None, 0)],
    ids=["they are to count", "no answer", "said beforehand", "nobody there"],
)
def test_revoking_a_key_asks_what_becomes_of_its_votes(
    new_store: NewStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    typed: io.StringIO,
    said: bool | None,
    left: int,
) -> None:
    store = new_store(name="fleet.db")
    issue(store, "car_1", "vehicle")
    vote_gone(store, ["car_1"])
    monkeypatch.setattr("sys.stdin", typed)
    keys(str(tmp_path / "fleet.db"), "revoke", "car_1", keep_votes=said)
    assert ballots_standing(store).get("car_1", 0) == left


def test_the_log_names_who_was_logged_in(new_store: NewStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = new_store(name="fleet.db")
    monkeypatch.setenv("LOGNAME", "ann")
    keys(str(tmp_path / "fleet.db"), "issue", "car_1")
    policy(str(tmp_path / "fleet.db"), ["fuse.min_votes=3"], reason="more vehicles now")
    assert [event.actor for event in events_after(store, newest_event(store) - 2)] == ["ann", "ann"]
