"""First contact: the version, the help of every verb, completion, and errors whose words survive the terminal."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command

from command_line import typed
from live_server import mapvote
from mapvote.cli import app, run
from mapvote.cli.options import DRIVE_OPTIONS
from mapvote.cli.terminal import print_table
from mapvote.formats import open_drive
from mapvote.formats.drives.options import SaidOfDrive

VERBS = sorted(get_command(app).commands)  # type: ignore[attr-defined]


def test_the_version_is_the_packages() -> None:
    from importlib.metadata import version

    assert typed("--version") == f"mapvote {version('mapvote')}\n"


def test_help_groups_every_verb() -> None:
    told = typed("--help")
    for group in ("Drive", "Map", "Server", "Simulate and evaluate", "Set up"):
        assert f"─ {group} ─" in told
    assert "─ Commands ─" not in told  # where typer puts what has no group
    assert "--install-completion" in told


@pytest.mark.parametrize("verb", VERBS)
def test_the_help_of_every_verb_ends_with_an_example_and_explains_all_that_it_takes(verb: str) -> None:
    text = typed(verb, "--help")
    assert f" mapvote {verb} " in text.split("╭─")[0].partition("Usage:")[2].partition("\n")[2]
    for parameter in get_command(app).commands[verb].params:  # type: ignore[attr-defined]
        assert getattr(parameter, "help", "") or parameter.name == "help", f"{verb}: {parameter.name}"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_can_complete(shell: str) -> None:
    said = subprocess.run(
        mapvote(), env=os.environ | {"_MAPVOTE_COMPLETE": f"source_{shell}"}, capture_output=True, text=True
    )
    assert "_MAPVOTE_COMPLETE" in said.stdout


def test_drive_options_are_those_of_open_drive_for_every_verb_that_takes_a_drive() -> None:
    assert set(inspect.signature(open_drive).parameters) == {"path", "said"}
    assert set(DRIVE_OPTIONS) | {"vehicle", "frame", "as_live"} == set(SaidOfDrive.__annotations__)
    for verb in ("build", "vote", "doctor"):
        assert {p.name for p in get_command(app).commands[verb].params} >= set(DRIVE_OPTIONS)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["info", "street[las].pcd"], "mapvote: street[las].pcd: nothing is there"),
        (["update", "map", "a.ballot", "--dry-run"], "mapvote: a.ballot: cannot be read (No such file or directory)"),
        (["simulate", "corner", "file/street"], "mapvote: file/"),
    ],
)
def test_a_mistake_is_one_line_on_stderr(
    words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["mapvote", *words])
    with pytest.raises(SystemExit) as end:
        run()
    shown = capsys.readouterr()
    assert (end.value.code, shown.out) == (1, "")
    assert shown.err.startswith(said)
    assert len(shown.err.splitlines()) == 1


def test_a_wrong_option_is_a_usage_error() -> None:
    assert "No such option" in typed("simulate", "corner", "--sed", 3, code=2)


def test_listing_the_verbs_imports_nothing_heavy() -> None:
    code = (
        "import sys; from mapvote.cli import app; heavy = ('numba', 'scipy', 'sqlalchemy', 'fastapi', 'matplotlib', "
        "'embreex', 'httpx2'); print([name for name in heavy if name in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


def test_square_brackets_of_files_survive_in_tables_too(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(("of [las]",), [["a[bold]b"]], title="street[las]")
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("of [las]", "a[bold]b", "street[las]"))


def test_a_table_in_a_pipe_has_one_line_a_row(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    print_table(("first", "second"), [["a " * 80, "b " * 80]])
    assert len(capsys.readouterr().out.splitlines()) == 5
