"""Warming up compiles what a vehicle runs, and a program that nobody may write to keeps its kernels elsewhere."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import mapvote
from mapvote.core.ground_growing import grow
from mapvote.core.voting import add_states
from mapvote.fusion.copies import grouped
from mapvote.fusion.outliers import contradicting
from mapvote.localisation.ndt_solver import align
from mapvote.perception.range_image import look
from mapvote.warmup import warm_up

SOURCES = Path(mapvote.__file__).parent


@pytest.mark.slow
def test_warming_up_goes_through_every_step_and_says_what_each_took() -> None:
    told = list(warm_up())
    assert len(told) == 5
    assert all(seconds > 0 for _, seconds in told)
    for kernel in (align, add_states, look, grow, contradicting, grouped):
        assert kernel.signatures


@pytest.mark.slow
def test_a_read_only_install_keeps_its_kernels_in_the_users_cache(tmp_path: Path) -> None:
    installed = shutil.copytree(
        SOURCES, tmp_path / "site" / "mapvote", ignore=shutil.ignore_patterns("__pycache__", "*.nbi", "*.nbc")
    )
    for path in (installed, *installed.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    home = tmp_path / "home"
    home.mkdir(mode=0o777)
    tmp_path.chmod(0o755)
    command = [
        sys.executable,
        "-c",
        "import numpy as np; from mapvote.core.voxels import thin; thin(np.zeros((3, 3)), .3)",
    ]
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(tmp_path / "site"), "HOME": str(home)}
    if os.getuid() == 0:  # root may write anywhere: become nobody
        for folder in tmp_path.parents:
            if not folder.stat().st_mode & 0o005:
                pytest.skip(f"nobody cannot enter {folder}")
        shutil.chown(home, 65534)
        code = f"import os; os.setuid(65534); os.execv({command[0]!r}, {command!r})"
        command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert list(home.rglob("*.nbi"))
    assert not list(installed.rglob("*.nbi"))
