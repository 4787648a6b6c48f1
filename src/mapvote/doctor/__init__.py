"""Faults of a drive, a map, a ballot or a store, and their mends: measured where they can be, not guessed.

:mod:`mapvote.doctor.diagnosis` lists the checks. docs/decisions/doctor.md gives the reasons.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal, get_args

from mapvote.core.types import F64, MapvoteError

Severity = Literal["error", "warning", "note"]
Progress = Callable[[str, int, int], None]
"""Called with (stage, done, in all)."""


Rule = Callable[[F64], F64]
"""Poses (n, 4, 4) from poses (n, 4, 4)."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A possible fault, and its mend."""

    name: str
    mend: str
    poses: Rule
    told_by: str = "prior"
    """Which side is wrong: "prior", "scans", or "order"."""
    catch_all: bool = False
    """Fits much that is wrong otherwise: named only where nothing more special fits."""
    angle: bool = False
    """Tells by how many degrees something is turned: a straight drive shows many a mistake as that."""
    left_handed: bool = False
    """The side that breaks the convention of axes."""


@dataclass(frozen=True, slots=True)
class Finding:
    """``error``: it cannot be used so. ``warning``: results will suffer. ``note``: worth knowing, or undecidable."""

    severity: Severity
    what: str
    mend: str = ""
    map_tells: bool = False
    """Whether a map can decide what the drive cannot: on one that it lies well on, nothing of this is left."""
    readings: tuple[Reading, ...] = ()
    """Readings of a prior and its scans among which the drive cannot decide; its map may."""


def any_error(findings: Iterable[Finding]) -> bool:
    """Whether one of them is an error."""
    return any(f.severity == "error" for f in findings)


def in_order(findings: Iterable[Finding]) -> list[Finding]:
    """Errors first; duplicates once."""
    return sorted(dict.fromkeys(findings), key=lambda finding: get_args(Severity).index(finding.severity))


def usable(path: str, findings: list[Finding]) -> list[Finding]:
    """The warnings among the findings at ``path``; MapvoteError with the first error, if there is one."""
    errors = [f for f in findings if f.severity == "error"]
    if errors:
        more = f" ({len(errors) - 1} more errors: mapvote doctor {path})" if len(errors) > 1 else ""
        stop = "" if errors[0].what.endswith("?") else "."
        raise MapvoteError(f"{path}: {errors[0].what}{stop} {errors[0].mend}{more}")
    return [f for f in findings if f.severity == "warning"]
