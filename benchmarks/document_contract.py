"""Write the contract of the API: docs/openapi.json, and the examples in it, which are recorded from a server.

    python benchmarks/document_contract.py

It refuses while CHANGELOG.md does not name an operation of /v1 that changed.
"""

from __future__ import annotations

import json
import logging
import re
import sys
import tempfile
from contextlib import closing
from pathlib import Path
from typing import Any

import structlog
from fastapi.testclient import TestClient

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from asked import POLICY, answered, lived_in
from contract import CHANGELOG, STORED, changed, stored, unnamed
from hand_made import two_walls
from mapvote_server.api import openapi
from mapvote_server.api.app import create_app
from mapvote_server.store.store import Store

EXAMPLES = Path(openapi.__file__).with_name("examples.json")


def main() -> int:
    """Record, then write; exit code 1 for a change that the changelog does not name."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    with tempfile.TemporaryDirectory() as folder:
        with closing(Store.create(f"sqlite:///{folder}/a.db", two_walls(), POLICY)) as store:
            EXAMPLES.write_text(json.dumps(recorded(lived_in(store)), indent=1, sort_keys=True) + "\n")
        openapi.examples.cache_clear()
        with closing(Store.create(f"sqlite:///{folder}/b.db", two_walls(), POLICY)) as store:
            document = create_app(store).openapi()
    lacking = unnamed(changed(stored(), document), CHANGELOG.read_text()) if STORED.exists() else []
    if lacking:
        print(f"CHANGELOG.md does not name {', '.join(f'`{name}`' for name in lacking)}: say what changed there first")
        return 1
    STORED.write_text(json.dumps(document, indent=1, sort_keys=True) + "\n")
    return 0


def recorded(store: Store) -> dict[str, Any]:
    """Parameters, requests and answers of one operation after the other."""
    hashes = store.tiles()[0, 0]
    app = create_app(store, opened=True)
    names = {
        (method.upper(), path): operation["operationId"]
        for path, operations in app.openapi()["paths"].items()
        for method, operation in operations.items()
    }
    requests: dict[str, Any] = {}
    answers: dict[str, Any] = {}
    with TestClient(app, base_url="http://localhost") as client:
        for method, path, _, body, answer in answered(client, store):
            name = names[method, path]
            if body is not None:
                requests[name] = body
            content = answer.json()
            if "key" in content:
                content["key"] = "shown this once"
            answers.setdefault(name, shortened(content))
    parameters = {"vehicle": "a", "drive": "d1", "number": 1, "same": 1, "since": 1, "from": 1, "to": 2, "version": 1}
    places = {"x": 3.15, "y": 3.15, "row": 0, "col": 0, "bbox": "0,0,76.8,76.8"}
    planes = {"digest": hashes.points, "points": hashes.points, "ground": hashes.ground, "level": 0}
    lists = {"limit": 100, "offset": 0, "events": 10, "everybody": True, "seq": 7}
    return {"parameters": parameters | places | planes | lists, "requests": requests, "answers": answers}


def shortened(value: Any) -> Any:
    """An answer with one member of each list and one tile."""
    if isinstance(value, dict):
        tiles = [name for name in value if re.fullmatch(r"-?\d+,-?\d+", name)]
        return {
            name: member if name == "coordinates" else shortened(member)
            for name, member in value.items()
            if name not in tiles[1:]
        }
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return [shortened(value[0])]
    return value


if __name__ == "__main__":
    sys.exit(main())
