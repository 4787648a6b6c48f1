"""The content codings that a client takes."""

from __future__ import annotations

from starlette.requests import Request


def takes_zstd(request: Request) -> bool:
    """Whether Accept-Encoding names zstd with a weight above 0 (RFC 9110, 12.5.3)."""
    for header in request.headers.getlist("accept-encoding"):
        for entry in header.lower().split(","):
            coding, _, weight = entry.partition(";")
            if coding.strip() == "zstd":
                return _weight(weight) > 0.0
    return False


def _weight(parameter: str) -> float:
    """The q of a coding: 1 where none is stated, 0 for what is no number."""
    name, _, value = parameter.partition("=")
    if name.strip() != "q":
        return 1.0
    try:
        return float(value)
    except ValueError:
        return 0.0
