"""Warming up compiles what a vehicle runs, and a program that nobody may write to keeps its kernels elsewhere."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import mapvote
from mapvote.core.ground import _grow
from mapvote.core.voting import count_states
from mapvote.fusion.copies import find_alike
from mapvote.fusion.distrust import contradicts
from mapvote.matching.ndt import align
from mapvote.perception.moving_objects import look
from mapvote.warmup import warm_up
from mapvote_lab.simulation import simulate

SOURCES = Path(mapvote.__file__).parent
_BOUND = "-dac_override,-dac_read_search"
"""Two of root's capabilities: without them permissions hold for it too."""


@pytest.mark.slow
def test_warming_up_goes_through_every_step_and_says_what_each_took() -> None:
    told = list(warm_up())
    assert len(told) == 7
    assert all(seconds > 0 for _, seconds in told)
    for kernel in (align, count_states, look, _grow, contradicts, find_alike):
        assert kernel.signatures


MOST_LOADED = 81
"""Specialisations that Python calls: each takes .02 to 2 s of CPU to compile."""
LISTING = """
import gc
import sys
from numba.core.registry import CPUDispatcher
from mapvote.__main__ import main

try:
    main()
finally:
    gc.unfreeze()
    kernels = [kernel for kernel in gc.get_objects() if isinstance(kernel, CPUDispatcher)]
    for kernel in kernels:
        for signature in kernel.signatures:
            print("kernel", kernel.py_func.__module__, kernel.py_func.__qualname__, signature)
    print("compiler", "numba.np.arraymath" in sys.modules)
"""


@pytest.mark.slow
def test_once_warmed_up_no_verb_compiles_anything(tmp_path: Path) -> None:
    """A drive that stops for seconds in its middle, for a kernel to be compiled, was warmed up for nothing.

    Kernels that earlier tests left do not hide one: those that a verb calls are compared with those of ``warmup``. No
    kernel that is kept needs what numba has for arrays, np.round of a number for one: that imports scipy, 19 MB.
    """

    def kernels_of(*words: str) -> set[str]:
        command = [sys.executable, "-c", LISTING, *words]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert words == ("warmup",) or "compiler False" in done.stdout
        return {line for line in done.stdout.splitlines() if line.startswith("kernel mapvote")}

    simulate("corner", tmp_path / "street")
    kernels_of("warmup")  # one that compiles has kernels that only kernels call, too
    warm = kernels_of("warmup")
    assert 60 < len(warm) <= MOST_LOADED
    assert set() < kernels_of("build", "street/survey_1", "--scans", ":40", "--out", "map") <= warm
    shutil.copytree(tmp_path / "street/v1", tmp_path / "street/lost")
    (tmp_path / "street/lost/prior.txt").unlink()
    for vehicle in ("v1", "v2", "lost"):
        assert set() < kernels_of("vote", f"street/{vehicle}", "--map", "map", "--out", f"{vehicle}.ballot") <= warm
    assert set() < kernels_of("update", "map", "v1.ballot", "v2.ballot", "--out", "map_2") <= warm


MARKED = """
from mapvote.warmup import compiled_mark, leave_mark
print(compiled_mark().exists())
leave_mark()
assert compiled_mark().exists()
"""


def test_kernels_are_known_to_be_compiled_until_a_source_changes(tmp_path: Path) -> None:
    """The demo asks, instead of running through everything that may have to be compiled."""
    installed = shutil.copytree(SOURCES, tmp_path / "mapvote", ignore=shutil.ignore_patterns("__pycache__"))
    kernels = tmp_path / "kernels"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(kernels)}

    def marked_before() -> str:
        done = subprocess.run([sys.executable, "-c", MARKED], env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    assert [marked_before(), marked_before()] == ["False", "True"]
    with (installed / "matching" / "ndt.py").open("a") as source:
        source.write("# another line\n")
    assert marked_before() == "False"
    assert len(list(kernels.rglob("compiled-*"))) == 1


@pytest.mark.slow
@pytest.mark.parametrize("cache", ["the user's", "the temporary folder's, where there is no home"])
def test_a_read_only_install_keeps_its_kernels_in_a_cache(tmp_path: Path, cache: str) -> None:
    installed = shutil.copytree(
        SOURCES, tmp_path / "site" / "mapvote", ignore=shutil.ignore_patterns("__pycache__", "*.nbi", "*.nbc")
    )
    for path in (installed, *installed.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    home, temporary = tmp_path / "home", tmp_path / "temporary"
    kept = home if cache == "the user's" else temporary
    kept.mkdir()
    if kept is temporary:
        home = installed / "no home"
    command = [
        sys.executable,
        "-c",
        "import numpy as np; from mapvote.core.voxels import thin; thin(np.zeros((3, 3)), .3)",
    ]
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(installed.parent), "HOME": str(home)}
    environment["TMPDIR"] = str(kept)
    if os.getuid() == 0:  # root may write anywhere, but for this
        command = ["setpriv", f"--inh-caps={_BOUND}", f"--bounding-set={_BOUND}", *command]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert list(kept.rglob("*.nbi"))
    assert all(not found.stat().st_mode & 0o022 for found in kept.glob("mapvote-kernels-*"))
    assert not list(installed.rglob("*.nbi"))
