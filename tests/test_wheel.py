"""The wheel in clean environments: it drives and edits maps; an extra brings its verbs; a missing one says so."""

from __future__ import annotations

import os
import shutil
import subprocess
import venv
from pathlib import Path

import numpy as np
import pytest

from fresh_wheel import packed
from mapvote.formats import write_pcd
from mapvote.formats.maps.cloud import Cloud

pytestmark = pytest.mark.slow

BASE_LACKS = ["sqlalchemy", "alembic", "fastapi", "uvicorn", "structlog", "embreex", "matplotlib", "small_gicp"]
TRIES = {
    "server": ["log", "no-store.db"],
    "lab": ["simulate", "no-scenario", "out"],
}
"""A verb of each extra, and words that make it fail without it, and otherwise at something else."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return packed(tmp_path_factory.mktemp("wheel"))


def install(folder: Path, what: str) -> Path:
    """The ``bin`` of a new environment in which ``what`` is installed."""
    venv.create(folder, with_pip=True)
    pip_install(folder / "bin", what)
    return folder / "bin"


def pip_install(bin_: Path, what: str) -> None:
    subprocess.run([bin_ / "pip", "install", "-q", what], check=True, timeout=900)


def run(bin_: Path, folder: Path, *words: object, code: int = 0) -> str:
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(bin_ / "mapvote"), *map(str, words)]
    done = subprocess.run(command, cwd=folder, env=clean, capture_output=True, text=True, timeout=300)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def importable(bin_: Path, modules: list[str]) -> list[str]:
    code = f"from importlib.util import find_spec as f; print(*[m for m in {modules!r} if f(m)])"
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run([bin_ / "python", "-c", code], env=clean, capture_output=True, text=True).stdout.split()


def import_a_map(bin_: Path, folder: Path) -> None:
    write_pcd(folder / "city.pcd", Cloud(np.random.default_rng(0).uniform([0, 0, 0], [50, 50, 4], (5000, 3))))
    run(bin_, folder, "import", "city.pcd", "my_map")
    assert "5,000" in run(bin_, folder, "info", "my_map")


def test_the_wheel_alone_edits_maps_and_each_extra_brings_its_verbs(wheel: Path, tmp_path: Path) -> None:
    """One after the other into one environment: a verb whose extra is not there yet names it."""
    bin_ = install(tmp_path / "env", str(wheel))
    assert importable(bin_, BASE_LACKS) == []
    assert run(bin_, tmp_path, "--version").startswith("mapvote ")
    import_a_map(bin_, tmp_path)
    run(bin_, tmp_path, "export", "my_map", "tiles")
    run(bin_, tmp_path, "config", "--toml")
    lacking = list(TRIES)
    while lacking:
        for extra in lacking:
            said = run(bin_, tmp_path, *TRIES[extra], code=1)
            assert f"pip install 'mapvote[{extra}]'" in said
            assert "Traceback" not in said
        extra = lacking.pop(0)
        pip_install(bin_, f"{wheel}[{extra}]")
        said = run(bin_, tmp_path, *TRIES[extra], code=1)
        assert "pip install" not in said
        assert "Traceback" not in said


@pytest.mark.parametrize("python", ["python3.12", "python3.13"])
def test_another_python_installs_and_runs_the_wheel(wheel: Path, python: str, tmp_path: Path) -> None:
    program = shutil.which(python)
    if program is None or subprocess.run([program, "-c", "import venv"], capture_output=True).returncode:
        pytest.skip(f"no working {python} on this machine")
    subprocess.run([program, "-m", "venv", tmp_path / "env"], check=True, timeout=120)
    bin_ = tmp_path / "env" / "bin"
    pip_install(bin_, str(wheel))
    import_a_map(bin_, tmp_path)
