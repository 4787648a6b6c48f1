"""From the first second: who may use a server, and what it gives away on the machine that it runs on."""

from __future__ import annotations

import os
import re
import stat
import subprocess
from pathlib import Path

import httpx2
import pytest
import structlog
from fastapi.testclient import TestClient

from command_line import type_in, typed
from hand_made import Say, make_ballot, states_plane, two_walls
from live_server import mapvote, serving
from mapvote.client import MapClient
from mapvote.codec.ballot import encode
from mapvote.core.types import MapvoteError
from mapvote.formats import write_map
from mapvote_server.api.app import create_app
from mapvote_server.store import keys
from mapvote_server.store.store import Store
from stores import NewStore

URL_WITH_PASSWORD = "postgresql+psycopg://mapvote:a-secret@127.0.0.1:9/mapvote"


def refused(*arguments: object, **environment: str) -> str:
    """The error of `mapvote ARGUMENTS`."""
    with pytest.raises(MapvoteError) as error:
        typed(*arguments, code=0, **environment)
    structlog.reset_defaults()  # `serve` logs to the runner's stderr, which is closed now
    return str(error.value)


def with_key(secret: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}"}


def test_a_new_store_prints_its_first_operator_key_once_and_is_closed_from_the_start(tmp_path: Path) -> None:
    write_map(two_walls(), tmp_path / "map")
    command = mapvote("serve", tmp_path / "s.db", "--map", tmp_path / "map", "--port", 0)
    said: list[str] = []
    for _ in range(2):
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            lines = [server.stdout.readline()]
            if not said:
                lines.append(server.stdout.readline())
            url = lines[-1].split()[1]
            said.append(lines[0])
            assert httpx2.get(f"{url}/v1/map", timeout=300.0).status_code == 401
            secret = said[0].split()[-1]
            assert httpx2.post(f"{url}/v1/publish", json={}, headers=with_key(secret), timeout=300.0).status_code == 200
            server.terminate()
    assert "key of the operator, shown this once" in said[0]
    assert said[1].startswith("serving ")


def test_without_keys_a_server_starts_only_if_told_to_be_open_and_then_for_this_machine_alone(
    new_store: NewStore, tmp_path: Path
) -> None:
    new_store()
    assert re.search("no keys yet.*--open", refused("serve", tmp_path / "s.db", "--port", 0))
    for host in ("0.0.0.0", "::", "192.0.2.1"):
        assert "this machine alone" in refused("serve", tmp_path / "s.db", "--open", "--host", host, "--port", 0)


def test_a_key_that_is_issued_later_closes_a_running_server_at_once(new_store: NewStore, tmp_path: Path) -> None:
    """A revoked one leaves it closed: only keys can have been the reason to open it."""
    store = new_store()
    elsewhere = Store.open(f"sqlite:///{tmp_path / 's.db'}")
    ballot = encode(make_ballot(two_walls(), {(0, 0): Say(states_plane())}, "a", "d1"))
    with TestClient(create_app(store, opened=True), base_url="http://localhost") as client:
        assert client.get("/v1/map").status_code == 200
        for page in ("/", "/docs"):
            assert "This server is open" in client.get(page).text
        secret = keys.issue(elsewhere, "boss", "operator")
        assert client.put("/v1/ballots/a/d1", content=ballot).status_code == 401
        assert client.get("/v1/map").status_code == 401
        assert client.get("/v1/map", headers=with_key(secret)).status_code == 200
        for page in ("/", "/docs"):
            assert "This server is open" not in client.get(page, headers=with_key(secret)).text
        keys.revoke(elsewhere, "boss")
        assert client.get("/v1/map").status_code == 401
    elsewhere.close()


def test_a_password_on_the_command_line_is_refused_and_no_error_repeats_that_of_the_database() -> None:
    errors = [refused("serve", URL_WITH_PASSWORD)]
    assert "MAPVOTE_STORE" in errors[0]
    errors += [refused(verb, "-", MAPVOTE_STORE=URL_WITH_PASSWORD) for verb in ("serve", "publish", "log", "keys")]
    assert not any("a-secret" in error for error in errors)


def test_nothing_secret_is_in_the_process_list_in_logs_or_in_files_that_others_can_read(
    new_store: NewStore, tmp_path: Path
) -> None:
    secret = keys.issue(new_store(), "a", "vehicle")
    command = mapvote("serve", "-", "--port", 0)
    environment = os.environ | {"MAPVOTE_STORE": f"sqlite:///{tmp_path / 's.db'}"}
    ballot = make_ballot(two_walls(), {(0, 0): Say(states_plane())}, "a", "d1")
    with (
        (tmp_path / "log").open("w") as log,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, env=environment) as server,
    ):
        assert server.stdout is not None
        url = server.stdout.readline().split()[1]
        assert str(tmp_path) not in Path(f"/proc/{server.pid}/cmdline").read_text()
        with MapClient(url, key=secret, home=tmp_path / "home") as client:
            client.fetch()
            assert client.send(ballot) == "created"
        with MapClient("http://127.0.0.1:9", key=secret, home=tmp_path / "home", attempts=1) as away:
            assert away.send(ballot) == "spooled"
        files = [*tmp_path.glob("s.db*"), *(tmp_path / "home").rglob("*")]
        assert {path.suffix for path in files} >= {".db", ".db-wal", ".ballot"}
        for path in files:
            if path.is_file():
                assert stat.S_IMODE(path.stat().st_mode) == 0o600, path
        server.terminate()
    assert secret not in (tmp_path / "log").read_text()


def test_a_vehicle_takes_its_key_from_a_file_or_the_environment_never_from_the_command_line(tmp_path: Path) -> None:
    shown = type_in("mapvote vote --help")
    assert "--key-file" in shown
    assert "MAPVOTE_KEY" in shown
    asked = "vote", str(tmp_path), "--map", "x"
    typed(*asked, "--send", "http://127.0.0.1:9", "--key", "a-secret", code=2)
    assert "holds no key" in refused(*asked, "--out", tmp_path / "o", "--key-file", tmp_path / "none")


@pytest.mark.slow
def test_who_sends_wrong_keys_by_the_hundred_is_looked_up_no_more_and_the_right_ones_go_on(
    new_store: NewStore, tmp_path: Path
) -> None:
    secret = keys.issue(new_store(), "boss", "operator")
    with (
        serving(tmp_path / "s.db", log=tmp_path / "log") as (url, _),
        httpx2.Client(base_url=url, timeout=300.0) as http,
    ):
        assert http.get("/v1/map", headers=with_key(secret)).status_code == 200
        answers: list[int] = []
        while len(answers) < 400 and 429 not in answers:
            answers.append(http.get("/v1/map", headers=with_key(f"wrong-{len(answers)}")).status_code)
        assert answers[:100] == [401] * 100
        assert answers[-1] == 429
        assert http.get("/v1/map", headers=with_key(secret)).status_code == 200
        elsewhere = with_key("wrong too") | {"X-Forwarded-For": "192.0.2.7"}
        assert http.get("/v1/map", headers=elsewhere).status_code == 401
