"""What no method can tell: cells that a few centimetres of position decide, and what perfect labels would score.

A wall two centimetres from a cell's border fills one cell of a noise-free truth, and two of any cloud with two
centimetres of range noise. **border** is a truth without the cells that change sides when the surfaces move by
:data:`BORDER_M`. :func:`ceiling` is the score of a judge who knows of every point of such a cloud whether its surface
came, went or stayed, but has to answer in cells.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from mapvote.core.grid import CELL_SIZE
from mapvote.core.types import F64, I32, U8, Bool, CellState
from mapvote_lab.evaluation.scoring.cells import CLASSES, UNSCORED, Scores, score_cells
from mapvote_lab.evaluation.scoring.scene_truth import Truth

BORDER_M = 0.05
NOISE_M = 0.02
"""Range noise of the simulated sensors."""
_DRAWS = 8
_LEAST_POINTS = (1, 2, 4, 8, 16, 32, 64, 128)
_OCCUPIED, _EMPTY = CLASSES.index("changed_occupied"), CLASSES.index("changed_empty")


def border(truth: Truth, cells: U8) -> U8:
    """(rows, cols) ``cells``, one of the two definitions of ``truth``, with UNSCORED where :data:`BORDER_M` decide.

    These are changed cells whose changed surface lies only in the rim of the cell, changed cells next to whose rim
    something stands, and unchanged cells that no standing surface fills firmly, with a changed one at their rim.
    Surfaces are the noise-free samples, .1 m apart (standing ones .25 m), of what rays could reach.
    """
    seen, added, removed = _around(truth, cells)
    changed = np.isin(cells, (_OCCUPIED, _EMPTY))
    moved = {kind: _rims(truth, samples) for kind, samples in ((_OCCUPIED, added), (_EMPTY, removed))}
    stands, stands_near = _rims(truth, seen)
    unsure = changed & stands_near
    for kind, (firm, near) in moved.items():
        unsure |= (cells == kind) & ~firm
        unsure |= ~changed & near & ~stands
    return np.where(unsure, np.uint8(UNSCORED), cells)


def _around(truth: Truth, cells: U8) -> tuple[F64, F64, F64]:
    """Surface samples (n, 3) that (stand, came, went); of the standing ones those that can be seen near a change."""
    kept, added, removed = truth.surfaces()
    changed = np.isin(cells, (_OCCUPIED, _EMPTY))
    rim = np.ones((3, 3), dtype=np.bool_)
    near = ndimage.binary_dilation(changed | (_count(truth, np.concatenate([added, removed])) > 0), rim)
    beside = near & ~changed  # what a changed cell holds of what stands was hidden, or lies on the ground
    return kept[_at(truth, kept, beside)], added, removed


def _rims(truth: Truth, samples: F64) -> tuple[Bool, Bool]:
    """(cells with a sample farther than BORDER_M from their rim, cells with one no farther than that outside it)."""
    x, y = (samples[:, 0] - truth.x0) % CELL_SIZE, (samples[:, 1] - truth.y0) % CELL_SIZE
    inner = np.abs(np.column_stack([x, y]) - CELL_SIZE / 2).max(axis=1, initial=0.0) < CELL_SIZE / 2 - BORDER_M
    firm = _count(truth, samples[inner]) > 0
    near = np.zeros_like(firm)
    for dx in (-BORDER_M, BORDER_M):
        for dy in (-BORDER_M, BORDER_M):
            near |= _count(truth, samples + np.array([dx, dy, 0.0])) > 0
    return firm, near


def _at(truth: Truth, samples: F64, plane: Bool) -> Bool:
    """(n,) what ``plane`` (rows, cols) says at samples (n, 3); False outside it."""
    r, c, inside = _indices(truth, samples)
    out = np.zeros(len(samples), dtype=np.bool_)
    out[inside] = plane[r[inside], c[inside]]
    return out


def _count(truth: Truth, samples: F64) -> I32:
    """(rows, cols) samples in each cell."""
    r, c, inside = _indices(truth, samples)
    rows, cols = truth.strict.shape
    return np.bincount(r[inside] * cols + c[inside], minlength=rows * cols).reshape(rows, cols).astype(np.int32)


def _indices(truth: Truth, samples: F64) -> tuple[I32, I32, Bool]:
    c = np.floor((samples[:, 0] - truth.x0) / CELL_SIZE).astype(np.int32)
    r = np.floor((samples[:, 1] - truth.y0) / CELL_SIZE).astype(np.int32)
    rows, cols = truth.strict.shape
    return r, c, (r >= 0) & (r < rows) & (c >= 0) & (c < cols)


def ceiling(truth: Truth, cells: U8) -> Scores:
    """The best that perfect labels on a cloud with range noise score against ``cells``.

    Every surface sample is measured :data:`_DRAWS` times, :data:`NOISE_M` off in the plane. A cell is changed if it
    holds enough points of a surface that came, or went, and none of one that stands; how many are enough is chosen on
    the truth itself, so no method that votes in cells can be expected to do better.
    """
    kept, added, removed = _around(truth, cells)
    rng = np.random.default_rng(0)
    stands, came, went = (_measured(truth, samples, rng) for samples in (kept, added, removed))
    best = [score_cells(_answer(stands, came, went, least), cells) for least in _LEAST_POINTS]
    return max(best, key=lambda scores: scores.macro_f1)


def _measured(truth: Truth, samples: F64, rng: np.random.Generator) -> I32:
    out = np.zeros(truth.strict.shape, dtype=np.int32)
    for _ in range(_DRAWS):
        noise = rng.normal(0.0, NOISE_M, samples.shape)
        noise[:, 2] = 0.0
        out += _count(truth, samples + noise)
    return out


def _answer(stands: I32, came: I32, went: I32, least: int) -> U8:
    states = np.full(stands.shape, CellState.UNCHANGED_EMPTY, dtype=np.uint8)
    states[(went >= least) & (stands < least) & (came < least)] = CellState.CHANGED_EMPTY
    states[(came >= least) & (stands < least) & (went < least)] = CellState.CHANGED_OCCUPIED
    return states
