"""Answers of programs: dataclasses beside the functions that make them. The server's are the models that OpenAPI
declares."""

from __future__ import annotations

from typing import TypeVar

Answer = TypeVar("Answer", bound=type)
CLOSED = {"extra": "forbid", "use_attribute_docstrings": True, "defer_build": True}
"""Configuration for pydantic: OpenAPI declares that no other member comes, and takes the text below a member as its
description. It is read at the first use: reading the sources for it took .5 s of each command on a store."""


def answer(cls: Answer) -> Answer:
    """Declare a dataclass of an answer."""
    cls.__pydantic_config__ = CLOSED  # type: ignore[attr-defined]
    return cls
