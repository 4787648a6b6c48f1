"""A ballot by itself: can it be read, and does it look like the word of a vehicle that knew where it was?"""

from __future__ import annotations

import numpy as np

from mapvote.codec.ballot import Ballot, BallotTile, decode, unpack_states
from mapvote.core.types import CellState, MapvoteError
from mapvote.doctor.finding import Finding

_CHANGED = (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY)
_DETERMINED = (CellState.UNCHANGED_OCCUPIED, CellState.UNCHANGED_EMPTY, *_CHANGED)
_MOST_CHANGED = 0.2
_SIGMA_M = 0.15


def check_ballot(data: bytes) -> list[Finding]:
    """Everything that shows in the bytes of a ballot."""
    try:
        ballot = decode(data)
        changed, determined = _counts(ballot.tiles)
    except MapvoteError as error:
        return [Finding("error", str(error), "cast it again from the drive, or copy it again")]
    found = _votes(ballot, changed, determined)
    if ballot.end_ns <= ballot.start_ns:
        found.append(Finding("error", "the drive ends before it begins", "mend the times of the drive, and vote again"))
    if ballot.scans_localised < 0.5 * ballot.scans:
        what = f"only {ballot.scans_localised} of {ballot.scans} scans were localised"
        found.append(Finding("warning", what, "is it the map of this street? mapvote doctor DRIVE --map MAP"))
    if ballot.median_sigma_m > _SIGMA_M:
        what = f"the vehicle knew where it was to {ballot.median_sigma_m:.2f} m only (median)"
        found.append(Finding("warning", what, "cells are 0.3 m: such votes blur"))
    misfit_m, sigma_m = ballot.prior_misfit_m, ballot.prior_sigma_m
    if misfit_m is not None and sigma_m is not None and misfit_m > max(3.0 * sigma_m, 0.5):
        what = f"the vehicle was {misfit_m:.1f} m off its prior (median), which claims {sigma_m:.2f} m"
        found.append(Finding("warning", what, "measure the offset: mapvote doctor DRIVE --map MAP"))
    return found


def _votes(ballot: Ballot, changed: int, determined: int) -> list[Finding]:
    if not ballot.tiles:
        what = "it votes on no tile: the vehicle never knew where it was, or saw no cell of the map"
        return [Finding("error", what, "see mapvote doctor DRIVE --map MAP")]
    if determined and changed > _MOST_CHANGED * determined:
        what = f"it calls {changed / determined:.0%} of the {determined:,} cells that it judges changed"
        return [Finding("warning", what, "a lost vehicle, or the wrong map? Streets change by a few per cent")]
    return []


def _counts(tiles: list[BallotTile]) -> tuple[int, int]:
    """(cells called changed, cells judged at all)."""
    counts = np.zeros(256, dtype=np.int64)
    for tile in tiles:
        if tile.states is not None:
            counts += np.bincount(unpack_states(tile.states).ravel(), minlength=256)
    return int(counts[list(_CHANGED)].sum()), int(counts[list(_DETERMINED)].sum())
