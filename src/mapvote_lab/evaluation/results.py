"""What experiments measure, typed; the same structures are the JSON of ``evaluate --json``.

Lengths in metres, times in seconds and angles in degrees unless the name says otherwise; shares from 0 to 1.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import msgspec

from mapvote_lab.evaluation.scores import MapScores, ObjectScores, Scores


class PoseErrors(msgspec.Struct, frozen=True, kw_only=True):
    """Of a drive's scans: over those that were localised."""

    scans: int
    localised: int
    median_m: float
    p99_m: float
    max_m: float
    median_deg: float


class CaseResult(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One case of ``evaluate``, or a yardstick: how decided cells compare with the truth, and what became of the
    map."""

    strict: Scores
    """Against all that changed where a survey's or a vehicle's ray could reach."""
    provenance: Scores
    """Against what changed of the points that the first map holds."""
    coverage: float
    """Share of the scored cells that some vehicle determined."""
    objects: ObjectScores
    also: dict[str, Scores] = {}
    """By the further truths of ``evaluation/truths.py``."""
    map: MapScores | None = None
    """None (not in the JSON) where no map was edited: the yardsticks only decide cells."""
    bytes_per_vehicle: list[int]
    """Of each ballot; empty for a yardstick, which sends none."""
    state_bytes_per_vehicle: list[int] | None = None
    """Of the votes alone, without new points and other planes."""


class MapShift(msgspec.Struct, frozen=True):
    """How far the first map lies from the truth."""

    mean_m: float
    x_m: float
    y_m: float
    z_m: float
    p95_m: float


class Cost(msgspec.Struct, frozen=True):
    """Of one method on a vehicle."""

    beams: int
    ms_per_scan: float
    """Median, milliseconds."""
    memory_bytes: float
    """Of its grid."""


class Timings(msgspec.Struct, frozen=True, kw_only=True):
    """Wall time; what is left of a run whose other numbers are all repeatable."""

    prepare_s: float
    vote_s: float
    score_s: float
    yardsticks_s: float
    methods: dict[str, Cost]
    stages_ms: dict[str, dict[str, float]]
    """By vehicle and stage: median milliseconds a scan."""
    fuse_s: dict[str, float]
    """By case."""


class EvaluationResult(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One scenario and seed: what ``evaluate --json`` writes."""

    scenario: str
    seed: int
    poses: str
    """"ndt" or "truth"."""
    cells: int
    """In the truth's window."""
    coverage: float
    """Of the case whose updated map is shown."""
    settings: dict[str, Any]
    map_shift: MapShift
    localisation: dict[str, PoseErrors]
    """By vehicle."""
    changed_areas: dict[str, PoseErrors]
    """One vehicle's scans near changes, by map."""
    ceilings: dict[str, Scores]
    """By truth: what perfect labels on every measured point would score in cells."""
    cases: dict[str, CaseResult]
    readings: dict[str, dict[str, dict[str, Scores]]] = {}
    """By reading of the paper, case and truth, if asked for."""
    timings: Timings


def to_json(result: msgspec.Struct | Mapping[str, Any]) -> str:
    """Indented, keys sorted; ValueError if a number is NaN or infinite."""
    return json.dumps(msgspec.to_builtins(result), indent=1, sort_keys=True, allow_nan=False) + "\n"
