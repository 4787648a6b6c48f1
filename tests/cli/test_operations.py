"""docs/operations.md followed literally, from its first command to its last, as an operator would who knows nothing
else: the wheel in a fresh environment, a real server, both databases. On PostgreSQL the commands run in this process.

Commands of others (pip, systemctl, the databases' tools) are not run here.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from command_line import type_in
from fresh_wheel import installed, packed
from hand_made import Say, make_ballot, states_plane, two_walls
from mapvote.core.types import CellState
from mapvote.formats import write_map
from mapvote_server.store.store import Store
from postgres_cluster import PostgresCluster, programs
from stores import send

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "operations.md"
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def mapvote(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The program as pip installs it; $MAPVOTE_PROGRAM is one that is installed already."""
    if "MAPVOTE_PROGRAM" in os.environ:
        return os.environ["MAPVOTE_PROGRAM"]
    home = tmp_path_factory.mktemp("fresh")
    return str(installed(home / "venv", packed(home)) / "mapvote")


@pytest.fixture(params=["sqlite", "postgresql"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, str]]:
    """(what the page calls STORE, its URL); there is nothing in it yet."""
    if request.param == "sqlite":
        yield "fleet.db", f"sqlite:///{tmp_path / 'fleet.db'}"
        return
    if programs() is None:
        pytest.skip("PostgreSQL's server is not installed: apt-get install postgresql")
    cluster = PostgresCluster()
    yield "-", cluster.create("mapvote")
    cluster.close()


def commands() -> list[str]:
    """Every line of the page that an operator types to mapvote, in order."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    return [line for line in lines if line.startswith("mapvote ") and "mapvote@db" not in line]


def vote(url: str, vehicle: str) -> None:
    """A vehicle says that a wall is gone."""
    store = Store.open(url)
    say = Say(states_plane({(10, 10): CellState.CHANGED_EMPTY, (10, 11): CellState.CHANGED_EMPTY}))
    send(store, make_ballot(two_walls(), {(0, 0): say}, vehicle))
    store.close()


def test_every_command_of_the_page_works_as_printed(
    mapvote: str, store: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, url = store
    write_map(two_walls(), tmp_path / "my_map")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    monkeypatch.setenv("MAPVOTE_STORE", url)

    def words_of(line: str) -> list[str]:
        stands_for = {"STORE": name, "fleet.db": name, "VERSION": "1", "BACKUP": name, "VEHICLE": "car_1"}
        return [stands_for.get(word, word) for word in shlex.split(line, comments=True)[1:]]

    def typed(line: str) -> str:
        if name == "-":
            return type_in(shlex.join(["mapvote", *words_of(line)]))
        done = subprocess.run([mapvote, *words_of(line)], capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        return done.stdout

    first, *rest = commands()
    assert " serve " in first
    serve = [mapvote, *words_of(first), "--port", "0"]
    with subprocess.Popen(serve, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        assert server.stdout.readline().startswith("key of the operator, shown this once: ")
        assert server.stdout.readline().startswith("serving http://127.0.0.1:")
        for vehicle in ("car_1", "car_2"):
            vote(url, vehicle)
        said = [typed(line) for line in rest]
        server.terminate()
        assert server.wait(30) in (0, -15)
    assert any("6 deleted in tiles 0,0" in text for text in said), said
    assert any("version 3 is version 1 again" in text for text in said)
