"""Further truths that decided cells are scored against, by name: each says what part of the street it asks about."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from mapvote.core.types import U8
from mapvote.evaluation.scoring.border import border
from mapvote.evaluation.scoring.truth import Truth

TRUTHS: Mapping[str, Callable[[Truth], U8]] = {
    "border": lambda truth: border(truth, truth.strict),
    "border, provenance": lambda truth: border(truth, truth.provenance),
}
"""(rows, cols) classes or UNSCORED, beside ``Truth.strict`` and ``Truth.provenance``."""
