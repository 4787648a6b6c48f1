"""What the doctor says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True, slots=True)
class Finding:
    """``error``: the drive cannot be used so. ``warning``: results will suffer. ``note``: worth knowing."""

    severity: Severity
    what: str
    mend: str = ""
