"""Answers of programs: dataclasses beside the functions that make them. The server's are the models that OpenAPI
declares."""

from __future__ import annotations

from typing import TypeVar

Answer = TypeVar("Answer", bound=type)
CLOSED = {"extra": "forbid", "use_attribute_docstrings": True}
"""Configuration for pydantic: OpenAPI declares that no other member comes, and takes the text below a member as its
description."""


def answer(cls: Answer) -> Answer:
    """Declare a dataclass of an answer."""
    cls.__pydantic_config__ = CLOSED  # type: ignore[attr-defined]
    return cls
