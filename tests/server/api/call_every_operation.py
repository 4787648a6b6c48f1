"""Run by the Python that has the generator's libraries, not ours: call each operation by the client generated from
the OpenAPI document.

    python call_every_operation.py CLIENT URL KEY < calls.json > answers.json

A call is [group, operation, arguments, body]; an answer [status, type of what was parsed].
"""

from __future__ import annotations

import base64
import importlib
import inspect
import io
import json
import sys
from typing import Any


def main(client: str, url: str, key: str) -> None:
    """Call one operation after the other."""
    sys.path.insert(0, client)
    ours = importlib.import_module("mapvote_client")
    http = importlib.import_module("httpx")
    told: list[Any] = []
    server = ours.AuthenticatedClient(base_url=url, token=key, timeout=http.Timeout(20.0))
    for group, operation, arguments, body in json.load(sys.stdin):
        module = importlib.import_module(f"mapvote_client.api.{group}.{operation}")
        given = inspect.signature(module.sync_detailed).parameters
        more = {name if name in given else f"{name}_": value for name, value in arguments.items()}
        if isinstance(body, str):
            sent = base64.b64decode(body)
            file = importlib.import_module("mapvote_client.types").File
            more["body"] = file(io.BytesIO(sent)) if given["body"].annotation is file else sent.decode()
        elif body is not None:
            more["body"] = vars(module)[_name_of(given["body"].annotation)].from_dict(body)
        asks = server
        if operation == "listen":  # it never ends
            asks = ours.AuthenticatedClient(base_url=url, token=key, timeout=http.Timeout(20.0, read=1.0))
        try:
            answer = module.sync_detailed(client=asks, **more)
            told.append([operation, int(answer.status_code), type(answer.parsed).__name__])
        except http.ReadTimeout:
            told.append([operation, 200, "ReadTimeout"])
    json.dump(told, sys.stdout)


def _name_of(annotation: Any) -> str:
    return str(getattr(annotation, "__name__", annotation))


if __name__ == "__main__":
    main(*sys.argv[1:])
