"""A part of a list: how many, after how many, and in which box. The header Link names the next part (RFC 8288)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import Depends, Query, Request, Response

from mapvote.shapes.geojson import Bounds

BoxQuery = Annotated[
    str | None,
    Query(
        alias="bbox",
        pattern=r"^-?[0-9]{1,9}(\.[0-9]{1,9})?(,-?[0-9]{1,9}(\.[0-9]{1,9})?){3}$",
        description="two opposite corners x0,y0,x1,y1 in map metres: only what meets this box",
    ),
]


@dataclass(frozen=True, slots=True)
class Part:
    """Which part of a list."""

    limit: int | None
    """None: all of it."""
    offset: int

    @property
    def rows(self) -> slice:
        """Positions of its rows in the list."""
        return slice(self.offset, None if self.limit is None else self.offset + self.limit)

    def of(self, rows: Sequence[Any]) -> list[Any]:
        """The rows of this part."""
        return list(rows[self.rows])

    def link(self, request: Request, answer: Response, matched: int, **pinned: str) -> Response:
        """The answer, with the address of the next part if fewer than all ``matched`` rows end with this one.
        ``pinned``: parameters that the next request must have."""
        after = matched if self.limit is None else self.offset + self.limit
        if after < matched:
            following = dict(request.query_params) | pinned | {"offset": str(after)}
            answer.headers["Link"] = f'<?{urlencode(following)}>; rel="next"'
        return answer


async def _part(
    limit: Annotated[int | None, Query(ge=1, le=10_000, description="so many at most; all if left out")] = None,
    offset: Annotated[int, Query(ge=0, le=(1 << 31) - 1, description="after so many")] = 0,
) -> Part:
    return Part(limit, offset)


async def _box(bbox: BoxQuery = None) -> Bounds | None:
    return box_in(bbox)


def box_in(text: str | None) -> Bounds | None:
    """The box of a query, whichever two opposite corners it names; None without one."""
    if text is None:
        return None
    x0, y0, x1, y1 = map(float, text.split(","))
    return min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1)


PartAsked = Annotated[Part, Depends(_part)]
BoxAsked = Annotated[Bounds | None, Depends(_box)]
"""Parameters of routes that list."""
