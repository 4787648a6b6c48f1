"""One-operator mutants of a Python source: what can change, and how."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass

SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Add, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.And: ast.Or, ast.Or: ast.And,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
}  # fmt: skip
_NAMES = {"min": "max", "max": "min", "any": "all", "all": "any"}
_OPERATED = ast.BinOp | ast.BoolOp | ast.AugAssign


@dataclass(frozen=True)
class Mutant:
    """One change of one module."""

    module: str
    place: int
    """Which of the module's sites, in the order of the source."""
    line: int
    change: str
    text: str
    """The whole module, changed."""


def mutants_of(module: str, source: str) -> Iterator[Mutant]:
    """Every mutant of a module, in the order of the source: an operator, a small constant or a negation changed, min
    for max, any for all.

    Left as they are: annotations, decorators, docstrings, what is raised or asserted or put into text, ``strict`` of
    ``zip`` (an assertion too), and constants of the module, which are settings: measurements set them.
    """
    for place in range(len(_sites(ast.parse(source)))):
        tree = ast.parse(source)
        node, operator = _sites(tree)[place]
        line = node.lineno  # type: ignore[attr-defined]
        if isinstance(node, ast.UnaryOp) and not isinstance(node.op, ast.USub):
            change, tree = f"{ast.unparse(node)} -> {ast.unparse(node.operand)}", _Without(node).visit(tree)
        else:
            change = _mutate(tree, node, operator)
        yield Mutant(module, place, line, change, ast.unparse(tree) + "\n")


def _left_out(tree: ast.Module) -> set[int]:
    out: set[int] = set()
    for node in ast.walk(tree):
        parts: list[ast.AST | None] = [getattr(node, "annotation", None), getattr(node, "returns", None)]
        parts += getattr(node, "decorator_list", [])
        if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr):
            parts.append(node)
        if isinstance(node, ast.keyword) and node.arg == "strict":
            parts.append(node)
        out |= {id(inner) for part in parts if part is not None for inner in ast.walk(part)}
    for statement in tree.body:
        if isinstance(statement, ast.Assign | ast.AnnAssign) and not isinstance(statement.value, ast.Call):
            out |= {id(inner) for inner in ast.walk(statement)}
    return out


def _sites(tree: ast.Module) -> list[tuple[ast.AST, int]]:
    """(node, which of its operators) of all that can change, in the order of the source."""
    left_out = _left_out(tree)
    found: list[tuple[ast.AST, int]] = []
    for node in ast.walk(tree):
        if id(node) in left_out:
            continue
        if isinstance(node, ast.Compare):
            found += [(node, k) for k, operator in enumerate(node.ops) if type(operator) in SWAPS]
        elif (
            (isinstance(node, _OPERATED) and type(node.op) in SWAPS)
            or (isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.Invert | ast.USub))
            or (isinstance(node, ast.Constant) and type(node.value) in (int, bool))
            or (isinstance(node, ast.Call) and _called(node) in _NAMES)
        ):
            found.append((node, 0))
    return sorted(found, key=lambda site: (site[0].lineno, site[0].col_offset, site[1]))  # type: ignore[attr-defined]


def _called(call: ast.Call) -> str:
    return call.func.id if isinstance(call.func, ast.Name) else getattr(call.func, "attr", "")


class _Without(ast.NodeTransformer):
    """Puts the operand where its negation stood."""

    def __init__(self, negation: ast.UnaryOp) -> None:
        self.negation = negation

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.AST:
        return node.operand if node is self.negation else self.generic_visit(node)


def _mutate(tree: ast.Module, node: ast.AST, operator: int) -> str:
    """Change a node in place; says how. A constant by itself says little: what it stands in is told."""
    told = node
    if isinstance(node, ast.Constant):
        told = next(n for n in ast.walk(tree) if any(child is node for child in ast.iter_child_nodes(n)))
    before = ast.unparse(told)
    if isinstance(node, ast.Compare):
        node.ops[operator] = SWAPS[type(node.ops[operator])]()  # type: ignore[assignment]
    elif isinstance(node, _OPERATED):
        node.op = SWAPS[type(node.op)]()  # type: ignore[assignment]
    elif isinstance(node, ast.UnaryOp):
        node.op = ast.UAdd()  # a minus
    elif isinstance(node, ast.Constant):
        node.value = (not node.value) if isinstance(node.value, bool) else node.value + 1  # type: ignore[operator]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        node.func.id = _NAMES[node.func.id]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        node.func.attr = _NAMES[node.func.attr]
    return f"{before} -> {ast.unparse(told)}"
