"""Which axis of a map's points is up: by the file's classification where it tells, else by the sheet of ground."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapvote.core.geometry import corners
from mapvote.core.record import record
from mapvote.core.types import F64, I64
from mapvote.doctor import Finding


@record()
@dataclass(frozen=True, slots=True)
class UpRule:
    """Numbers of the check."""

    column_m: float = 2.0
    """Side of the columns in which heights are compared."""
    sheet_m: float = 0.2
    """Thickness of the ground."""
    tall_m: float = 1.5
    """Least extent of a column that has something on its ground."""
    slender: float = 2.0
    """Times as high as it is wide a street may be."""
    least_sheet: float = 0.09
    """Share of the points on the ground, below which up is unknown: of a street .12 to .17 (simulated, KITTI)."""
    clear: float = 1.3
    """Times as many points as along z must lie on a sheet that proves another axis."""
    stands_m: float = 0.5
    """Least distance from classified ground of a point that stands on it."""
    least_points: int = 1000
    """Standing points, below which the classification proves nothing."""
    mostly: float = 0.7
    """Share of the standing points on one side of the classified ground that proves which side is up."""


RULE = UpRule()
_UPSIDE_DOWN = Finding(
    "error",
    "the map is upside down: things hang below the ground",
    "negate y and z of every point (only z, if right and left are right already)",
)


def which_way_up(sample: F64, wide: F64, ground: F64) -> Iterator[Finding]:
    """Faults of the axes of points ``sample`` (n, 3) of extent ``wide`` (3,). ``ground`` (m, 3): those that their file
    classifies as ground, which outweigh every guess: a city of flat roofs looks alike from below."""
    above = _share_above(sample, ground)
    if above is not None:
        if above < 1.0 - RULE.mostly:
            yield _UPSIDE_DOWN
        if not 1.0 - RULE.mostly <= above <= RULE.mostly:
            return
    yield from _by_sheet(sample, wide)


def _share_above(sample: F64, ground: F64) -> float | None:
    """Share of the points standing off the classified ground of their column that lie above it; None if few do."""
    if len(ground) < RULE.least_points:
        return None
    low = np.minimum(sample[:, :2].min(axis=0), ground[:, :2].min(axis=0))
    width = int(np.ceil((max(sample[:, 1].max(), ground[:, 1].max()) - low[1]) / RULE.column_m)) + 1
    at_ground = _columns(ground[:, :2] - low, width)
    at_points = _columns(sample[:, :2] - low, width)
    # The middle height of the ground of each column that has some.
    order = np.lexsort((ground[:, 2], at_ground))
    keys, starts, counts = np.unique(at_ground[order], return_index=True, return_counts=True)
    heights = ground[order, 2][starts + counts // 2]
    place = np.minimum(np.searchsorted(keys, at_points), len(keys) - 1)
    matched = keys[place] == at_points
    off = sample[matched, 2] - heights[place[matched]]
    stands = np.abs(off) > RULE.stands_m
    return float((off[stands] > 0).mean()) if stands.sum() >= RULE.least_points else None


def _columns(xy: F64, width: int) -> I64:
    cells = np.floor(xy / RULE.column_m).astype(np.int64)
    return np.asarray(cells[:, 0] * width + cells[:, 1])


def _by_sheet(sample: F64, wide: F64) -> Iterator[Finding]:
    """A street is a sheet of ground with things on it, none below, and not higher than it is wide: rows of house fronts
    behind each other are no ground."""
    share = {sign + axis: 0.0 for axis in "xyz" for sign in "+-"}
    for axis, name in enumerate("xyz"):
        if wide[axis] <= RULE.slender * wide[2]:
            share["+" + name], share["-" + name] = _sheet_shares(sample, axis)
    best = max(share, key=lambda name: share[name])
    opposite = ("-" if best[0] == "+" else "+") + best[1]
    # Between two walls, as much lies at one end of an axis as at the other: that is no ground.
    least = max(RULE.least_sheet, RULE.clear * share["+z"], RULE.clear * share[opposite])
    if best == "+z" or share[best] < least:
        return
    if best == "-z":
        yield _UPSIDE_DOWN
    else:
        mend = "turn the points so that z is up (x east, y north)"
        yield Finding("error", f"the map's axis {best} points up, not z", mend)


def _sheet_shares(points: F64, axis: int) -> tuple[float, float]:
    """Share of the points that lie within 0.2 m of the lowest of their column of 2 m along ``axis``; and of the highest
    one, the lowest along its opposite."""
    others = [a for a in range(3) if a != axis]
    xy = points[:, others]
    cells = np.floor((xy - corners(xy)[0]) / RULE.column_m).astype(np.int64)
    key = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    order = np.argsort(points[:, axis])
    key = key[order]  # short numbers are sorted without comparing them
    columns = np.argsort(key.astype(np.uint16) if key.max() < 1 << 16 else key, kind="stable")
    key = key[columns]
    height = points[order[columns], axis]
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    counts = np.diff(np.append(starts, len(key)))
    ends = starts + counts - 1
    tall = np.repeat(height[ends] - height[starts] > RULE.tall_m, counts)

    def share(sheet: NDArray[np.floating]) -> float:
        return float(((np.abs(height - np.repeat(sheet, counts)) < RULE.sheet_m) & tall).mean())

    return share(height[starts + counts // 20]), share(height[ends - counts // 20])
