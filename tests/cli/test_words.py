"""Every command and every Python block of the documents, and every example of a --help, run word for word.

A block runs in a folder of its own, in which only the things lie that its reader has before the first line. Whatever is
not run is in ``NOT_RUN``, with the reason.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from command_line import type_in
from mapvote.cli import app
from mapvote.formats import registry
from mapvote.formats.drives.options import drive_options

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
Desk = Callable[..., Path]

NOT_RUN = {
    r"^python3 -m venv": "installs from the network: CI runs the test line, tests/test_wheel.py installs",
    r"^pip install": "changes the machine: tests/test_wheel.py installs every extra",
    r"^(systemctl|sqlite3|pg_dump|mkdir) ": "another program's command",
    r"^(colcon|ros2) ": "needs ROS 2: tests/live/test_ros_node.py runs the node with stand-ins for rclpy",
    r"postgresql\+psycopg://mapvote@db": "names a machine that is not here; tests/server runs PostgreSQL",
    r"\bmy_bag\b": "needs a recorded bag: tests/live/test_drive.py votes with one as it was heard live",
    r"\.\./shared/data/kitti": "needs the KITTI scans: tests/evaluation/real runs it where they are",
    r"^mapvote evaluate real ": "takes minutes on a real drive: tests/evaluation/real runs it",
    r"^mapvote evaluate court ": "needs the clouds of the real court (docs/diff.md), and takes minutes",
    r"^mapvote demo$": "takes a minute: tests/evaluation/test_evaluate.py runs it",
    r"^mapvote demo \w*DRIVE": "needs a drive of 24 scans: tests/evaluation/test_evaluate.py runs one",
    r"maps\.example\.org": "names a server that is not here: tests/cli/test_follow.py follows a real one",
    r"^mapvote (evaluate|simulate) (street|street570|as_published)\b": (
        "takes many minutes and gigabytes: `corner` is run from the help instead"
    ),
    r"http://127\.0\.0\.1:8080": "needs the server of the block before: tests/cli/test_vote.py votes with a real one",
    r"^mapvote (play|drive|topics)\b": "needs a second process on DDS: tests/live/test_drive.py runs both",
    r"^mapvote vote my_bag": "needs a bag of a drive: tests/live/test_drive.py votes on one",
    r"^mapvote serve ": "runs until it is stopped: tests/cli/test_interrupt.py does both",
    r"^python benchmarks/": "takes minutes to hours: only its options are looked up here",
}
SLOW = r"^mapvote (demo|simulate|evaluate|warmup|build|diff|merge|vote session\.pcd)\b"
STANDS_FOR = {"VERSION": "1"}
"""Placeholders that no file can be called by."""


def blocks() -> Iterator[tuple[str, str, str]]:
    """(page:line, language, text) of every fenced block."""
    for page in PAGES:
        text = page.read_text()
        for block in re.finditer(r"^```(\w*)\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
            line = text[: block.start()].count("\n") + 2
            yield f"{page.relative_to(ROOT)}:{line}", block[1], block[2]


def commands(text: str) -> list[str]:
    """The lines that a reader types; a transcript marks them by a dollar."""
    lines = [line.strip() for line in text.replace("\\\n", " ").splitlines()]
    if any(line.startswith("$ ") for line in lines):
        lines = [line[2:] for line in lines if line.startswith("$ ")]
    return [line for line in lines if line and not line.startswith("#")]


def not_run(line: str) -> str | None:
    return next((reason for pattern, reason in NOT_RUN.items() if re.search(pattern, line)), None)


SHELL = [
    (where, commands(text))
    for where, language, text in blocks()
    if language in ("", "sh", "bash", "console") and not where.startswith("docs/vehicles.md")
]
"""The tutorial is one story, from block to block: tests/cli/test_tutorial.py tells it whole."""
ALTERNATIVES = [
    (where, [other]) for where, lines in SHELL for line in lines for other in re.findall(r"# or: (mapvote .*)", line)
]
PYTHON = [(where, text) for where, language, text in blocks() if language == "python"]
TOML = [(where, text) for where, language, text in blocks() if language == "toml" and where.startswith("docs/formats")]


def laid_for(lines: list[str], made: Path) -> list[str]:
    """Names in ``made`` that these commands read: they name them before any of them writes them."""
    read: list[str] = []
    written: set[str] = set()
    for line in lines:
        words = [word.rstrip("/") for word in line.partition(" #")[0].split()]
        out = {b for a, b in pairwise(words) if a in ("--out", ">")}
        if words[1:2] and words[1] in ("import", "export", "simulate"):
            out.add(words[3])
        read += [w for w in words if w not in out | written | set(read) and (made / w).exists()]
        written |= out
    return read


def run_all(lines: list[str], made: Path, desk: Desk) -> None:
    lines = [line for line in lines if not_run(line) is None]
    desk(*laid_for(lines, made))
    for line in lines:
        type_in(re.sub(r"\b(VERSION)\b", lambda m: STANDS_FOR[m[0]], line))


def is_slow(lines: list[str]) -> bool:
    return any(re.search(SLOW, line) and not_run(line) is None for line in lines)


@pytest.mark.parametrize(
    ("where", "lines"),
    [
        pytest.param(where, lines, id=where, marks=[pytest.mark.slow] if is_slow(lines) else [])
        for where, lines in SHELL + ALTERNATIVES
        if any(not_run(line) is None for line in lines)
    ],
)
def test_the_commands_of_a_page_work_word_for_word(where: str, lines: list[str], made: Path, desk: Desk) -> None:
    run_all(lines, made, desk)


@pytest.mark.parametrize(("where", "text"), PYTHON, ids=lambda v: v.partition("\n")[0])
def test_the_python_of_a_page_works_word_for_word(where: str, text: str, made: Path, desk: Desk) -> None:
    desk(*(name for name in dict.fromkeys(re.findall(r'"([\w./]+)"', text)) if (made / name).exists()))
    tables: list[dict[str, Any]] = [registry.DRIVES, registry.MAPS, registry.WRITERS]
    before = [dict(table) for table in tables]
    try:
        exec(compile(text, where, "exec"), {"__name__": "page"})
    finally:  # a format that a page adds is none of the other tests'
        for table, rows in zip(tables, before, strict=True):
            table.clear()
            table.update(rows)


@pytest.mark.parametrize(("where", "text"), TOML, ids=lambda v: v.partition("\n")[0])
def test_the_drive_files_of_a_page_can_be_read(where: str, text: str, tmp_path: Path) -> None:
    (tmp_path / "drive.toml").write_text(text)
    about = drive_options(tmp_path)
    assert all(getattr(about, key) == value for key, value in tomllib.loads(text).items())


def examples() -> list[str]:
    """The indented lines of every verb's help."""
    helps = [command.help or "" for command in get_command(app).commands.values()]  # type: ignore[attr-defined]
    return [line.strip() for text in helps for line in text.splitlines() if re.match(r"\s*mapvote ", line)]


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, marks=[pytest.mark.slow] if is_slow([line]) else [])
        for line in examples()
        if not_run(line) is None and not any(line in lines for _, lines in SHELL)
    ],
)
def test_the_example_of_a_help_works_if_no_page_has_it_word_for_word(line: str, made: Path, desk: Desk) -> None:
    run_all([line], made, desk)


@pytest.mark.parametrize(
    "line", [line for _, lines in SHELL for line in lines if line.startswith("python benchmarks/")]
)
def test_a_benchmark_of_a_page_is_there_and_takes_its_options(line: str) -> None:
    _, script, *arguments = line.partition(" #")[0].split()
    text = (ROOT / script).read_text()
    assert all(f'"{word}"' in text for word in arguments if word.startswith("--"))


def test_no_exemption_is_stale() -> None:
    lines = [*(line for _, lines in SHELL for line in lines), *examples()]
    assert [pattern for pattern in NOT_RUN if not any(re.search(pattern, line) for line in lines)] == []


def test_the_test_line_of_the_readme_is_the_one_that_ci_runs() -> None:
    said = subprocess.run(
        ["bash", "-c", "grep -A2 '<!-- test line -->' README.md | tail -n 1"], cwd=ROOT, capture_output=True, text=True
    ).stdout.strip()
    assert any(said in lines for where, lines in SHELL if where.startswith("README.md"))
    assert said.endswith("&& ./check")


def test_the_module_runs_as_the_command_does() -> None:
    installed = str(Path(sys.executable).with_name("mapvote"))
    told = [
        subprocess.run(command, capture_output=True, text=True, check=True).stdout
        for command in ([sys.executable, "-m", "mapvote", "--version"], [installed, "--version"])
    ]
    assert told[0] == told[1]
