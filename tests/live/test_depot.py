"""`mapvote send`: ballots that were made offline reach a server, each is told, and a second run continues."""

from __future__ import annotations

from pathlib import Path

import pytest

from command_line import typed
from hand_made import make_ballot, two_walls
from live_server import serving, serving_here
from mapvote.codec.ballot import encode
from mapvote.core.types import MapvoteError
from mapvote_server.store.store import Store
from stores import wall_gone


def depot(tmp_path: Path, drives: int) -> Path:
    """A store of two walls, and a folder of ballots in subfolders, which say that one wall is gone."""
    store = Store.create(f"sqlite:///{tmp_path / 'fleet.db'}", two_walls())
    base = store.point_map()
    store.close()
    for number in range(drives):
        name = f"day-{number:03d}"
        folder = tmp_path / "depot" / f"car_{number % 2}"
        folder.mkdir(parents=True, exist_ok=True)
        ballot = make_ballot(base, {(0, 0): wall_gone()}, f"car_{number % 2}", name, end_ns=10**18)
        suffix = "BALLOT" if number == 0 else "ballot"
        (folder / f"{name}.{suffix}").write_bytes(encode(ballot))
    return tmp_path / "depot"


@pytest.mark.slow
def test_a_folder_is_sent_whole_and_a_second_run_finds_all_of_it_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = depot(tmp_path, 5)
    (folder / "notes.txt").write_text("no ballot")
    (folder / "broken.ballot").write_bytes(b"half a ballot")
    with serving_here(tmp_path / "fleet.db", log=tmp_path / "serve.log") as url:
        first = typed("send", f"{folder}", "--to", f"{url}", code=1)
        again = typed("send", f"{folder}", "--to", f"{url}", code=1)
        one = typed("send", f"{folder}/car_1/day-001.ballot", "--to", f"{url}")
    assert first.count(": created") == 5
    assert "5 ballots sent, 0 were there already, 1 refused" in first
    assert "broken.ballot: " in first
    assert "0 ballots sent, 5 were there already, 1 refused" in again
    assert "0 ballots sent, 1 were there already, 0 refused" in one


def test_a_server_that_is_away_leaves_the_rest_for_the_next_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("time.sleep", lambda _: None)
    folder = depot(tmp_path, 3)
    away = typed("send", f"{folder}", "--to", "http://127.0.0.1:9", code=1)
    assert "3 not sent: the server is away, run the same command again" in away


def test_an_empty_folder_and_a_key_that_may_not_send_are_one_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = depot(tmp_path, 3)
    (tmp_path / "empty").mkdir()
    with pytest.raises(MapvoteError, match=r"holds no \*.ballot"):
        typed("send", tmp_path / "empty", "--to", "http://127.0.0.1:9")
    typed("keys", tmp_path / "fleet.db", "issue", "car_9")
    with (
        serving(tmp_path / "fleet.db", log=tmp_path / "serve.log") as (url, _),
        pytest.raises(MapvoteError, match="key"),
    ):
        typed("send", folder, "--to", url)
