"""Numba's caches and changed modules: a kernel is kept by its own file, and not asked anew when one that it calls has
changed."""

from __future__ import annotations

import ast
import os
from pathlib import Path


def link_others(common: Path, own: Path, sources: Path, changed: str) -> None:
    """Fill ``own`` with the kernels of ``common`` that do not depend on the module ``changed`` of ``sources``."""
    stale = {(module.parent.name, module.stem) for module in dependents(sources, changed)}
    for file in common.rglob("*.nb[ic]"):
        folder, module = file.parent.name.rsplit("_", 1)[0], file.name.split(".")[0]
        if (folder, module) not in stale:
            (own / file.parent.name).mkdir(parents=True, exist_ok=True)
            os.link(file, own / file.parent.name / file.name)


def dependents(sources: Path, changed: str) -> set[Path]:
    """The module and all that import it, or one of those."""
    imports = {file: _imported(file) for file in sources.rglob("*.py")}
    found = {sources / changed}
    while True:
        names = {_name(sources, file) for file in found}
        more = {file for file, imported in imports.items() if imported & names} - found
        if not more:
            return found
        found |= more


def _name(sources: Path, file: Path) -> str:
    return ".".join([sources.name, *file.relative_to(sources).with_suffix("").parts])


def _imported(file: Path) -> set[str]:
    out = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            out |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
        elif isinstance(node, ast.Import):
            out |= {name.name for name in node.names}
    return out
