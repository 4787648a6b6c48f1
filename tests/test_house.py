"""The house stays one that a stranger can live in: files and functions that one can see whole, few arguments, one
meaning a name. Numbers are those of docs/decisions/house.md."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from statistics import median

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "src/mapvote").rglob("*.py"))
Function = ast.FunctionDef | ast.AsyncFunctionDef

MOST_NAMED_TWICE = 35
"""Names that mean two things; the fewer the better."""


def lines(source: Path) -> int:
    return len(source.read_text().splitlines())


def functions(source: Path) -> Iterator[Function]:
    for node in ast.walk(ast.parse(source.read_text())):
        if isinstance(node, Function):
            yield node


def arguments(function: Function) -> int:
    """How many a caller may give; self and cls are not given, ``*args`` and ``**kwargs`` count as one each."""
    said = function.args
    every = [*said.posonlyargs, *said.args, *said.kwonlyargs, *filter(None, (said.vararg, said.kwarg))]
    return len([argument for argument in every if argument.arg not in ("self", "cls")])


def is_kernel(function: Function) -> bool:
    """Compiled by numba: plain arrays go in, and what is handed on in a group costs more than it tells."""
    return any("njit" in ast.unparse(decorator) for decorator in function.decorator_list)


def is_verb(function: Function) -> bool:
    """A verb of the command line: each argument is an option that ``--help`` explains, and only typer calls it."""
    return any("typer." in ast.unparse(a.annotation) for a in function.args.args if a.annotation is not None)


def crowded(function: Function) -> bool:
    return arguments(function) > 8 and not is_kernel(function) and not is_verb(function)


def public_names(sources: list[Path]) -> dict[str, set[str]]:
    """Functions and classes that others may import, and where each is defined."""
    found: dict[str, set[str]] = defaultdict(set)
    for source in sources:
        for node in ast.parse(source.read_text()).body:
            if isinstance(node, Function | ast.ClassDef) and not node.name.startswith("_"):
                found[node.name].add(str(source.relative_to(ROOT)))
    return found


def test_every_file_can_be_read_in_one_go() -> None:
    assert {str(source.relative_to(ROOT)): lines(source) for source in SOURCES if lines(source) > 280} == {}
    assert median(lines(source) for source in SOURCES) <= 110


def test_functions_are_short() -> None:
    lengths = [f.end_lineno - f.lineno + 1 for source in SOURCES for f in functions(source) if f.end_lineno]
    assert median(lengths) <= 8


def test_nobody_is_asked_for_more_than_eight_arguments() -> None:
    asked = {f"{s.relative_to(ROOT)}: {f.name}": arguments(f) for s in SOURCES for f in functions(s) if crowded(f)}
    assert asked == {}


def test_hardly_any_public_name_means_two_things() -> None:
    """Verbs, routes and migrations apart: the command line and HTTP say the same words as what they call."""
    rooms = [s for s in SOURCES if not ({"cli", "migrations"} & set(s.parts) or s.stem.endswith("routes"))]
    twice = {name: places for name, places in public_names(rooms).items() if len(places) > 1}
    assert len(twice) <= MOST_NAMED_TWICE, twice


def test_what_is_too_long_or_too_crowded_is_found() -> None:
    """The checks above can fail."""
    given = "(a, b, c, d, /, e, f, *, g, h, **i): ..."
    many, kernel = ast.parse(f"def f{given}\n@numba.njit(cache=True)\ndef k{given}\n").body
    assert isinstance(many, ast.FunctionDef)
    assert isinstance(kernel, ast.FunctionDef)
    assert arguments(many) == 9
    assert crowded(many)
    assert not crowded(kernel)
