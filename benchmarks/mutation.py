"""Do the tests notice a changed operator? Random one-operator mutants of the modules that decide.

    python benchmarks/mutation.py [--mutants 200] [--seed 1] [--only fusion/fuse.py] [--out results/mutants.csv]

Each mutant is one comparison, arithmetic, logical or bit operator, constant or negation of one module changed; it is
killed if a test of those that name the module fails.
"""

from __future__ import annotations

import argparse
import ast
import csv
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).parent.parent
TESTS = {
    "core/voting.py": ["core/test_voting.py", "core/test_voting_model.py", "fusion/test_fuse.py"],
    "fusion/fuse.py": ["fusion/test_fuse.py", "fusion/test_outliers.py"],
    "fusion/tile_vote.py": ["fusion/test_tile_vote.py", "fusion/test_fuse.py"],
    "fusion/edit.py": ["fusion/test_edit.py", "fusion/test_fuse.py"],
    "fusion/outliers.py": ["fusion/test_outliers.py"],
    "server/store/eligible_votes.py": ["server/store"],
    "detection/paper.py": ["detection/test_paper.py", "detection/test_voters.py"],
    "detection/columns.py": ["detection/test_columns.py", "detection/test_voters.py"],
    "detection/regions.py": ["detection"],
    "perception/raycast.py": ["perception/test_raycast.py"],
    "localisation/tracker.py": ["localisation"],
    "evaluation/scoring/cells.py": ["evaluation/scoring"],
    "evaluation/scoring/objects.py": ["evaluation/scoring"],
}
SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Add, ast.And: ast.Or, ast.Or: ast.And,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """One change of one module."""

    module: str
    line: int
    what: str
    text: str


def mutants_of(module: str) -> list[Mutant]:
    """Every one-operator mutant of a module."""
    source = (ROOT / "src/mapvote" / module).read_text()
    return [Mutant(module, line, what, ast.unparse(tree)) for line, what, tree in _changed(source)]


def _changed(source: str) -> Iterator[tuple[int, str, ast.Module]]:
    for i in range(len(_sites(ast.parse(source)))):
        tree = ast.parse(source)
        node, field, at = _sites(tree)[i]
        line = next(getattr(n, "lineno", 0) for n in (node, field) if hasattr(n, "lineno"))
        yield line, _mutate(node, at), tree


def _sites(tree: ast.Module) -> list[tuple[ast.AST, ast.AST, int]]:
    """(node, where it stands, which of its operators) of all that can change; annotations and docstrings cannot."""
    left_out: set[int] = set()
    for node in ast.walk(tree):
        for name in ("annotation", "returns"):
            if getattr(node, name, None) is not None:
                left_out |= {id(n) for n in ast.walk(getattr(node, name))}
        for decorator in getattr(node, "decorator_list", []):
            left_out |= {id(n) for n in ast.walk(decorator)}
    found: list[tuple[ast.AST, ast.AST, int]] = []
    for node in ast.walk(tree):
        if id(node) in left_out:
            continue
        if isinstance(node, ast.Compare):
            found += [(node, node, k) for k, op in enumerate(node.ops) if type(op) in SWAPS]
        elif (
            (isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign) and type(node.op) in SWAPS)
            or (isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.Invert))
            or (isinstance(node, ast.Constant) and type(node.value) in (int, bool) and hasattr(node, "lineno"))
        ):
            found.append((node, node, 0))
    return found


def _mutate(node: ast.AST, at: int) -> str:
    """Change a node in place; says how."""
    before = ast.unparse(node)
    if isinstance(node, ast.Compare):
        node.ops[at] = SWAPS[type(node.ops[at])]()  # type: ignore[assignment]
    elif isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign):
        node.op = SWAPS[type(node.op)]()  # type: ignore[assignment]
    elif isinstance(node, ast.UnaryOp):
        node.op = ast.UAdd()
    elif isinstance(node, ast.Constant):
        node.value = (not node.value) if isinstance(node.value, bool) else node.value + 1  # type: ignore[operator]
    return f"{before} -> {ast.unparse(node)}"


def killed(mutant: Mutant, house: Path) -> bool:
    """Whether the module's tests fail on it, in a copy of the house."""
    file = house / "src/mapvote" / mutant.module
    original = file.read_text()
    # numba does not see that a kernel called from another module has changed.
    for cache in (house / "src").rglob("*.nb[ic]"):
        if cache.parent.parent == file.parent or _imports(cache.parent.parent, mutant.module):
            cache.unlink()
    file.write_text(mutant.text)
    tests = [f"tests/{t}" for t in TESTS[mutant.module] if (house / "tests" / t).exists()]
    environment = {**os.environ, "PYTHONPATH": str(house / "src"), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(command, cwd=house, env=environment, capture_output=True, timeout=300)
        return done.returncode != 0
    except subprocess.TimeoutExpired:
        return True
    finally:
        file.write_text(original)


def _imports(folder: Path, module: str) -> bool:
    name = "mapvote." + module.removesuffix(".py").replace("/", ".")
    return any(name in file.read_text() for file in folder.glob("*.py"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="one module, e.g. fusion/fuse.py")
    parser.add_argument("--out", type=Path, default=Path("results/mutants.csv"))
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    modules = [arguments.only] if arguments.only else list(TESTS)
    share = -(-arguments.mutants // len(modules))
    every = {module: mutants_of(module) for module in modules}
    chosen = [mutant for some in every.values() for mutant in chance.sample(some, min(share, len(some)))]
    rows, score = [], {module: [0, 0] for module in modules}
    with tempfile.TemporaryDirectory() as folder:
        house = Path(folder)
        for part in ("src", "tests", "pyproject.toml"):
            (shutil.copytree if (ROOT / part).is_dir() else shutil.copy)(ROOT / part, house / part)
        for mutant in chosen:
            dead = killed(mutant, house)
            score[mutant.module][0] += dead
            score[mutant.module][1] += 1
            rows.append([mutant.module, mutant.line, mutant.what, "killed" if dead else "survived"])
            print(*rows[-1], sep="  ", flush=True)
            arguments.out.parent.mkdir(parents=True, exist_ok=True)
            with arguments.out.open("w", newline="") as file:
                csv.writer(file).writerows([["module", "line", "change", "outcome"], *rows])
    table = Table("module", "killed", "of")
    for module, (dead, of) in score.items():
        table.add_row(module, str(dead), str(of))
    table.add_row("all", str(sum(d for d, _ in score.values())), str(len(chosen)))
    Console().print(table)


if __name__ == "__main__":
    main()
