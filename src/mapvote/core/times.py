"""The one way in which a time is written."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import overload

_LAST_S = 253_402_300_799
"""End of the year 9999, seconds since 1970: ``datetime`` knows no later one."""


@overload
def utc(stamp_ns: int) -> str: ...


@overload
def utc(stamp_ns: int | None) -> str | None: ...


def utc(stamp_ns: int | None) -> str | None:
    """ISO 8601 in UTC of nanoseconds since 1970, whole seconds, the year 9999 at most; None where unknown."""
    if stamp_ns is None:
        return None
    return datetime.fromtimestamp(min(stamp_ns // 10**9, _LAST_S), UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
