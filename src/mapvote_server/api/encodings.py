"""Preferences of a client: content codings and media types with their weights (RFC 9110, 12.5)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from starlette.requests import Request


def takes(request: Request, coding: str) -> bool:
    """Whether Accept-Encoding names a coding, such as zstd, with a weight above 0."""
    weights = {name: weight for name, weight in _entries(request, "accept-encoding") if name == coding}
    return weights.get(coding, 0.0) > 0.0


def prefers_html(request: Request) -> bool:
    """Whether Accept gives HTML a higher weight than JSON; of equal weights the more closely named type wins."""
    accepted = dict(_entries(request, "accept"))
    return _rank(accepted, ["text/html"]) > _rank(accepted, ["application/json", "application/geo+json"])


def _rank(accepted: dict[str, float], kinds: Sequence[str]) -> tuple[float, int]:
    """(weight, how closely it is named) of the best of some media types; the closest name of each decides."""
    ranks = [(0.0, 0)]
    for kind in kinds:
        names = (kind, f"{kind.partition('/')[0]}/*", "*/*")
        named = [(accepted[name], 3 - place) for place, name in enumerate(names) if name in accepted]
        ranks += [rank for rank in named[:1] if rank[0] > 0.0]
    return max(ranks)


def _entries(request: Request, header: str) -> Iterator[tuple[str, float]]:
    """(name, weight) of each entry of a header, in small letters."""
    for line in request.headers.getlist(header):
        for entry in line.lower().split(","):
            name, *parameters = (part.strip() for part in entry.split(";"))
            yield name, min([_weight(one) for one in parameters], default=1.0)


def _weight(parameter: str) -> float:
    """The q of an entry: 1 where none is stated, 0 for what is no number."""
    name, _, value = parameter.partition("=")
    if name.strip() != "q":
        return 1.0
    try:
        return float(value)
    except ValueError:
        return 0.0
