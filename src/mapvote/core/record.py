"""Records of an algorithm's numbers: one frozen record per algorithm, declared beside it and handed in as an argument.

    @record(votes=True)
    @dataclass(frozen=True, slots=True)
    class Movers:
        past_s: float = 2.0
        '''Scans older than this before a scan are not used.'''

    MOVERS = Movers()

A test hands in another record. ``mapvote config --all`` prints every field with its sentence. The records that vehicles
vote by are part of the digest of settings, so programs with other numbers never share a round.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

Record = TypeVar("Record", bound=type)
_declared: dict[str, tuple[type, bool]] = {}


@dataclass(frozen=True, slots=True)
class RecordField:
    """One field of a record."""

    record: type
    """The record."""
    field: str
    """The field's own name."""
    value: Any
    """Its default."""

    @property
    def name(self) -> str:
        """``Record.field``."""
        return f"{self.record.__name__}.{self.field}"

    @property
    def meaning(self) -> str:
        """Its sentence, for which the source of the record is parsed: a digest of all records does without."""
        return _sentences(self.record).get(self.field, "")


def record(*, votes: bool = False) -> Callable[[Record], Record]:
    """Declare a class of numbers, every field of which has a default. ``votes``: vehicles vote by it."""

    def declare(cls: Record) -> Record:
        _declared[f"{cls.__module__}.{cls.__name__}"] = cls, votes
        return cls

    return declare


def numbers(
    *,
    votes: bool = False,
    packages: tuple[str, ...] = ("mapvote", "mapvote_server"),
    missing: dict[str, ModuleNotFoundError] | None = None,
) -> list[RecordField]:
    """Every field of every record of ``packages`` ("mapvote_lab" is the laboratory's, which needs its extra).

    ``votes``: only of those that vehicles vote by. ``missing`` gets the modules that need a package which is not
    installed; without it such a module is an error.
    """
    for module in modules_with_records(packages, votes=votes):
        try:
            import_module(module)
        except ModuleNotFoundError as error:
            if missing is None:
                raise
            missing[module] = error
    chosen = [
        cls
        for name, (cls, of_votes) in sorted(_declared.items())
        if name.partition(".")[0] in packages and (of_votes or not votes)
    ]
    return [number for cls in chosen for number in _fields_of(cls)]


@cache
def modules_with_records(packages: tuple[str, ...], *, votes: bool = False) -> list[str]:
    """The modules whose source declares a record: no other is imported to find them."""
    mark = b"\n@record(votes=True)" if votes else b"\n@record("
    names = []
    for package in packages:
        spec = find_spec(package)
        for folder in [] if spec is None else spec.submodule_search_locations or []:
            sources = sorted(Path(folder).rglob("*.py"))
            names += [_module_name(package, Path(folder), source) for source in sources if mark in source.read_bytes()]
    return names


def _module_name(package: str, folder: Path, source: Path) -> str:
    return ".".join([package, *source.relative_to(folder).with_suffix("").parts])


@cache
def method_version() -> str:
    """Hash of the numbers that vehicles vote by, 16 hexadecimal digits."""
    return digest_of_numbers(numbers(votes=True))


def digest_of_numbers(listed: Iterable[RecordField]) -> str:
    """SHA-256 of names and values, 16 hexadecimal digits; the sentences have no part in it."""
    text = "\n".join(f"{number.name} = {number.value!r}" for number in listed)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def numbers_table(names: Iterable[str]) -> str:
    """A Markdown table of the records ``names``: number, value, meaning."""
    wanted = set(names)
    rows = [number for number in numbers() if number.name.partition(".")[0] in wanted]
    lines = [f"| `{number.name}` | {number.value} | {number.meaning} |" for number in rows]
    return "\n".join(["| Number | Value | Meaning |", "|---|---|---|", *lines])


def _fields_of(cls: type) -> Iterator[RecordField]:
    default = cls()
    for field in fields(cls):
        yield RecordField(cls, field.name, getattr(default, field.name))


@cache
def _sentences(cls: type) -> dict[str, str]:
    """The text below each field of a class."""
    (body,) = ast.parse(inspect.getsource(cls)).body
    assert isinstance(body, ast.ClassDef)
    meanings = {}
    for statement, after in zip(body.body, body.body[1:], strict=False):
        has_text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name) and has_text:
            meanings[statement.target.id] = " ".join(str(after.value.value).split())  # type: ignore[attr-defined]
    return meanings
