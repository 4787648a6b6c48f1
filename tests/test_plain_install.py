"""Verbs that work with `pip install mapvote` alone: every extra's packages are blocked, as on a machine that has
none."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from made_courts import CARS, made_court
from mapvote.core.sensors import SENSORS
from mapvote.formats import DriveWriter, write_pcd
from mapvote.formats.maps.cloud import Cloud
from streets import drive_along, path

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
MODULES = {"pyyaml": "yaml", "backports.zstd": "backports", "python-neo-lzf": "lzf", "psycopg": "psycopg"}
"""Distributions whose module has another name."""
BLOCKER = """
import sys


class Blocked:
    names = NAMES

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.names:
            raise ModuleNotFoundError(f"No module named {name!r} (blocked)", name=name)
        return None


sys.meta_path.insert(0, Blocked())
"""


def extras_alone() -> set[str]:
    """The modules of the extras that the default installation does not bring."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

    def modules(requirements: list[str]) -> set[str]:
        names = {re.split(r"[\[><=;! ]", requirement)[0].lower() for requirement in requirements}
        return {MODULES.get(name, name.replace("-", "_")) for name in names}

    wanted = [extra for name, extra in project["optional-dependencies"].items() if name not in ("dev", "docs")]
    return set().union(*map(modules, wanted)) - modules(project["dependencies"]) - {"mapvote"}


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two courts, a drive through one, and a ``sitecustomize`` that blocks the extras."""
    folder = tmp_path_factory.mktemp("plain")
    blocked = extras_alone()
    assert {"sqlalchemy", "fastapi", "laspy", "rosbags", "matplotlib", "pyproj", "small_gicp"} <= blocked
    assert "numpy" not in blocked
    (folder / "site").mkdir()
    (folder / "site/sitecustomize.py").write_text(BLOCKER.replace("NAMES", repr(sorted(blocked))))
    write_pcd(folder / "a.pcd", Cloud(made_court()))
    write_pcd(folder / "b.pcd", Cloud(made_court(CARS[1:], seed=2)))
    poses = path(20)
    drive = drive_along(poses, 31)
    writer = DriveWriter(folder / "drive", "car", SENSORS["hdl32e"], 10**18, motion_compensated=False).open()
    for i, scan in enumerate(drive):
        writer.write_scan(i, scan.points)
    writer.close(10**18 + drive.stamps_ns, poses)
    return folder


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """The program in a process of its own, without any extra."""
    paths = os.pathsep.join([str(folder / "site"), str(ROOT / "src")])
    command = [sys.executable, "-m", "mapvote", *words]
    environment = {**os.environ, "PYTHONPATH": paths}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


@pytest.mark.parametrize(
    "line",
    [
        "import a.pcd map_a",
        "info map_a",
        "export map_a tiles",
        "export map_a again.pcd",
        "diff a.pcd b.pcd --out d.geojson --html d.html",
        "merge a.pcd b.pcd --out merged",
        "vote b.pcd --map map_a --out cloud.ballot",
        "update map_a cloud.ballot --dry-run --min-votes 1",
        "build drive --out map_built",
        "vote drive --map map_built --vehicle car_1 --out car_1.ballot",
        "doctor drive",
        "config --all",
    ],
)
def test_a_verb_works_without_any_extra(plain: Path, line: str) -> None:
    """The lines follow each other: later ones read what earlier ones wrote."""
    done = run(plain, *line.split())
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    if line == "config --all":
        assert "KeyGuess" not in done.stdout
        assert "modules are not listed: this needs the package" in " ".join(done.stdout.split())


@pytest.mark.parametrize(
    ("line", "extra"),
    [
        ("serve fleet.db --map a.pcd --open", "server"),
        ("export map_a city.laz", "las"),
        ("doctor drive --png d.png", "plots"),
        ("build drive --out m --report r.png", "plots"),
        ("vote drive --map map_built --vehicle c --out d.ballot --config vgicp.toml", "vgicp"),
        ("drive --map map_a --vehicle car_1 --out ballots --metrics 0", "ros2"),
        ("topics", "ros2"),
        ("demo", "lab"),
        ("simulate corner street", "lab"),
    ],
)
def test_a_verb_that_needs_an_extra_names_it_before_it_works(plain: Path, line: str, extra: str) -> None:
    (plain / "vgicp.toml").write_text('[ndt]\nmatcher = "vgicp"\n')
    done = run(plain, *line.split())
    assert done.returncode == 1
    assert f"mapvote[{extra}]" in done.stderr, done.stderr[-2000:]
    assert "Traceback" not in done.stderr
