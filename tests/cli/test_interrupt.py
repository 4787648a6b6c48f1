"""Ctrl-C in real processes: exit code 130, one line, no traceback, nothing half-written and nothing lost."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.main import get_command

from live.loopback_dds import LOOPBACK, own_domain
from live_server import mapvote
from mapvote.cli import app
from mapvote_server.questions.history import last_events
from mapvote_server.store.store import Store

Desk = Callable[..., Path]


@pytest.fixture(autouse=True)
def _ctrl_c_is_heard() -> Iterator[None]:
    """A process that a shell starts in the background gets no Ctrl-C, nor do its children: the tests may run there."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def interrupt(command: list[str], folder: Path, when: Callable[[], bool]) -> subprocess.CompletedProcess[str]:
    """Run ``command`` in a process group of its own, as a terminal does; Ctrl-C to all of it once ``when`` says so."""
    process = subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 120
    while not when() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    assert process.poll() is None, f"it had ended before: {process.communicate()}"
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    return subprocess.CompletedProcess(command, process.returncode, out, err)


def stopped_by_a_line(done: subprocess.CompletedProcess[str]) -> bool:
    assert "Traceback" not in done.stderr, done.stderr
    assert done.stderr.strip().splitlines()[-1].startswith("mapvote: interrupted"), done.stderr
    return done.returncode == 130


def after(seconds: float) -> Callable[[], bool]:
    start = time.monotonic()
    return lambda: time.monotonic() - start > seconds


def slowed(verb_words: list[str], patch: str) -> list[str]:
    """``mapvote`` with one function that says ready (by a file of this name) and then takes its time."""
    code = (
        "import sys, time, pathlib\n"
        "def wait(*a, **k):\n    pathlib.Path('ready').touch()\n    time.sleep(60)\n"
        f"{patch}\nsys.argv = ['mapvote', *{verb_words!r}]\nfrom mapvote.__main__ import main\nmain()\n"
    )
    return [sys.executable, "-c", code]


VERBS = {
    "info my_map": "import mapvote.formats.describe as m; m.describe = wait",
    "doctor MY_DRIVE": "import mapvote.doctor.diagnosis as m; m.diagnose = wait",
    "build MY_DRIVE --out new": "import mapvote.survey.build as m; m.build_map = wait",
    "vote MY_DRIVE --map my_map --out new": "import mapvote.vehicle as m; m.vote_drive = wait",
    "update my_map car_1.ballot --out new": "import mapvote.fusion.fuse as m; m.update_map = wait",
    "import city.pcd new": "import mapvote.formats as m; m.map_of = wait",
    "export my_map new.pcd": "import mapvote.formats as m; m.export_map = wait",
    "publish STORE": "import mapvote_server.store.publish as m; m.publish = wait",
    "log STORE --out new.geojson": "import mapvote_server.questions.changes as m; m.changes_between = wait",
    "config": "import mapvote.config as m; m.load_with_sources = wait",
    "diff my_map city.pcd --out new.geojson": "import mapvote.formats as m; m.read_map = wait",
    "merge my_map city.pcd --out new": "import mapvote.formats as m; m.read_map = wait",
    "demo --out new": "import mapvote_lab.evaluation.demo as m; m.evaluate = wait",
    "evaluate tiny.toml --json new": "import mapvote_lab.evaluation.evaluate as m; m.evaluate = wait",
    "affected changes.geojson lanelet2_map.osm": "import mapvote.formats.geo.lanelet2 as m; m.read_lanelets = wait",
    "show car_1.ballot --map my_map --mcap new": "import mapvote.formats as m; m.read_map = wait",
    "warmup": "import mapvote.warmup as m; m.warm_up = wait",
    "send car_1.ballot --to http://localhost:9": "import mapvote.live.depot as m; m.send_all = wait",
    "export http://localhost:9 new --follow": "import mapvote.client as m; m.MapClient.manifest = wait",
}
ELSEWHERE = {"serve", "simulate", "topics", "play", "drive", "autoware"}
"""Verbs with a test of their own: below, and in tests/live."""
AS_PUBLISH = {"coverage", "policy", "rollback", "unvote", "check", "explain", "gc", "keys"}
"""Verbs that wait for the API within this process as ``publish STORE`` does: door.api_at ends them."""


def test_every_verb_is_interrupted_by_a_test() -> None:
    interrupted = {line.split()[0] for line in VERBS} | ELSEWHERE | AS_PUBLISH
    assert interrupted == set(get_command(app).commands)  # type: ignore[attr-defined]


READ = ("my_map", "MY_DRIVE", "car_1.ballot", "city.pcd", "STORE", "changes.geojson", "lanelet2_map.osm")
FAST = ("vote", "publish")
"""The others go the same way; each takes a process of its own."""


@pytest.mark.parametrize(
    "line", [pytest.param(v, marks=() if v.startswith(FAST) else (pytest.mark.slow,)) for v in VERBS]
)
def test_ctrl_c_in_the_middle_of_a_verb_ends_it_with_one_line(line: str, desk: Desk) -> None:
    words = line.split()
    here = desk(*(w for w in words if w in READ))
    done = interrupt(slowed(words, VERBS[line]), here, (here / "ready").exists)
    assert stopped_by_a_line(done)
    left = {p.name for p in here.iterdir()} - {"ready", "STORE-wal", "STORE-shm", *(w for w in words if w != "new")}
    if words[0] == "demo":  # its folder and the cache are where the next run goes on
        assert not list(here.glob("new/*.*"))
        left -= {"new", "cache"}
    assert left == set()


@pytest.mark.parametrize(
    "line", ["rollback STORE 1", pytest.param("unvote STORE car_1 --replay --yes", marks=pytest.mark.slow)]
)
def test_ctrl_c_while_a_version_is_being_written_leaves_no_version(line: str, desk: Desk) -> None:
    """Its row is there by then, in a transaction that never ends."""
    here = desk("STORE")
    before = what_is_in(here / "STORE")
    patch = "import mapvote_server.store.publish as m; m.set_tiles = wait"
    done = interrupt(slowed(line.split(), patch), here, (here / "ready").exists)
    assert stopped_by_a_line(done)
    assert what_is_in(here / "STORE") == before
    assert before[0] == [1, 2]


def what_is_in(path: Path) -> tuple[list[int], list[str]]:
    """Versions and events of a store."""
    store = Store.open(f"sqlite:///{path}")
    found = [v.number for v in store.versions()], [str(event) for event in last_events(store, 99)]
    store.close()
    return found


WRITERS = {
    "map": ("import city.pcd out", "import mapvote.formats.maps.mapvote_folder as m; m.pack_tile = wait"),
    "points": ("export my_map out.pcd", "import mapvote.formats.maps.pcd as m; m.table_of = wait"),
    "tiles": ("export my_map out", "import mapvote.formats.maps.pcd as m; m.table_of = wait"),
    "the disk's own time": ("export my_map out.pcd", "import os as m; m.fsync = wait"),
    "a map in the place of another": ("update my_map car_1.ballot --out out", "import os as m; m.fsync = wait"),
    "between the two renames of a map": (
        "update my_map car_1.ballot --out out",
        "import os\nreal, turns = os.replace, []\n"
        "def replace(a, b):\n    turns.append(a)\n    wait() if len(turns) == 2 else None\n    real(a, b)\n"
        "os.replace = replace",
    ),
}


@pytest.mark.parametrize(
    "what", [pytest.param(w, marks=() if w in ("map", "the disk's own time") else (pytest.mark.slow,)) for w in WRITERS]
)
def test_ctrl_c_while_writing_leaves_what_was_there_and_no_litter(what: str, made: Path, desk: Desk) -> None:
    line, patch = WRITERS[what]
    words = line.split()
    here = desk(*(w for w in words if w in ("my_map", "car_1.ballot", "city.pcd")))
    before = set(here.iterdir())
    if words[0] == "update":
        shutil.copytree(made / "my_map", here / "out")
        before.add(here / "out")
    done = interrupt(slowed(words, patch), here, (here / "ready").exists)
    assert stopped_by_a_line(done)
    assert set(here.iterdir()) - before == {here / "ready"}
    if words[0] == "update":
        assert (here / "out" / "manifest.json").read_bytes() == (made / "my_map" / "manifest.json").read_bytes()


@pytest.mark.slow
def test_ctrl_c_while_processes_simulate_leaves_no_process_and_no_folder(made: Path, desk: Desk) -> None:
    here = desk("tiny.toml")
    patch = "import mapvote_lab.simulation.drives as m; m._processes = lambda stage: 2"
    done = interrupt(
        slowed(["simulate", "tiny.toml", "street"], patch), here,
        lambda: any(here.glob(".street.partial/.*/velodyne/*.bin")),
    )  # fmt: skip
    assert stopped_by_a_line(done)
    assert {p.name for p in here.iterdir()} == {"tiny.toml"}


def test_ctrl_c_while_the_program_still_imports_is_one_line(tmp_path: Path) -> None:
    code = (
        "import sys, time, pathlib, builtins\nreal = builtins.__import__\n"
        "def slow(name, *rest):\n"
        "    if name == 'typer':\n        pathlib.Path('ready').touch(); time.sleep(60)\n"
        "    return real(name, *rest)\n"
        "builtins.__import__ = slow\nfrom mapvote.__main__ import main\nmain()"
    )
    done = interrupt([sys.executable, "-c", code], tmp_path, (tmp_path / "ready").exists)
    assert stopped_by_a_line(done)


def test_a_ctrl_c_that_comes_while_an_object_is_taken_away_is_not_lost(tmp_path: Path) -> None:
    """There Python drops whatever is raised: a server that had just started went on for ever."""
    code = (
        "import os, signal, time, weakref\nimport mapvote.cli as cli\nfrom mapvote.__main__ import main\n"
        "class Thing: pass\n"
        "def run():\n"
        "    thing = Thing()\n"
        "    watch = weakref.ref(thing, lambda _: (os.kill(os.getpid(), signal.SIGINT), time.sleep(0.1)))\n"
        "    del thing\n"
        "    time.sleep(60)\n"
        "cli.run = run\nmain()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=False)
    assert stopped_by_a_line(done)


def end_by_ctrl_c(words: list[str], folder: Path, once: str) -> tuple[int, str]:
    """(exit code, all that it says) of a verb that runs until it is stopped, after it has said ``once``."""
    log = folder / "log"
    with log.open("w") as out:
        environment = {**os.environ, "CYCLONEDDS_URI": LOOPBACK, "PYTHONUNBUFFERED": "1"}
        process = subprocess.Popen(
            mapvote(*words), cwd=folder, stdout=out, stderr=subprocess.STDOUT, start_new_session=True, env=environment
        )
        try:
            end = time.monotonic() + 120.0
            while once not in log.read_text():
                assert process.poll() is None, log.read_text()
                assert time.monotonic() < end, log.read_text()
                time.sleep(0.05)
            os.killpg(process.pid, signal.SIGINT)
            return process.wait(30), log.read_text()
        finally:
            process.kill()


@pytest.mark.slow
def test_an_autoware_service_ends_on_ctrl_c_with_how_much_it_answered(tmp_path: Path) -> None:
    """It runs until it is stopped, so that this is no failure; the server may be away."""
    pytest.importorskip("cyclonedds")
    words = ["autoware", "http://127.0.0.1:9", "map", "--every", "0.1", "--domain", str(own_domain())]
    code, said = end_by_ctrl_c(words, tmp_path, "the folder stays as it is")
    assert (code, said.splitlines()[-1]) == (0, "0 requests answered"), said


def test_a_server_started_as_the_help_says_ends_on_ctrl_c(desk: Desk) -> None:
    here = desk("my_map")
    code, said = end_by_ctrl_c(["serve", "fleet.db", "--map", "my_map", "--port", "0"], here, "serving ")
    assert code == 130, said
    assert "Traceback" not in said
    assert (here / "fleet.db").exists()


@pytest.mark.parametrize("first", [1, 2, 3])
def test_ctrl_c_while_a_server_takes_the_signals_over_is_no_traceback(first: int, desk: Desk) -> None:
    """asyncio and uvicorn both install handlers, one after the other."""
    here = desk("my_map")
    patch = (
        "import os, signal, mapvote.cli\nreal, calls = signal.signal, []\n"
        "def install(*handler):\n"
        f"    calls.append(handler)\n    os.kill(os.getpid(), signal.SIGINT) if len(calls) == {first} else None\n"
        "    return real(*handler)\n"
        "signal.signal = install"
    )
    command = slowed(["serve", "fleet.db", "--map", "my_map", "--port", "0"], patch)
    done = subprocess.run(command, cwd=here, capture_output=True, text=True, timeout=120, check=False)
    assert stopped_by_a_line(done)
