"""Tags of content that the client has already: If-None-Match (RFC 9110, 13.1.2)."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib import metadata

from fastapi import Request


def has_already(request: Request, tag: str) -> bool:
    """Whether the client holds the answer of this strong ``tag``, by a list of tags, or has any ("*")."""
    held = [one.strip().removeprefix("W/") for one in request.headers.get("if-none-match", "").split(",")]
    return tag in held or "*" in held


def tag_of(*parts: object) -> str:
    """The strong tag of an answer that follows from these alone, and from the program."""
    return f'"{hashlib.sha256(repr((_program(), *parts)).encode()).hexdigest()[:32]}"'


@cache
def _program() -> str:
    return metadata.version("mapvote")
