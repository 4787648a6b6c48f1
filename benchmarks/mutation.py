"""Do the tests notice a changed operator? Random one-operator mutants of the modules that decide.

    python benchmarks/mutation.py [--mutants 200] [--seed 1] [--only fusion/fuse.py] [--minutes 14]

Every module gives the same number of mutants, drawn by the seed. A mutant is killed if a test of those that name its
module fails, crashes or takes too long. Results are added to ``results/mutation.csv`` as they come: a run that was cut
goes on where it stopped, and survivors are tried again once a test has changed. Mutants of a module that has changed
since are thrown away. ``--report`` runs nothing and writes the table.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import NoReturn

for threads in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[threads] = "1"

import hypothesis.extra.numpy  # noqa: E402, F401
import msgspec  # noqa: E402, F401
import numba  # noqa: E402
import pydantic  # noqa: E402, F401
import pytest  # noqa: E402
import scipy.ndimage  # noqa: E402
import scipy.spatial  # noqa: E402, F401
import sqlalchemy  # noqa: E402, F401

from mutants_of_code import Mutant, mutants_of  # noqa: E402
from mutation_results import ROOT, Result, read_results, report, write_results  # noqa: E402
from numba_caches import link_others  # noqa: E402

TESTS = {
    "core/voting.py": ["core/test_voting.py", "core/test_voting_model.py", "fusion/test_fuse.py"],
    "fusion/fuse.py": [
        *(f"fusion/test_{n}.py" for n in ("fuse", "outliers", "turning", "last_word", "persistence", "copies"))
    ],
    "fusion/tile_vote.py": ["fusion/test_tile_vote.py", "fusion/test_fuse.py"],
    "fusion/edit.py": ["fusion/test_edit.py", "fusion/test_fuse.py"],
    "fusion/outliers.py": ["fusion/test_outliers.py"],
    "fusion/spent.py": ["fusion/test_spent.py"],
    "fusion/persistence.py": ["fusion/test_persistence.py"],
    "fusion/copies.py": ["fusion/test_copies.py"],
    "fusion/turning.py": ["fusion/test_turning.py"],
    "fusion/spilled.py": ["fusion/test_spilled.py"],
    "fusion/deletions.py": ["fusion/test_deletions.py"],
    "fusion/odds.py": ["fusion/test_odds.py"],
    "fusion/pending.py": ["fusion/test_pending.py"],
    "fusion/probability.py": ["fusion/test_probability.py", "fusion/test_pending.py"],
    "server/store/votes.py": ["server/store/test_votes.py"],
    "server/store/publish_limits.py": ["server/store/test_publish_limits.py"],
    "detection/paper.py": ["detection/test_paper.py"],
    "detection/evidence.py": ["detection"],
    "detection/surface_rules.py": ["detection"],
    "detection/surfaces.py": ["detection/test_surfaces.py"],
    "detection/confidence.py": ["detection"],
    "perception/moving_kernels.py": ["perception/test_moving_kernels.py", "perception/test_moving_objects.py"],
    "perception/fans.py": ["perception/test_fans.py", "perception/test_raycast.py"],
    "perception/raycast.py": ["perception/test_raycast.py"],
    "perception/sky.py": ["perception/test_sky.py"],
    "core/ground_growing.py": ["core/test_ground.py"],
    "slam/clean_map.py": ["slam/test_strays.py", "slam/test_trails.py", "slam/test_mirrored.py"],
    "localisation/odometry.py": ["localisation/test_odometry.py"],
    "localisation/pose_check.py": ["localisation/test_pose_check.py"],
}
"""The deciding modules, and the tests that name them, quick ones first."""
HOUSE = Path(os.environ.get("MUTATION_HOUSE", Path(tempfile.gettempdir()) / "mapvote-mutation"))
"""A copy of the sources, in which the mutants live, and numba's caches."""
MEMORY_BYTES = 8 << 30
"""Of address space: a mutant that asks for all memory gets none."""
QUICK = """
from hypothesis import Phase, settings
phases = [Phase.explicit, Phase.generate]
settings.register_profile("quick", derandomize=True, deadline=None, database=None, phases=phases)
"""
"""Hypothesis' profile: what falsifies a mutant need not be made small."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=list(TESTS), default=list(TESTS), metavar="MODULE")
    parser.add_argument("--minutes", type=float, default=1e9, help="stop after this long; the next run goes on")
    parser.add_argument("--at-most", type=int, default=1_000_000, metavar="N", help="new ones of each module")
    parser.add_argument("--out", type=Path, default=ROOT / "results/mutation.csv")
    parser.add_argument("--report", action="store_true", help="only print the table from the results")
    arguments = parser.parse_args()
    if not arguments.report:
        until = time.monotonic() + 60.0 * arguments.minutes
        copy_house()
        for module in arguments.only:
            share = -(-arguments.mutants // len(TESTS))
            try_module(module, share, arguments.seed, arguments.out, until, arguments.at_most)
    if arguments.out == ROOT / "results/mutation.csv":
        report(read_results(arguments.out))


def copy_house() -> None:
    """The sources and tests of today, byte for byte and with their times, which numba's caches go by."""
    for part in ("src", "tests"):
        shutil.rmtree(HOUSE / part, ignore_errors=True)
        shutil.copytree(ROOT / part, HOUSE / part, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy2(ROOT / "pyproject.toml", HOUSE / "pyproject.toml")
    (HOUSE / "tests" / "quick_hypothesis.py").write_text(QUICK)


def try_module(module: str, share: int, seed: int, out: Path, until: float, at_most: int) -> None:
    """Run what is still to be run of a module's mutants."""
    source = (ROOT / "src/mapvote" / module).read_text()
    every = list(mutants_of(module, source))
    drawn = random.Random(f"{seed} {module}").sample(every, min(share, len(every)))
    of_source, of_tests = digest(ROOT / "src/mapvote" / module), digest(*(ROOT / "tests" / t for t in TESTS[module]))
    known = [r for r in read_results(out) if r.module == module]
    alike = Counter(r.change for r in known)  # tests may have been written since the module was as it was then
    firsts = {r.change: r.first for r in known if alike[r.change] == 1}
    tried = {(r.seed, r.place): r for r in known if r.source == of_source}
    write_results(out, [*(r for r in read_results(out) if r.module != module), *tried.values()])
    done = {r.place for r in tried.values() if r.seed == seed and (r.outcome != "survived" or r.tests == of_tests)}
    waiting = [mutant for mutant in drawn if mutant.place not in done][:at_most]
    if not waiting or time.monotonic() > until:
        return
    limit_s = 60.0 + 4.0 * unchanged(module)
    for mutant in waiting:
        if time.monotonic() > until:
            return
        outcome, seconds = try_mutant(mutant, limit_s)
        before = tried.get((seed, mutant.place))
        first = before.first if before else firsts.get(mutant.change, outcome)
        result = Result(
            seed, module, mutant.place, mutant.line, mutant.change, outcome, first, seconds, of_source, of_tests
        )
        print(module, mutant.line, mutant.change, outcome, f"{seconds:.1f} s", sep="  ", flush=True)
        write_results(out, [*(r for r in read_results(out) if r != before), result])


def digest(*paths: Path) -> str:
    """Of files and folders of Python."""
    if missing := [str(path) for path in paths if not path.exists()]:
        raise SystemExit(f"{', '.join(missing)}: not there")
    files = sorted(file for path in paths for file in ([path] if path.is_file() else path.rglob("*.py")))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


def common_cache() -> Path:
    """Where numba keeps the kernels of these very sources."""
    return HOUSE / f"cache-{digest(ROOT / 'src')}"


def unchanged(module: str) -> float:
    """Seconds that the module's tests take as it is, and pass; every kernel is compiled afterwards."""
    done, seconds = run_tests(module, common_cache(), 900.0)
    if done != "survived":
        raise SystemExit(f"{module}: its tests do not pass ({done}); see {HOUSE / 'last-run.txt'}")
    return seconds


def try_mutant(mutant: Mutant, limit_s: float) -> tuple[str, float]:
    """(outcome, seconds) of the module's tests on a mutant."""
    file = HOUSE / "src/mapvote" / mutant.module
    cache = HOUSE / "cache-of-mutant"
    shutil.rmtree(cache, ignore_errors=True)
    link_others(common_cache(), cache, ROOT / "src/mapvote", mutant.module)
    file.write_text(mutant.text)
    try:
        return run_tests(mutant.module, cache, limit_s)
    finally:
        shutil.copy2(ROOT / "src/mapvote" / mutant.module, file)


def run_tests(module: str, cache: Path, limit_s: float) -> tuple[str, float]:
    """(killed, crashed, hangs or survived, seconds). SystemExit if pytest itself failed."""
    began = time.monotonic()
    child = os.fork()
    if child == 0:
        _pytest([f"tests/{test}" for test in TESTS[module]], cache)
    while not (done := os.waitpid(child, os.WNOHANG))[0]:
        if time.monotonic() - began > limit_s:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "hangs", time.monotonic() - began
        time.sleep(0.02)
    code, seconds = os.waitstatus_to_exitcode(done[1]), time.monotonic() - began
    if code < 0:
        return "crashed", seconds
    if code not in (0, 1, 2):  # 2: a module that cannot be imported
        raise SystemExit(f"{module}: pytest ended with {code}; see {HOUSE / 'last-run.txt'}")
    return "killed" if code else "survived", seconds


def _pytest(tests: list[str], cache: Path) -> NoReturn:
    """Run tests in this process, a fork of one that has imported what takes long and is never changed: of every run
    that is the larger part. Plugins of pytest that other packages bring are left out for the same reason."""
    code = 3
    try:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        log = os.open(HOUSE / "last-run.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.chdir(HOUSE)
        sys.path[:0] = [str(HOUSE / "src"), str(HOUSE / "tests")]
        sys.dont_write_bytecode = True
        os.environ |= {"NUMBA_CACHE_DIR": str(cache), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_ADDOPTS": ""}
        numba.core.config.reload_config()
        plugins = ("no:cacheprovider", "_hypothesis_pytestplugin", "quick_hypothesis")
        options = ["-q", "-x", *(word for name in plugins for word in ("-p", name)), "--hypothesis-profile=quick"]
        code = int(pytest.main([*options, *tests]))
    finally:
        os._exit(code)


if __name__ == "__main__":
    main()
