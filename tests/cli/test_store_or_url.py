"""Every verb that takes a STORE takes the URL of its server, and says the same."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from command_line import typed
from hand_made import make_map, make_tile, wall
from live_server import serving_here
from mapvote.cli import app
from mapvote.config import FuseSettings
from mapvote.core.types import MapvoteError
from mapvote_server.store import schema
from mapvote_server.store.policy import Policy
from mapvote_server.store.store import Store
from stores import WALL, NewStore, vote_gone


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """A store and the server that keeps it: three tiles, two vehicles that say that a wall of the last is gone."""
    home = tmp_path_factory.mktemp("site")
    tiles = {(0, c): make_tile(wall(WALL, [0.05, 0.45 + 0.01 * c]), 0.0, (0, c)) for c in range(3)}
    policy = Policy(fuse=FuseSettings(max_deleted_share=1.0))
    store = Store.create(f"sqlite:///{home / 's.db'}", make_map(tiles), policy)
    vote_gone(store, tiles=[(0, 2)])
    store.close()
    with serving_here(home / "s.db", log=home / "log") as url:
        yield str(home / "s.db"), url


def both(site: tuple[str, str], verb: str, *words: object) -> str:
    """A verb's answer on the store; of the server it says the same."""
    said = typed(verb, site[0], *words)
    assert typed(verb, site[1], *words).replace(site[1], site[0]) == said
    return said


def test_a_server_is_looked_at_run_and_exported_like_its_store(site: tuple[str, str], tmp_path: Path) -> None:
    assert "fuse.min_votes=2" in both(site, "policy")
    typed("policy", site[1], "fuse.latest_vehicles=7", "--reason", "few")
    assert "by operator: few" in both(site, "policy").splitlines()[0]
    assert "(dry run): 0 points added, 3 deleted in tiles 0,2" in both(site, "publish", "--dry-run")
    assert "version 2 (published)" in typed("publish", site[1], "--reason", "gone")
    assert "gone" in both(site, "log", "--events", 5)
    told = both(site, "explain", (2 * 256 + 11.5) * 0.3, 10.5 * 0.3)
    assert "version 2 decided changed_empty" in told
    assert "spent: version 2 has changed the cell since" in told
    assert "every plane, ballot and version is what it was" in both(site, "check")
    assert re.search(r"ballots +│ 2 ", both(site, "info"))
    assert "Compared where others agree" in both(site, "info", "--vehicles")
    found = json.loads(both(site, "log", "--from", 1, "--geojson", "--metres"))
    assert [f["properties"]["kind"] for f in found["features"]] == ["demolished"]
    pages = [tmp_path / "store.html", tmp_path / "server.html"]
    for source, page in zip(site, pages, strict=True):
        assert "the largest of 1 changes" in typed("log", source, "--html", page)
    assert pages[0].read_text() == pages[1].read_text()
    out = [tmp_path / "store", tmp_path / "server"]
    for source, folder in zip(site, out, strict=True):
        assert "4 Autoware tiles, 4 written" in typed("export", source, folder)
    names = [sorted(file.name for file in (folder / "pointcloud_map.pcd").iterdir()) for folder in out]
    assert names[0] == names[1]


def test_only_tiles_that_changed_since_a_version_are_written(site: tuple[str, str], tmp_path: Path) -> None:
    """Laid over the folder of that version they make the new one."""
    store = Store.open(f"sqlite:///{site[0]}")
    assert store.current() == 2
    store.close()
    assert "4 Autoware tiles, 1 written" in typed("export", site[1], tmp_path / "delta", "--since", 1)
    typed("export", site[0], tmp_path / "old", "--version", 1)
    typed("export", site[0], tmp_path / "new")
    old, new, delta = (
        {f.name for f in (tmp_path / n / "pointcloud_map.pcd").iterdir()} for n in ("old", "new", "delta")
    )
    assert delta == new - old
    assert len(delta) == 1


@pytest.fixture
def voted(new_store: NewStore, tmp_path: Path) -> Path:
    """A store where two vehicles, a and b, say that a wall is gone, each by the drives d and e."""
    store = new_store(make_map({(0, 0): make_tile(wall(WALL, [0.05, 0.45]))}))
    for drive in ("d", "e"):
        vote_gone(store, drive=drive)
    return tmp_path / "s.db"


def test_a_server_rolls_back_withdraws_and_replays(voted: Path, tmp_path: Path) -> None:
    with serving_here(voted, log=tmp_path / "log") as url:
        assert "version 2 (published)" in typed("publish", url, "--override")
        shown = typed("unvote", url, "a", "--replay")
        assert shown == typed("unvote", voted, "a", "--replay")
        assert shown.startswith("version 2 (only shown: --yes publishes it): 3 points added, 0 deleted in tiles 0,0")
        assert "version 3 (published): 3 points added" in typed("unvote", url, "a", "--replay", "--yes")
        assert "version 4 is version 1 again" in typed("rollback", url, 1, "--reason", "wrong")
        assert typed("unvote", url, "b", "--drive", "d") == "1 ballots of b withdrawn\n"
        assert typed("unvote", url, "b") == "1 ballots of b withdrawn\n"


def test_a_server_clears_what_the_policy_does_not_keep(voted: Path, tmp_path: Path) -> None:
    with serving_here(voted, log=tmp_path / "log") as url:
        typed("publish", url, "--override")
        typed("policy", url, "keep.versions=1")
        would = typed("gc", url)
        assert "1 versions (1 planes, 0 decisions)" in would
        assert typed("gc", voted) == would
        assert typed("gc", url, "--yes") == would.replace(": --yes clears them", "")
        assert "cleared operator" in typed("log", url, "--events", 1)
        assert typed("unvote", url, "--all") == "4 ballots of all vehicles withdrawn\n"


def test_a_servers_keys_are_issued_rotated_and_revoked_by_its_operator(
    voted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with serving_here(voted, log=tmp_path / "log") as url:
        boss = typed("keys", url, "issue", "boss", "--role", "operator").strip()
        with pytest.raises(MapvoteError, match="needs a key"):  # the first key closes an open server
            typed("keys", url)
        monkeypatch.setenv("MAPVOTE_KEY", boss)
        (tmp_path / "a.key").write_text(typed("keys", url, "issue", "a", "--days", 3))
        assert typed("keys", url, "rotate", "a").strip() not in ("", boss)
        assert [line.split("│")[1:3] for line in typed("keys", url).splitlines() if "valid" in line] == [
            [" operator ", " boss "], [" vehicle  ", " a    "], [" vehicle  ", " a    "]
        ]  # fmt: skip
        with pytest.raises(MapvoteError, match="only an operator can do this"):
            typed("keys", url, "issue", "x", "--key-file", tmp_path / "a.key")
        assert typed("keys", url, "revoke", "a") == "2 keys of a revoked, 2 ballots do not count any more\n"
        assert "key revoked boss a" in typed("log", url, "--events", 1)


def test_a_server_is_mended_from_a_backup(voted: Path, tmp_path: Path) -> None:
    """Its planes come from the backup; what the backup has not is set aside."""
    backup = tmp_path / "backup.db"
    sqlite3.connect(voted).execute("VACUUM INTO ?", [str(backup)])
    store, b = Store.open(f"sqlite:///{voted}"), schema.blobs
    with store.database.writing() as connection:
        connection.execute(b.update().values(data=b"no frame"))
        connection.execute(schema.ballots.update().where(schema.ballots.c.drive == "d").values(drive="f"))
    store.close()
    with serving_here(voted, log=tmp_path / "log") as url:
        result = CliRunner().invoke(app, ["check", url, "--mend", "--from", str(backup)])
    assert result.exit_code == 1
    assert result.output.count(f": mended from {backup}") == 2
    assert result.output.count("is not what its sum says; set aside") == 2


@pytest.mark.parametrize("verb", [["serve", "--port", "0", "--open"], ["publish", "--dry-run"]])
def test_settings_that_a_stores_policy_overrules_are_refused(
    verb: list[str], new_store: NewStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    new_store()
    (tmp_path / "c.toml").write_text("[fuse]\nmin_votes = 3\n")
    told = "fuse.min_votes has no effect.*mapvote policy"
    with pytest.raises(MapvoteError, match=told):
        typed(verb[0], tmp_path / "s.db", *verb[1:], "--config", tmp_path / "c.toml")
    monkeypatch.setenv("MAPVOTE_FUSE__MIN_VOTES", "3")
    with pytest.raises(MapvoteError, match=told):
        typed(verb[0], tmp_path / "s.db", *verb[1:])


def test_a_copy_of_a_running_store_without_its_wal_says_so(new_store: NewStore, tmp_path: Path) -> None:
    new_store()
    (tmp_path / "copy.db").write_bytes((tmp_path / "s.db").read_bytes())
    with pytest.raises(MapvoteError, match="its -wal file is missing"):
        typed("info", tmp_path / "copy.db")


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["publish", "http://localhost:1", "--cluster", "tcp://x"], "the server has its own"),
        (["serve", "http://localhost:1"], "on the server's machine"),
        (["check", "x", "--from", "y"], "give --mend too"),
        (["vote", ".", "--map", ".", "--out", "b", "--region", "0,0,9,9"], "only a server sends a part"),
        (["vote", ".", "--map", "http://localhost:1", "--out", "b", "--region", "9,9,0,0"], "lower left corner first"),
    ],
)
def test_a_verb_that_needs_the_machine_of_the_store_says_so(words: list[str], why: str) -> None:
    with pytest.raises(MapvoteError, match=why):
        typed(*words)
