"""Limits on the source tree: length of functions, arguments, names with two meanings, import circles.

docs/decisions/house.md gives the reasons. There is no lower limit and no median: small pieces are not a goal.
"""

from __future__ import annotations

import ast
import importlib
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).parents[1]
SRC = ROOT / "src"
SOURCES = sorted(SRC.rglob("*.py"))
COSTS = ROOT / "docs/measurements/kernels.md"
Function = ast.FunctionDef | ast.AsyncFunctionDef

KERNELS = {"kernel", "fast_math", "allocating", "disjoint", "inlined"}
"""Decorators of mapvote.core.kernel."""
MOST_KERNELS = 155
"""All of them, those inlined in others too: each costs a tenth of a second of `mapvote warmup`, or more."""
MOST_FUNCTION_LINES = 60
MOST_ARGUMENTS = 8
MOST_NAMED_TWICE = 10
"""Public functions and classes with two meanings."""
MOST_MODULE_NAMES = 875
"""Names bound at the top level of modules, without functions and classes."""
MOST_LOOSE_NUMBERS = 95
"""Numbers among them: those that kernels read, sizes of formats, bits and codes."""
MOST_LOOSE_CONSTANTS = 400
"""Constants at the top level of modules that are no part of a record; it may only fall."""
TYPE_MAKERS = {"TypeVar", "ParamSpec", "NewType"}
GENERICS = {
    "Annotated", "Callable", "Iterable", "Iterator", "Literal", "Mapping", "NDArray", "Optional", "Sequence", "Union",
    "dict", "frozenset", "list", "set", "tuple",
}  # fmt: skip
OBJECTS = {
    "getLogger", "get_logger", "Decoder", "Encoder", "Table", "MetaData", "Question", "APIRouter", "Typer",
    "ContextVar", "Lock", "local", "WeakKeyDictionary", "PerStore",
}  # fmt: skip
"""Objects that a module makes when it is loaded: loggers, decoders, tables of a database, prepared queries, routers,
state of a thread or a store. They are no constants."""
MOST_NAMES_WITH_SEVERAL_VALUES = 4
MOST_PACKED_SHARE = 0.01
"""Share of assignments that pack several statements into one line."""
MOST_ODD_SENTENCES = 8
"""Sentences of docstrings that begin with Of, What or As: their subject is missing or a clause."""
MADE_ELSEWHERE = {"ManifestAnswer", "PolicyChange"}
"""Answers that no function beside them makes: the manifest's model is derived from the codec's type, and the store
reads the changes of its policy."""
VAGUE_NAMES = {"asked", "found", "known", "mine", "now", "some", "told", "what", "where", "why"}
"""Names of locals and arguments that do not say what they hold, and that cannot be searched."""
MOST_VAGUE_NAMES = 46
"""It may only fall."""
BALLOT_TYPES = {"Ballot", "BallotTile", "Planes", "Vote", "Receipt"}
"""A ballot on the wire, its tile there, that tile's planes unpacked, the vote on a tile and why it counts, and the
answer to who sent it."""
OF_NO_BALLOT = {
    "CellVote",  # an answer of the API: a vote's text on one cell
    "CloudPlanes",  # of a cloud
    "Decision",  # of all votes
    "EditVotes",  # counts, cell by cell
    "SessionVote",  # a session, and the ballot made of it
}
"""Classes that have the name or the fields of a ballot's types, and are none."""
VOTED = {
    *("states", "tally", "gone", "new_points", "odds", "spoken", "unrestricted"),
    *("ballot", "digest", "end_ns", "first_seq", "cast_by", "base", "why", "spent", "reviewed", "alike"),
}
"""Fields by which a class repeats a ballot, where it has three."""
TESTS = sorted((ROOT / "tests").rglob("*.py"))


@cache
def parsed(source: Path) -> ast.Module:
    return ast.parse(source.read_text())


@cache
def nodes(source: Path) -> list[ast.AST]:
    return list(ast.walk(parsed(source)))


@cache
def functions(source: Path) -> list[Function]:
    return [node for node in nodes(source) if isinstance(node, Function)]


def arguments(function: Function) -> int:
    """How many a caller may give; self and cls are not given, ``*args`` and ``**kwargs`` count as one each."""
    said = function.args
    every = [*said.posonlyargs, *said.args, *said.kwonlyargs, *filter(None, (said.vararg, said.kwarg))]
    return len([argument for argument in every if argument.arg not in ("self", "cls")])


def is_kernel(function: Function) -> bool:
    """Compiled by numba: plain arrays go in, and what is handed on in a group costs more than it tells."""
    decorators = {ast.unparse(decorator) for decorator in function.decorator_list}
    return bool(decorators & KERNELS) or any("njit" in decorator for decorator in decorators)


def is_verb(function: Function) -> bool:
    """A verb of the command line: each argument is an option that ``--help`` explains, and only typer calls it."""
    return any("typer." in ast.unparse(a.annotation) for a in function.args.args if a.annotation is not None)


def crowded(function: Function) -> bool:
    return arguments(function) > MOST_ARGUMENTS and not is_kernel(function) and not is_verb(function)


def named(sources: list[Path]) -> Iterator[tuple[str, Path]]:
    """Functions and classes that others may import, and where each is defined."""
    for source in sources:
        for node in parsed(source).body:
            if isinstance(node, Function | ast.ClassDef) and not node.name.startswith("_"):
                yield node.name, source


def twice(names: Iterable[tuple[str, Path]]) -> dict[str, set[Path]]:
    """Names with two meanings, and where they are."""
    found: dict[str, set[Path]] = defaultdict(set)
    for name, source in names:
        found[name].add(source.relative_to(ROOT))
    return {name: places for name, places in found.items() if len(places) > 1}


def too_long(function: Function) -> bool:
    return function.end_lineno is not None and function.end_lineno - function.lineno >= MOST_FUNCTION_LINES


def imports(sources: list[Path], root: Path) -> dict[str, set[str]]:
    """Module -> modules of the same tree that it imports, anywhere in the file (lazy and typing-only imports too)."""
    modules = {".".join(s.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): s for s in sources}
    graph: dict[str, set[str]] = {}
    for name, source in modules.items():
        named: set[str] = set()
        for node in nodes(source):
            if isinstance(node, ast.Import):
                named.update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                full = [f"{node.module}.{alias.name}" for alias in node.names]
                named.update(f if f in modules else node.module for f in full)
        graph[name] = {n for n in named if n in modules and n != name}
    return graph


def circles(graph: dict[str, set[str]]) -> list[set[str]]:
    """Sets of modules that reach each other through imports (strongly connected components of two or more)."""

    def reach(start: str) -> set[str]:
        seen: set[str] = set()
        waiting = [start]
        while waiting:
            new = graph[waiting.pop()] - seen
            seen |= new
            waiting += new
        return seen

    reached = {name: reach(name) for name in graph}
    found: list[set[str]] = []
    for name in sorted(graph):
        if name in reached[name] and not any(name in circle for circle in found):
            found.append({other for other in reached[name] if name in reached[other]})
    return found


def test_every_function_but_kernels_verbs_and_migrations_has_at_most_60_lines() -> None:
    rooms = [s for s in SOURCES if "migrations" not in s.parts]
    every = [(s, f) for s in rooms for f in functions(s) if not (is_kernel(f) or is_verb(f))]
    assert {f"{s.relative_to(ROOT)}: {f.name}" for s, f in every if too_long(f)} == set()


def test_every_function_but_kernels_and_verbs_has_at_most_eight_arguments() -> None:
    asked = {f"{s.relative_to(ROOT)}: {f.name}": arguments(f) for s in SOURCES for f in functions(s) if crowded(f)}
    assert asked == {}


def test_kernels_are_few() -> None:
    found = [f"{s.relative_to(ROOT)}: {f.name}" for s in SOURCES for f in functions(s) if is_kernel(f)]
    assert len(found) <= MOST_KERNELS, found


def test_every_kernel_has_a_line_that_says_what_numpy_costs_in_its_place() -> None:
    """docs/measurements/kernels.md, a row for each file; benchmarks/kernels.py prints it."""
    rows = [line.split("|") for line in COSTS.read_text().splitlines() if line.startswith("| ") and ".py" in line]
    told = {(row[1].strip(), name) for row in rows for name in row[2].replace("`", "").split()}
    rooms = {s: "/".join(s.relative_to(SRC).parts[1:]) for s in SOURCES}
    assert told == {(room, f.name) for source, room in rooms.items() for f in functions(source) if is_kernel(f)}


def test_few_names_mean_two_things() -> None:
    """Verbs, routes and migrations apart: the command line and HTTP use the names of what they call."""
    apart = {s for s in SOURCES if {"cli", "migrations"} & set(s.parts)}
    rooms = [s for s in SOURCES if s not in apart and s.stem != "verbs" and not s.stem.endswith("routes")]
    assert len(twice(named(rooms))) <= MOST_NAMED_TWICE, twice(named(rooms))
    # Two modules of one name cannot be told apart in a traceback.
    assert twice((s.stem, s) for s in rooms if s.stem not in ("__init__", "__main__")) == {}


def test_no_module_gives_a_constant_two_values() -> None:
    """Two files that became one had a constant each of one name: the ground grew from other seeds, and no test saw."""
    for source in SOURCES:
        seen: dict[str, str] = {}
        for node in ast.parse(source.read_text()).body:
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                name, value = node.targets[0].id, ast.unparse(node.value)
                assert seen.setdefault(name, value) == value or name in value, f"{source.relative_to(ROOT)}: {name}"


def test_no_module_imports_itself_through_others() -> None:
    assert circles(imports(SOURCES, SRC)) == []


def test_crowded_functions_and_circular_imports_are_found() -> None:
    """The checks above can fail."""
    given = "(a, b, c, d, /, e, f, *, g, h, **i): ..."
    many, kernel = ast.parse(f"def f{given}\n@numba.njit(cache=True)\ndef k{given}\n").body
    assert isinstance(many, ast.FunctionDef)
    assert isinstance(kernel, ast.FunctionDef)
    assert arguments(many) == 9
    assert crowded(many)
    assert not crowded(kernel)
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == [{"b", "c"}]
    assert circles({"a": {"b"}, "b": set()}) == []


def test_benchmarks_import_names_that_are_there() -> None:
    """Nobody runs them all: a name that moved would be noticed months later."""
    ours, lost = (
        {"mapvote", "mapvote_server", "mapvote_lab", *(source.stem for source in (ROOT / "tests").glob("*.py"))},
        [],
    )
    for source in sorted((ROOT / "benchmarks").glob("*.py")):
        for node in nodes(source):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in ours:
                module = importlib.import_module(node.module)
                names = [alias.name for alias in node.names if not hasattr(module, alias.name)]
                lost += [f"{source.name}: {name}" for name in names if not find_spec(f"{node.module}.{name}")]
    assert lost == []


def test_decoders_of_types_are_made_when_a_module_is_loaded() -> None:
    """Two threads of a server that decoded their first ballots at once crashed it: msgspec (0.22) makes what it knows
    of a type at its first use, without a lock."""
    late = [
        f"{source.relative_to(ROOT)}:{call.lineno}"
        for source in SOURCES
        for call in nodes(source)
        if isinstance(call, ast.Call)
        and ast.unparse(call.func) in ("msgspec.msgpack.decode", "msgspec.json.decode")
        and any(keyword.arg == "type" for keyword in call.keywords)
    ]
    assert late == [], "make a Decoder of the type at the module's top level"


def answer_models(source: Path) -> set[str]:
    """Names of the models that the routes of a module declare for their answers."""
    found: set[str] = set()
    for function in functions(source):
        for decorator in function.decorator_list:
            if isinstance(decorator, ast.Call) and ast.unparse(decorator.func).startswith("router."):
                told = [keyword.value for keyword in decorator.keywords if keyword.arg == "response_model"]
                models = told or ([] if function.returns is None else [function.returns])
                parts = [node for model in models for node in ast.walk(model)]
                found |= {node.id for node in parts if isinstance(node, ast.Name)}
    return found - {"Response", "StreamingResponse"}


def made_in(tree: ast.Module) -> set[str]:
    """Classes that a module both defines and makes, itself or as the base of one that it makes."""
    called = {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    bases = {ast.unparse(base) for node in classes if node.name in called for base in node.bases}
    return {node.name for node in classes} & (called | bases)


def test_an_answer_is_told_once_as_the_dataclass_beside_the_function_that_makes_it() -> None:
    """A dict in the function and a model in api/schemas.py told the same members twice."""
    declared = {name for s in SOURCES if s.stem.endswith("routes") for name in answer_models(s)}
    made = {name for source in SOURCES for name in made_in(parsed(source))}
    assert len(declared) > 20
    assert declared - made == MADE_ELSEWHERE
    schemas = parsed(SRC / "mapvote_server/api/schemas.py")
    classes = [node.name for node in schemas.body if isinstance(node, ast.ClassDef)]
    assert [name for name in classes if not name.endswith("Ask")] == ["Answer"], "requests, and what is derived"


def test_an_answer_that_is_declared_in_one_module_and_made_in_another_is_found() -> None:
    """The check above can fail."""
    told = "class A: ...\nclass B(A): ...\nclass C: ...\ndef f():\n    return B(), D()\n"
    assert made_in(ast.parse(told)) == {"A", "B"}


def module_constants(source: Path) -> Iterator[tuple[str, ast.expr]]:
    """Names that a module binds at its top level, with their values; a packed assignment gives several."""
    for node in parsed(source).body:
        if isinstance(node, ast.Assign):
            for target in node.targets:
                yield from unpacked(target, node.value)
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            yield from unpacked(node.target, node.value)


def unpacked(target: ast.expr, value: ast.expr) -> Iterator[tuple[str, ast.expr]]:
    if isinstance(target, ast.Name):
        yield target.id, value
    elif isinstance(target, ast.Tuple):
        values = value.elts if isinstance(value, ast.Tuple) else [value] * len(target.elts)
        for name, one in zip(target.elts, values, strict=True):
            yield from unpacked(name, one)


def top_level(module: ast.Module) -> Iterator[tuple[ast.expr, ast.expr]]:
    """Target and value of every assignment at the top level of a module."""
    for node in module.body:
        if isinstance(node, ast.Assign):
            yield node.targets[0], node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            yield node.target, node.value


def last_name(called: ast.expr) -> str:
    return ast.unparse(called).rsplit(".", maxsplit=1)[-1]


def is_type(name: str, value: ast.expr) -> bool:
    """An alias of a type, or a type variable."""
    if isinstance(value, ast.Call):
        return last_name(value.func) in TYPE_MAKERS
    if isinstance(value, ast.Subscript):
        return last_name(value.value) in GENERICS
    is_union = isinstance(value, ast.BinOp) and isinstance(value.op, ast.BitOr)
    return (is_union or isinstance(value, ast.Name)) and re.fullmatch(r"_?[A-Z][a-z]\w*", name) is not None


def loose_constants(module: ast.Module) -> list[str]:
    """Statements that bind a constant: no type, no object, no default instance of a record, no name of its field."""
    records = {
        node.name
        for node in module.body
        if isinstance(node, ast.ClassDef) and any(ast.unparse(d).startswith("record(") for d in node.decorator_list)
    }
    instances: set[str] = set()
    loose = []
    for target, value in top_level(module):
        name = ast.unparse(target)
        called = last_name(value.func) if isinstance(value, ast.Call) else ""
        if called in records:
            instances.add(name)
        elif isinstance(value, ast.Attribute) and ast.unparse(value.value) in instances:
            continue  # a kernel takes no record: its name is bound to the field
        elif name != "__all__" and called not in OBJECTS and not is_type(name, value):
            loose.append(name)
    return loose


def is_number(value: ast.expr) -> bool:
    if isinstance(value, ast.BinOp):
        return is_number(value.left) and is_number(value.right)
    if isinstance(value, ast.UnaryOp):
        return is_number(value.operand)
    return isinstance(value, ast.Constant) and type(value.value) in (int, float)


def docstrings(source: Path) -> Iterator[str]:
    for node in nodes(source):
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef | ast.Module):
            yield " ".join((ast.get_docstring(node) or "").split())


def odd_sentences(text: str) -> list[str]:
    sentences = re.split(r"(?<=[.;:])\s+", text)
    return [s for s in sentences if len(s.split()) > 2 and s.startswith(("Of ", "What ", "As "))]


def vague_names(tree: ast.AST) -> Iterator[str]:
    """Each place where a function, a loop or a class binds a vague name."""
    for node in ast.walk(tree):
        is_bound = isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
        name = node.arg if isinstance(node, ast.arg) else ast.unparse(node) if is_bound else ""
        if name in VAGUE_NAMES:
            yield name


def is_of_a_ballot(node: ast.ClassDef) -> bool:
    """Whether a class tells a ballot, or a part of one: by its name, its base or its fields."""
    fields = {s.target.id for s in node.body if isinstance(s, ast.AnnAssign) and isinstance(s.target, ast.Name)}
    bases = {ast.unparse(base) for base in node.bases}
    named = re.search("(Ballot|BallotTile|Votes?|Planes|Receipt)$", node.name)
    return bool(named or bases & BALLOT_TYPES or len(fields & VOTED) >= 3)


def packs(node: ast.Assign) -> bool:
    return isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)


def patches_a_constant(call: ast.Call) -> bool:
    return ast.unparse(call.func).endswith("monkeypatch.setattr") and any(
        isinstance(argument, ast.Constant) and re.fullmatch(r"(.*\.)?_?[A-Z][A-Z0-9_]+", str(argument.value))
        for argument in call.args
    )


def test_numbers_lie_in_records() -> None:
    constants = [constant for source in SOURCES for constant in module_constants(source)]
    assert len(constants) <= MOST_MODULE_NAMES
    assert sum(is_number(value) for _, value in constants) <= MOST_LOOSE_NUMBERS


def test_few_constants_are_loose() -> None:
    loose = {str(source.relative_to(SRC)): loose_constants(parsed(source)) for source in SOURCES}
    assert sum(map(len, loose.values())) <= MOST_LOOSE_CONSTANTS, {
        room: names for room, names in loose.items() if names
    }


def test_records_types_and_objects_are_no_loose_constants() -> None:
    """The check above can fail."""
    told = """
@record(votes=True)
class Rule: side_m: float = 2.0
RULE = Rule()
SIDE_M = RULE.side_m
Box = tuple[float, float]
Word = str | int
log = logging.getLogger("a")
_ROWS = {1: "a"}
_NAME = re.compile("a")
_A, _B = 1, 2
MASK = 1 | 2
OTHER_M = OTHER.side_m
"""
    assert loose_constants(ast.parse(told)) == ["_ROWS", "_NAME", "(_A, _B)", "MASK", "OTHER_M"]


def test_a_ballot_has_five_types() -> None:
    """On the vehicle, on the wire and in the server; the laboratory measures, and has its own."""
    product = [source for source in SOURCES if "mapvote_lab" not in source.parts]
    classes = [node for source in product for node in nodes(source) if isinstance(node, ast.ClassDef)]
    assert {node.name for node in classes if is_of_a_ballot(node)} == BALLOT_TYPES | OF_NO_BALLOT
    more = "class A:\n  why: str\n  spent: str\n  alike: int\nclass B(Planes): ...\nclass AVote: ...\nclass C: ..."
    assert [is_of_a_ballot(node) for node in ast.parse(more).body if isinstance(node, ast.ClassDef)] == [
        *[True] * 3,
        False,
    ]


def test_names_say_what_they_hold() -> None:
    vague = {str(source.relative_to(SRC)): list(vague_names(parsed(source))) for source in SOURCES}
    assert sum(map(len, vague.values())) <= MOST_VAGUE_NAMES, {room: names for room, names in vague.items() if names}
    example = ast.parse("def f(where, source):\n  for found in where: mine = found.what")
    assert list(vague_names(example)) == ["where", "found", "mine"]


def test_few_names_have_several_values() -> None:
    values: dict[str, set[str]] = defaultdict(set)
    for source in SOURCES:
        for name, value in module_constants(source):
            if isinstance(value, ast.Constant):
                values[name].add(repr(value.value))
    several = {name for name, given in values.items() if len(given) > 1}
    assert len(several) <= MOST_NAMES_WITH_SEVERAL_VALUES, several


def test_tests_hand_numbers_in_and_patch_no_constant() -> None:
    patched = [
        f"{test.relative_to(ROOT)}:{call.lineno}"
        for test in TESTS
        for call in nodes(test)
        if isinstance(call, ast.Call) and patches_a_constant(call)
    ]
    assert patched == []


def test_a_line_holds_one_assignment() -> None:
    assigned = [n for s in SOURCES for n in nodes(s) if isinstance(n, ast.Assign)]
    assert sum(map(packs, assigned)) <= MOST_PACKED_SHARE * len(assigned)


def test_sentences_begin_with_their_subject() -> None:
    odd = [sentence for source in SOURCES for text in docstrings(source) for sentence in odd_sentences(text)]
    assert len(odd) <= MOST_ODD_SENTENCES, odd


def test_odd_sentences_and_patched_constants_are_recognised() -> None:
    """The checks above can fail."""
    assert odd_sentences("One ballot. Of two the newest counts: what is old goes. As before it stays.") == [
        "Of two the newest counts:",
        "As before it stays.",
    ]
    assert packs(ast.parse("a, b = 1, 2").body[0])  # type: ignore[arg-type]
    for text, is_patch in (
        ("setattr(m, '_LIMIT', 1)", True),
        ("setattr('a.b.LIMIT', 1)", True),
        ("setattr(m, 'f', 1)", False),
    ):
        (statement,) = ast.parse(f"monkeypatch.{text}").body
        assert isinstance(statement, ast.Expr)
        assert isinstance(statement.value, ast.Call)
        assert patches_a_constant(statement.value) == is_patch
    (constant,) = ast.parse("a, b = 2 * 3, 'text'").body
    assert isinstance(constant, ast.Assign)
    assert [is_number(value) for _, value in unpacked(constant.targets[0], constant.value)] == [True, False]
