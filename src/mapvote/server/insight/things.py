"""Pieces of change -> things: the walls of one building belong together, the house next door does not."""

from __future__ import annotations

import numpy as np
import scipy

from mapvote.core.grid import CELL_SIZE
from mapvote.core.types import F64, I32, I64

REACH_M = 1.5
"""How far from a thing's hull a piece may lie and still be part of it: a gap that occlusion leaves in a wall."""
PART_SHARE = 1 / 3
"""A piece larger than this share of its neighbour is a thing of its own, unless their hulls overlap: houses stand
closer to each other than the walls of one house."""

TOUCH_CELLS = 1.0
"""Hulls that overlap no more than that only touch: houses wall to wall."""


def group(rows: I64, cols: I64, kinds: I64, pieces: I32, reach_m: float = REACH_M) -> I32:
    """(n,) labels of things, 0 ... k - 1, of cells (n,) whose ``pieces`` are 8-connected and of one kind each.

    From the largest piece down, each joins the nearest thing of its kind within ``reach_m`` of whose convex hull it
    lies, or becomes one. A label's number follows the order of its first cell.
    """
    if not len(rows):
        return np.zeros(0, dtype=np.int32)
    members = np.split(np.argsort(pieces, kind="stable"), np.cumsum(np.bincount(pieces))[:-1])
    corners = [_corners(rows[m], cols[m]) for m in members]
    low = np.array([c.min(axis=0) for c in corners])
    high = np.array([c.max(axis=0) for c in corners])
    size = np.array([len(m) for m in members])
    kind = np.array([kinds[m[0]] for m in members])
    owner = np.arange(len(members))
    reach = reach_m / CELL_SIZE
    leaders: dict[int, list[int]] = {int(k): [] for k in np.unique(kind)}
    hulls: dict[int, F64] = {}
    for piece in np.argsort(-size, kind="stable").tolist():
        same = np.array(leaders[int(kind[piece])], dtype=np.int64)
        near = same[((low[same] <= high[piece] + reach) & (high[same] >= low[piece] - reach)).all(axis=1)]
        gaps = [_gap(hulls[leader], corners[piece]) for leader in near.tolist()]
        fits = [
            (gap, leader)
            for gap, leader in zip(gaps, near.tolist(), strict=True)
            if gap < -TOUCH_CELLS or (gap <= reach and size[piece] <= PART_SHARE * size[leader])
        ]
        if fits:
            owner[piece] = min(fits)[1]
        else:
            leaders[int(kind[piece])].append(piece)
            hulls[piece] = scipy.spatial.ConvexHull(corners[piece]).equations
    return _in_order(owner[pieces])


def widths_m(rows: I64, cols: I64, pieces: I32) -> F64:
    """(k,) metres: the narrowest gate that each piece (n,) labels 0 ... k - 1 would fit through, across a side of its
    convex hull."""
    members = np.split(np.argsort(pieces, kind="stable"), np.cumsum(np.bincount(pieces))[:-1])
    return np.array([_width(_corners(rows[m], cols[m])) for m in members]) * CELL_SIZE


def _width(corners: F64) -> float:
    across = corners @ scipy.spatial.ConvexHull(corners).equations[:, :2].T
    return float(np.ptp(across, axis=0).min())


def _corners(rows: I64, cols: I64) -> F64:
    """(4 n, 2) corners of cells, in cells."""
    lower = np.stack([cols, rows], axis=1).astype(np.float64)
    return np.concatenate([lower + corner for corner in np.array([(0, 0), (1, 0), (0, 1), (1, 1)])])


def _gap(hull: F64, corners: F64) -> float:
    """Cells from a convex hull (k, 3) to the nearest of some corners, beyond its farthest side; negative inside."""
    return float((corners @ hull[:, :2].T + hull[:, 2]).max(axis=1).min())


def _in_order(label: I64) -> I32:
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int32)
    rank[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
    return rank[inverse]
