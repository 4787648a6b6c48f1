"""What the doctor says."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]
Progress = Callable[[str, int, int], None]
"""Told (stage, done, in all)."""
_ORDER = {"error": 0, "warning": 1, "note": 2}


@dataclass(frozen=True, slots=True)
class Finding:
    """``error``: it cannot be used so. ``warning``: results will suffer. ``note``: worth knowing."""

    severity: Severity
    what: str
    mend: str = ""
    map_tells: bool = False
    """Whether a map can tell what the drive cannot: on one that it lies well on, nothing of this is left."""


def in_order(found: Iterable[Finding]) -> list[Finding]:
    """Errors first; the same said once."""
    return sorted(dict.fromkeys(found), key=lambda f: _ORDER[f.severity])
