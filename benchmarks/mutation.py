"""Do the tests notice a changed operator? Random one-operator mutants of the modules that decide.

    python benchmarks/mutation.py [--mutants 8] [--seed 1] [--only fusion/fuse ...]

Each module gives the same number of mutants, drawn by the seed: an operator, a small constant or a negation is changed,
min becomes max, any becomes all. A mutant is killed if a test of its module fails, crashes or takes four times as long.
Ends with 1 below 90 % killed, or below 80 % in one module, equal mutants (benchmarks/equal_mutants.csv) apart.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import csv
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
DECIDING = [
    "core/voting", "core/ground", "fusion/fuse", "fusion/tile_vote", "fusion/edit", "fusion/distrust", "fusion/copies",
    "fusion/loss_budget", "fusion/neighbour_noise", "fusion/change_time", "rules/paper", "rules/evidence",
    "rules/packed_tiles", "rules/voxel_counts", "rules/surfaces", "perception/fans", "perception/raycast",
    "survey/clean_map",
    "mapvote_server/store/votes", "mapvote_server/store/publish", "matching/odometry", "matching/pose_check",
    "doctor/map_fit", "doctor/prior_fit", "formats/drives/trajectory", "formats/geo/units",
]  # fmt: skip
TESTS = {
    **{m: "fusion/test_fuse.py fusion/test_rules_of_fusion.py" for m in DECIDING if m.startswith("fusion/")},
    **{m: "rules" for m in DECIDING if m.startswith("rules/")},
    "core/voting": "fusion/test_fuse.py",
    "fusion/fuse": "fusion/test_distrust.py fusion/test_rules_of_fusion.py",
    "perception/fans": "perception/test_raycast.py",
    "mapvote_server/store/votes": "server/store/test_rules.py server/store/test_store.py",
    "mapvote_server/store/publish": "server/store/test_publish_limits.py server/store/test_store.py server/questions",
    "doctor/map_fit": "doctor/test_drives.py",
    "doctor/prior_fit": "doctor/test_small.py",
    "formats/drives/trajectory": "formats/drives",
    "formats/geo/units": "formats/geo/test_frames.py",
}
"""The tests that must notice, beside those of the module's own name."""
SWAPS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Add, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
}  # fmt: skip
NAMES = {"min": "max", "max": "min", "any": "all", "all": "any"}


def left_out(tree: ast.Module) -> set[int]:
    """Nodes that stay: annotations, decorators, texts, errors, constants of the module, sizes (any negative is one)."""
    parts: list[ast.AST | None] = [s for s in tree.body if isinstance(s, ast.Assign | ast.AnnAssign)]
    for node in ast.walk(tree):
        named = getattr(node, "annotation", None), getattr(node, "returns", None)
        parts += [*named, *getattr(node, "decorator_list", [])]
        reshapes = isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "reshape"
        if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr) or reshapes or getattr(node, "arg", "") == "strict":
            parts.append(node)
    return {id(inner) for part in parts if part is not None for inner in ast.walk(part)}


def changes(tree: ast.Module) -> Iterator[tuple[ast.AST, str, object]]:
    """(node, attribute, new value) of every possible change, always in the same order."""
    skip = left_out(tree)
    for node in (n for n in ast.walk(tree) if id(n) not in skip):
        if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
            yield node, "ops", [SWAPS[type(node.ops[0])](), *node.ops[1:]]
        elif isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign) and type(node.op) in SWAPS:
            yield node, "op", SWAPS[type(node.op)]()
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Invert | ast.USub):
            yield node, "op", ast.UAdd()
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            yield node, "operand", ast.UnaryOp(ast.Not(), node.operand)
        elif isinstance(node, ast.Constant) and type(node.value) is bool:
            yield node, "value", not node.value
        elif isinstance(node, ast.Constant) and type(node.value) is int:
            yield node, "value", node.value + 1
        for name in ("id", "attr"):
            if getattr(node, name, "") in NAMES:
                yield node, name, NAMES[getattr(node, name)]


def mutant(source: str, place: int) -> tuple[str, str]:
    """(changed source, what was changed) of one place: the expression, of a constant or a name that around it."""
    tree = ast.parse(source)
    node, attribute, value = list(changes(tree))[place]
    around = {id(inner): outer for outer in ast.walk(tree) for inner in ast.iter_child_nodes(outer)}
    shown = around[id(node)] if isinstance(node, ast.Constant | ast.Name) else node
    before = ast.unparse(shown)
    setattr(node, attribute, value)
    return ast.unparse(tree) + "\n", f"{before} -> {ast.unparse(shown)}"


def run(house: Path, tests: str, cache: Path, limit_s: float) -> str:
    """killed or survived, by the tests in the copy ``house``."""
    words = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    words += [f"tests/{test}" for test in tests.split()]
    paths = {"PYTHONPATH": str(house / "src"), "NUMBA_CACHE_DIR": str(cache), "PYTHONDONTWRITEBYTECODE": "1"}
    with contextlib.suppress(subprocess.TimeoutExpired, subprocess.CalledProcessError):
        subprocess.run(words, cwd=house, env={**os.environ, **paths}, capture_output=True, timeout=limit_s, check=True)
        return "survived"
    return "killed"


def try_module(house: Path, module: str, tests: str, share: int, seed: int, equal: set[tuple[str, str]]) -> float:
    """The share of a module's mutants that is killed; equal mutants do not count."""
    file = house / f"src/{module}.py" if module.startswith("mapvote_") else house / f"src/mapvote/{module}.py"
    common, cache = house / "cache", house / "cache-of-mutant"
    source, began = file.read_text(), time.monotonic()
    assert run(house, tests, common, 900.0) == "survived", f"{module}: its tests fail without any change"
    limit_s = 60.0 + 4.0 * (time.monotonic() - began)
    places = list(range(len(list(changes(ast.parse(source))))))
    outcomes = []
    for place in random.Random(f"{seed} {module}").sample(places, min(share, len(places))):
        text, change = mutant(source, place)
        shutil.rmtree(cache, ignore_errors=True)
        shutil.copytree(common, cache)
        file.write_text(text)
        outcome = run(house, tests, cache, limit_s)
        outcomes.append("equal" if outcome == "survived" and (f"{module}.py", change) in equal else outcome)
        file.write_text(source)
        print(module, change, outcomes[-1], sep="  ", flush=True)
    return outcomes.count("killed") / max(len(outcomes) - outcomes.count("equal"), 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=8, help="of each module")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=DECIDING, default=DECIDING, metavar="MODULE")
    asked = parser.parse_args()
    with (ROOT / "benchmarks/equal_mutants.csv").open() as lines:
        equal = {(row["module"], row["change"]) for row in csv.DictReader(lines)}
    with tempfile.TemporaryDirectory() as folder:
        house = Path(folder)
        for part in ("src", "tests", "pyproject.toml"):
            (shutil.copytree if (ROOT / part).is_dir() else shutil.copy2)(ROOT / part, house / part)
        own = {m: "/test_".join(m.removeprefix("mapvote_").rsplit("/", 1)) + ".py" for m in asked.only}
        tests = {m: f"{own[m] * (house / 'tests' / own[m]).exists()} {TESTS.get(m, '')}" for m in asked.only}
        killed = {m: try_module(house, m, tests[m], asked.mutants, asked.seed, equal) for m in asked.only}
    mean = sum(killed.values()) / len(killed)
    print("\n".join(f"| `{module}` | {share:.0%} |" for module, share in [*killed.items(), ("all", mean)]))
    sys.exit(mean < 0.9 or min(killed.values()) < 0.8)


if __name__ == "__main__":
    main()
