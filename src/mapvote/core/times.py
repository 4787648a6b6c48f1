"""The one way in which a time is written, and whether it has a date."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import overload


@overload
def utc(stamp_ns: int) -> str: ...


@overload
def utc(stamp_ns: int | None) -> str | None: ...


def utc(stamp_ns: int | None) -> str | None:
    """ISO 8601 in UTC of nanoseconds since 1970, whole seconds, the year 9999 at most; None where unknown."""
    if stamp_ns is None:
        return None
    last_s = 253_402_300_799  # the end of the year 9999: ``datetime`` knows no later one
    return datetime.fromtimestamp(min(stamp_ns // 10**9, last_s), UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def has_date(stamp_ns: int) -> bool:
    """Whether nanoseconds count from 1970: they lie after the year 2000. No drive was recorded before it, and no clock
    that starts with the sensor has come so far."""
    return stamp_ns > 946_684_800 * 10**9
