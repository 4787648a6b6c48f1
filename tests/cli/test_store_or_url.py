"""Every verb that takes a STORE takes the URL of its server, and says the same."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa
from typer.testing import CliRunner

from hand_made import make_ballot, make_map, make_tile, wall
from live_server import serving_here
from mapvote.cli import app
from mapvote.config import FuseSettings
from mapvote.core.types import MapvoteError
from mapvote.server.store import schema
from mapvote.server.store.integrity import set_aside
from mapvote.server.store.policy import Policy
from mapvote.server.store.store import Store
from stores import WALL, send, wall_gone


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """A store and the server that keeps it: three tiles, two vehicles that say that a wall of the last is gone."""
    home = tmp_path_factory.mktemp("site")
    tiles = {(0, c): make_tile(wall(WALL, [0.05, 0.45 + 0.01 * c]), 0.0, (0, c)) for c in range(3)}
    policy = Policy(fuse=FuseSettings(max_deleted_share=1.0))
    store = Store.create(f"sqlite:///{home / 's.db'}", make_map(tiles), policy)
    for vehicle in ("a", "b"):
        send(store, make_ballot(store.point_map(), {(0, 2): wall_gone()}, vehicle))
    store.close()
    with serving_here(home / "s.db", log=home / "log") as url:
        yield str(home / "s.db"), url


def say(*words: object) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "160", "NO_COLOR": "1"})
    assert result.exit_code == 0, result.output + str(result.exception)
    return result.output


def both(site: tuple[str, str], verb: str, *words: object) -> str:
    """What a verb says of the store; of the server it says the same."""
    said = say(verb, site[0], *words)
    assert say(verb, site[1], *words).replace(site[1], site[0]) == said
    return said


def test_a_server_is_looked_at_run_and_exported_like_its_store(site: tuple[str, str], tmp_path: Path) -> None:
    assert "fuse.min_votes=2" in both(site, "policy")
    say("policy", site[1], "fuse.latest_vehicles=7", "--reason", "few")
    assert "by operator: few" in both(site, "policy").splitlines()[0]
    assert "(dry run): 0 points added, 3 deleted in tiles 0,2" in both(site, "publish", "--dry-run")
    assert "version 2 (published)" in say("publish", site[1], "--reason", "gone")
    assert "gone" in both(site, "log", "--events", 5)
    told = both(site, "explain", (2 * 256 + 11.5) * 0.3, 10.5 * 0.3)
    assert "version 2 decided changed_empty" in told
    assert "spent: version 2 has changed the cell since" in told
    assert "every plane, ballot and version is what it was" in both(site, "check")
    assert re.search(r"ballots +│ 2 ", both(site, "info"))
    assert "Compared where others agree" in both(site, "info", "--vehicles")
    found = json.loads(both(site, "log", "--from", 1, "--metres"))
    assert [f["properties"]["kind"] for f in found["features"]] == ["demolished"]
    pages = [tmp_path / "store.html", tmp_path / "server.html"]
    for source, page in zip(site, pages, strict=True):
        assert "the largest of 1 changes" in say("log", source, "--html", page)
    assert pages[0].read_text() == pages[1].read_text()
    out = [tmp_path / "store", tmp_path / "server"]
    for source, folder in zip(site, out, strict=True):
        assert "4 Autoware tiles, 4 written" in say("export", source, folder)
    names = [sorted(file.name for file in (folder / "pointcloud_map.pcd").iterdir()) for folder in out]
    assert names[0] == names[1]


def test_only_tiles_that_changed_since_a_version_are_written(site: tuple[str, str], tmp_path: Path) -> None:
    """Laid over the folder of that version they make the new one."""
    store = Store.open(f"sqlite:///{site[0]}")
    assert store.current() == 2
    store.close()
    assert "4 Autoware tiles, 1 written" in say("export", site[1], tmp_path / "delta", "--since", 1)
    say("export", site[0], tmp_path / "old", "--version", 1)
    say("export", site[0], tmp_path / "new")
    old, new, delta = (
        {f.name for f in (tmp_path / n / "pointcloud_map.pcd").iterdir()} for n in ("old", "new", "delta")
    )
    assert delta == new - old
    assert len(delta) == 1


@pytest.fixture
def voted(tmp_path: Path) -> Path:
    """A store where two vehicles, a and b, say that a wall is gone, each by the drives d and e."""
    point_map = make_map({(0, 0): make_tile(wall(WALL, [0.05, 0.45]))})
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", point_map)
    for drive in ("d", "e"):
        send(store, *[make_ballot(point_map, {(0, 0): wall_gone()}, name, drive) for name in ("a", "b")])
    store.close()
    return tmp_path / "s.db"


def test_a_server_rolls_back_withdraws_and_replays(voted: Path, tmp_path: Path) -> None:
    with serving_here(voted, log=tmp_path / "log") as url:
        assert "version 2 (published)" in say("publish", url, "--override")
        shown = say("unvote", url, "a", "--replay")
        assert shown == say("unvote", voted, "a", "--replay")
        assert shown.startswith("version 2 (only shown: --yes publishes it): 3 points added, 0 deleted in tiles 0,0")
        assert "version 3 (published): 3 points added" in say("unvote", url, "a", "--replay", "--yes")
        assert "version 4 is version 1 again" in say("rollback", url, 1, "--reason", "wrong")
        assert say("unvote", url, "b", "--drive", "d") == "1 ballots of b withdrawn\n"
        assert say("unvote", url, "b") == "1 ballots of b withdrawn\n"


def test_a_server_clears_what_the_policy_does_not_keep(voted: Path, tmp_path: Path) -> None:
    with serving_here(voted, log=tmp_path / "log") as url:
        say("publish", url, "--override")
        say("policy", url, "keep.versions=1")
        would = say("gc", url)
        assert "1 versions (1 planes, 0 decisions)" in would
        assert say("gc", voted) == would
        assert say("gc", url, "--yes") == would.replace(": --yes clears them", "")
        assert "cleared operator" in say("log", url, "--events", 1)
        assert say("unvote", url, "--all") == "4 ballots of all vehicles withdrawn\n"


def test_a_servers_keys_are_issued_rotated_and_revoked_by_its_operator(
    voted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with serving_here(voted, log=tmp_path / "log") as url:
        boss = say("keys", url, "issue", "boss", "--role", "operator").strip()
        refused = CliRunner().invoke(app, ["keys", url])
        assert "needs a key" in str(refused.exception), "the first key closes an open server"
        monkeypatch.setenv("MAPVOTE_KEY", boss)
        (tmp_path / "a.key").write_text(say("keys", url, "issue", "a", "--days", 3))
        assert say("keys", url, "rotate", "a").strip() not in ("", boss)
        assert [line.split("│")[1:3] for line in say("keys", url).splitlines() if "valid" in line] == [
            [" operator ", " boss "], [" vehicle  ", " a    "], [" vehicle  ", " a    "]
        ]  # fmt: skip
        refused = CliRunner().invoke(app, ["keys", url, "issue", "x", "--key-file", str(tmp_path / "a.key")])
        assert "only an operator can do this" in str(refused.exception)
        assert say("keys", url, "revoke", "a") == "2 keys of a revoked, 2 ballots do not count any more\n"
        assert "key revoked boss a" in say("log", url, "--events", 1)


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
        with pytest.raises(MapvoteError, match="give --mend too"):
            CliRunner().invoke(app, ["check", url, "--from", str(backup)], catch_exceptions=False)


def test_the_machine_of_a_store_serves_it() -> None:
    with pytest.raises(MapvoteError, match="on the server's machine"):
        CliRunner().invoke(app, ["serve", "http://localhost:1"], catch_exceptions=False)


@pytest.mark.parametrize("verb", [["serve", "--port", "0", "--open"], ["publish", "--dry-run"]])
def test_settings_that_a_stores_policy_overrules_are_refused(
    verb: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Store.create(f"sqlite:///{tmp_path / 's.db'}", make_map({(0, 0): make_tile(wall(WALL, [0.05]))})).close()
    (tmp_path / "c.toml").write_text("[fuse]\nmin_votes = 3\n")
    told = [CliRunner().invoke(app, [verb[0], str(tmp_path / "s.db"), *verb[1:], "--config", str(tmp_path / "c.toml")])]
    monkeypatch.setenv("MAPVOTE_FUSE__MIN_VOTES", "3")
    told.append(CliRunner().invoke(app, [verb[0], str(tmp_path / "s.db"), *verb[1:]]))
    for result in told:
        assert isinstance(result.exception, MapvoteError), result.output
        assert "fuse.min_votes has no effect" in str(result.exception)
        assert "mapvote policy" in str(result.exception)


def test_a_copy_of_a_running_store_without_its_wal_says_so(tmp_path: Path) -> None:
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", make_map({(0, 0): make_tile(wall(WALL, [0.05]))}))
    (tmp_path / "copy.db").write_bytes((tmp_path / "s.db").read_bytes())
    store.close()
    result = CliRunner().invoke(app, ["info", str(tmp_path / "copy.db")])
    assert "its -wal file is missing" in str(result.exception)


def test_a_server_sets_aside_what_is_damaged(site: tuple[str, str]) -> None:
    store = Store.open(f"sqlite:///{site[0]}")
    b = schema.ballots
    with store.database.writing() as connection:
        seq = connection.execute(sa.select(sa.func.min(b.c.seq))).scalar_one()
        connection.execute(b.update().where(b.c.seq == seq).values(vehicle="c"))
    result = CliRunner().invoke(app, ["check", site[1], "--mend"])
    assert result.exit_code == 1
    assert f"ballot {seq}: is not what its sum says; set aside" in result.output
    with store.database.reading() as connection:
        assert ("ballot", str(seq)) in set_aside(connection)
    store.close()


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["publish", "http://localhost:1", "--cluster", "tcp://x"], "the server has its own"),
        (["vote", ".", "--map", ".", "--out", "b", "--region", "0,0,9,9"], "only a server sends a part"),
        (["vote", ".", "--map", "http://localhost:1", "--out", "b", "--region", "9,9,0,0"], "lower left corner first"),
    ],
)
def test_what_only_the_machine_of_the_store_can_do_is_said(words: list[str], why: str) -> None:
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 1
    assert why in str(result.exception)
