"""Compiled kernels that are kept on disk: after a change of the program no old one is run, and none stops it.

They are run: where they are kept, nobody else may have put one.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numba
import pytest

from mapvote.core import kernel
from mapvote.core.kernel import choose_kernel_cache

RECORDS = """
from typing import NamedTuple
class Counts(NamedTuple):
    free: int
    hit: int
"""
PARTS = """
from mapvote.core.kernel import inlined, kernel
WEIGHT = 10
@inlined
def twice(value):
    return 2 * value
@kernel
def tenfold(value):
    return twice(value) * WEIGHT // 2
"""
LOOPS = """
from mapvote.core.kernel import kernel
from cached_sample.parts import tenfold
@kernel
def of_counts(counts):
    return tenfold(counts.hit) + counts.free
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cached_sample"
    folder.mkdir()
    for name, text in (("__init__", ""), ("records", RECORDS), ("parts", PARTS), ("loops", LOOPS)):
        (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return folder


def started_anew(record: str = "Counts") -> tuple[int, int, Path]:
    """In a process that has just imported the package: what the kernel gives, kernels compiled for it, and its index.

    Two free and three hit: 32."""
    for name in [name for name in sys.modules if name.startswith("cached_sample")]:
        del sys.modules[name]
    importlib.invalidate_caches()
    loops = importlib.import_module("cached_sample.loops")
    counts = getattr(importlib.import_module("cached_sample.records"), record)(2, 3)
    found = loops.of_counts(counts)
    stats = loops.of_counts.stats
    return found, sum(stats.cache_misses.values()), next(Path(stats.cache_path).glob("loops.of_counts*.nbi"))


def test_without_a_change_the_kept_kernel_is_loaded(package: Path) -> None:
    assert started_anew()[:2] == (32, 1)
    assert started_anew()[:2] == (32, 0)


LOADED = """
import sys
import numpy as np
from cached_sample import loops
print(getattr(loops, sys.argv[1])(np.array([20, 12])), "numba.np.arraymath" in sys.modules)
"""
OF_ARRAYS = """
import numpy as np
from mapvote.core.kernel import allocating, kernel
@kernel
def summed(a):
    return a[0] + a[1]
@allocating
def of_copy(a):
    b = a.copy()
    return summed(b)
"""


@pytest.mark.parametrize(("name", "makes_ready"), [("summed", False), ("of_copy", True)])
def test_a_kept_kernel_is_loaded_without_making_the_compiler_ready(package: Path, name: str, makes_ready: bool) -> None:
    """Unless it allocates: then it calls numba's run time, which is compiled at each start."""
    (package / "loops.py").write_text(OF_ARRAYS)
    program = [sys.executable, "-c", LOADED, name]
    paths = {"PYTHONPATH": os.pathsep.join([str(package.parent), *sys.path])}
    said = [subprocess.run(program, env=os.environ | paths, capture_output=True, text=True).stdout for _ in range(2)]
    assert said == ["32 True\n", f"32 {makes_ready}\n"]


@pytest.mark.parametrize(
    ("file", "old", "new", "expected"),
    [
        pytest.param("parts", "WEIGHT = 10", "WEIGHT = 20", 62, id="a constant that a called kernel uses"),
        pytest.param("parts", "2 * value", "4 * value", 62, id="a kernel that is inlined two files further"),
        pytest.param("records", "free: int\n    hit", "hit: int\n    free", 23, id="the order of a record's fields"),
    ],
)
def test_a_constant_that_a_kernel_takes_from_another_file_changes(
    package: Path, file: str, old: str, new: str, expected: int
) -> None:
    """numba looks at the kernel's own file alone."""
    started_anew()
    source = package / f"{file}.py"
    source.write_text(source.read_text().replace(old, new))
    assert started_anew()[:2] == (expected, 1)
    assert started_anew()[:2] == (expected, 0)


def test_how_kernels_are_compiled_changes(package: Path) -> None:
    """numba does not ask with which options it compiled what it keeps."""
    options = package / "options.py"
    options.write_text(Path(kernel.__file__).read_text())
    (package / "loops.py").write_text(LOOPS.replace("mapvote.core.kernel", "cached_sample.options"))
    assert started_anew()[:2] == (32, 1)
    options.write_text(options.read_text().replace('"nogil": True', '"nogil": False'))
    assert started_anew()[:2] == (32, 1)
    assert started_anew()[:2] == (32, 0)


def test_an_entry_that_names_a_type_that_is_gone_is_replaced(package: Path) -> None:
    started_anew()
    (package / "records.py").write_text(RECORDS.replace("Counts", "LookCounts"))
    assert started_anew("LookCounts")[:2] == (32, 1)
    assert started_anew("LookCounts")[:2] == (32, 0)


@pytest.mark.parametrize("kept", ["*.nbi", "*.nbc"])
def test_a_file_that_a_power_failure_cut_off_is_replaced(package: Path, kept: str) -> None:
    index = started_anew()[2]
    (cut,) = index.parent.glob(f"loops.of_counts{kept}")
    cut.write_bytes(cut.read_bytes()[:40])
    assert started_anew()[:2] == (32, 1)
    assert started_anew()[:2] == (32, 0)


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Nothing may be written to but the temporary folder."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    before = numba.config.CACHE_DIR
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    yield tmp_path
    numba.config.CACHE_DIR = before


def test_the_last_resort_is_a_folder_of_the_user_that_nobody_else_may_write_to(
    nowhere: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def chosen() -> Path:
        monkeypatch.setenv("NUMBA_CACHE_DIR", "")
        choose_kernel_cache()
        assert os.environ["NUMBA_CACHE_DIR"] == numba.config.CACHE_DIR
        return Path(numba.config.CACHE_DIR)

    first = chosen()
    assert (first.parent, first.stat().st_mode & 0o777) == (nowhere, 0o700)
    assert chosen() == first, "the same at each start"
    first.chmod(0o777)
    second = chosen()
    assert second != first
    assert second.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("said", ["/kernels", ""])
def test_a_cache_folder_of_the_user_stays_and_numba_uses_its_own_if_there_is_one(
    nowhere: Path, monkeypatch: pytest.MonkeyPatch, said: str
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", said)
    monkeypatch.setattr(os, "access", lambda path, mode: not said)
    choose_kernel_cache()
    assert os.environ["NUMBA_CACHE_DIR"] == said
