"""The paper's open sentences: what it says, and how that can be read (``[paper]`` in the settings).

The defaults are the readings that reproduce the paper's Tables II to IV; docs/method.md says why.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pydantic import ValidationError

from mapvote.config import PaperSettings
from mapvote.core.types import MapvoteError


@dataclass(frozen=True, slots=True)
class OpenSentence:
    """A sentence, or a silence, that a program has to decide."""

    setting: str
    """Name of the setting in ``[paper]``."""
    section: str
    """Section of the paper."""
    quotation: str
    readings: Mapping[str | int | float, str]
    """Value of the setting -> its meaning for the sentence; for numbers, the values that a sweep tries."""


OPEN_SENTENCES: tuple[OpenSentence, ...] = (
    OpenSentence(
        "occluded",
        "III-A, III-B",
        "Undetermined: The new LiDAR point-cloud data in the cell are occluded and therefore unavailable. "
        "[...] if the LiDAR point-cloud data are mapped onto a cell during ten scans [...]",
        {
            "votes": "an occluded scan votes undetermined, which competes, as in Table I",
            "abstains": "a scan that maps no data onto a cell and cannot see it has no vote there",
        },
    ),
    OpenSentence(
        "few_points",
        "III-B",
        "Below this threshold, a cell cannot be classified as occupied.",
        {
            "undetermined": "something is there, but not enough of it: undetermined for that scan",
            "empty": "what is not occupied is empty",
        },
    ),
    OpenSentence(
        "movers",
        "II",
        "Because the map-update process requires only stationary-object information, LiDAR data corresponding to "
        "moving objects are removed using the occupancy grid-based method [9].",
        {
            "occlude": "a ray that ended on a car saw nothing behind it, whoever removes its point",
            "removed": "as Figure 1 draws it: they are gone before anything is projected, and hide nothing",
        },
    ),
    OpenSentence(
        "line_of_sight",
        "III-A, Figure 3",
        "Cells with black circles (LiDAR measurement points) indicate occupied cells; the white and green cells "
        "indicate empty and occluded cells, respectively.",
        {
            "points": "any point above the ground hides what is behind it, at all heights",
            "cells": "only points in occupied cells do: n_min of them or more, moving or not",
            "farthest": "only what is behind the farthest return in that direction is hidden",
            "column": "a cell is seen if a ray crosses the heights in which the map has points there",
        },
    ),
    OpenSentence(
        "tall_rule",
        "III-A",
        "Therefore, cells in which the height of objects in the environmental map exceeds that of the new LiDAR "
        "point-cloud data are treated as invalid cells and remain unclassified.",
        {
            "bottom": "where the map begins above the sensor's view at that range",
            "height": "where the map's highest point is above the scan's; a cell without points has height 0",
        },
    ),
    OpenSentence(
        "n_min",
        "III-B",
        "n_min (set to 5 in this study) is the minimum number of measurement points required to classify a cell as "
        "occupied.",
        {3: "fewer", 5: "as printed; but per 0.3 m cell, or per object?", 8: "more"},
    ),
    OpenSentence(
        "window_m",
        "III-A",
        "a square area with a side length of 80 m, centered at the self-position (V_i) of the i-th vehicle (i = 1, 2, "
        "...), is extracted from the environmental map",
        {
            80.0: "as printed: votes are cast up to the square's corners, 56.6 m away",
            60.0: "only nearer",
            40.0: "only much nearer",
        },
    ),
)


def readings_of(base: PaperSettings, only: str | None = None) -> dict[str, PaperSettings]:
    """By name ("as set", "occluded abstains", "n_min 3", ..): ``base``, and it with one sentence read otherwise.

    ``only``: the one setting that is varied; None: each in turn.
    """
    found = {"as set": base}
    for sentence in OPEN_SENTENCES:
        for value in sentence.readings:
            if only in (None, sentence.setting) and value != getattr(base, sentence.setting):
                found[f"{sentence.setting} {value}"] = base.model_copy(update={sentence.setting: value})
    return found


def read(base: PaperSettings, said: str) -> PaperSettings:
    """``base`` with what ``said`` changes: "occluded=abstains, n_min=3". MapvoteError names what there is."""
    values = base.model_dump()
    for piece in said.split(","):
        setting, _, value = (part.strip() for part in piece.partition("="))
        if setting not in values:
            raise MapvoteError(f"reading {piece.strip()!r}: choose {', '.join(values)}, as in occluded=abstains")
        values[setting] = value
    try:
        return PaperSettings.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise MapvoteError(f"reading {first['loc'][0]}={first['input']}: {first['msg']}") from error
