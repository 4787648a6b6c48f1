"""The contract of /v1: the OpenAPI document without its prose, operation by operation, and the copy that is kept."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
STORED = ROOT / "docs/openapi.json"
CHANGELOG = ROOT / "CHANGELOG.md"
UPDATE = "python benchmarks/document_contract.py"
PROSE = {"description", "summary", "title", "example"}


def operations_of(document: Mapping[str, Any]) -> dict[str, Any]:
    """What a client relies on, by "METHOD /path": the operation and every schema that it reaches, without prose."""
    found = {}
    for path, operations in document["paths"].items():
        if path.startswith("/v1/"):
            for method, operation in operations.items():
                schemas: dict[str, Any] = {}
                _reach(operation, document, schemas)
                found[f"{method.upper()} {path}"] = {"operation": _bare(operation), "schemas": schemas}
    return found


def _reach(node: Any, document: Mapping[str, Any], schemas: dict[str, Any]) -> None:
    if isinstance(node, dict):
        name = str(node.get("$ref", "")).rpartition("/")[2]
        if name and name not in schemas:
            schemas[name] = _bare(document["components"]["schemas"][name])
            _reach(document["components"]["schemas"][name], document, schemas)
        for value in node.values():
            _reach(value, document, schemas)
    elif isinstance(node, list):
        for value in node:
            _reach(value, document, schemas)


def _bare(node: Any) -> Any:
    if isinstance(node, dict):
        kept = {k: v for k, v in node.items() if k != "example" and not (k in PROSE and isinstance(v, str))}
        return {name: _bare(value) for name, value in kept.items()}
    return [_bare(value) for value in node] if isinstance(node, list) else node


def changed(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """The operations that came, went or differ between two documents."""
    before, after = operations_of(old), operations_of(new)
    return sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))


def unnamed(operations: list[str], changelog: str) -> list[str]:
    """Those that the changelog's newest section does not name as `METHOD /path`."""
    newest = re.split(r"^## ", changelog, flags=re.MULTILINE)[1]
    return [name for name in operations if f"`{name}`" not in newest]


def stored() -> dict[str, Any]:
    """The copy that is kept."""
    found: dict[str, Any] = json.loads(STORED.read_text())
    return found
