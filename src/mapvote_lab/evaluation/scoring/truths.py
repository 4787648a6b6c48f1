"""The truths that decided cells are held against, side by side, and what perfect labels would score.

A wall two centimetres from a cell's border fills one cell of a noise-free truth, and two of any cloud with two
centimetres of range noise. **border** is a truth without the cells that change sides when the surfaces move by
:data:`BORDER_M`. :func:`ceiling` is the score of a judge who knows of every point of such a cloud whether its surface
came, went or stayed, but has to answer in cells.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy import ndimage

from mapvote.config import PaperSettings
from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.types import F32, F64, I32, U8, Bool, CellState, Reference
from mapvote_lab.evaluation.scoring.cells import UNSCORED, Scores, score_cells
from mapvote_lab.evaluation.scoring.scene_truth import Truth

BORDER_M = 0.05
NOISE_M = 0.02
"""Range noise of the simulated sensors."""
_DRAWS = 8
_LEAST_POINTS = (1, 2, 4, 8, 16, 32, 64, 128)
_UNCHANGED, _OCCUPIED, _EMPTY = 0, 1, 2


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


ON_SURFACE_M = 0.3
"""A map point farther than this from every surface lies on none (as scoring/map_points.py has it)."""


def could_be_known(truth: Truth, first_map: Reference) -> U8:
    """Provenance, less what a vote by scans cannot know: (rows, cols).

    A built surface of which no scan of any vehicle had n_min points in the cell (they count the true points, of the
    simulator), and a demolished one of which the map holds no point. Both are unscored.
    """
    out = truth.provenance.copy()
    out[(out == _OCCUPIED) & (truth.densest < PaperSettings().n_min)] = UNSCORED
    out[(out == _EMPTY) & (first_map.counts == 0)] = UNSCORED
    return out


def known(truth: Truth, first_map: Reference) -> U8:
    """``border`` of the strict truth, less the cells of which nobody could know better: (rows, cols).

    Unscored besides are a built surface of which no vehicle recorded a point in the cell, a demolished one through
    whose place no vehicle's ray went, and an unchanged cell in which the first map holds points on nothing: it has
    points, and no surface that stood at the survey comes within ON_SURFACE_M of the cell.
    """
    out = border(truth, truth.strict)
    undecided = ((out == _OCCUPIED) & ~truth.hit) | ((out == _EMPTY) & ~truth.passed)
    kept, _, removed = truth.surfaces()
    stood = np.zeros(out.shape, dtype=np.bool_)
    rows, cols, inside = first_map.grid.indices_of(np.concatenate([kept, removed]))
    stood[rows[inside], cols[inside]] = True
    near = ndimage.binary_dilation(stood, np.ones((3, 3)), iterations=round(ON_SURFACE_M / CELL_SIZE))
    on_nothing = (out == _UNCHANGED) & (first_map.counts > 0) & ~near
    return np.where(undecided | on_nothing, np.uint8(UNSCORED), out)


TRUTHS: Mapping[str, Callable[[Truth, Reference], U8]] = {
    "known": known,
    "strict": lambda truth, first_map: truth.strict,
    "provenance": lambda truth, first_map: truth.provenance,
    "could be known": could_be_known,
    "border": lambda truth, first_map: border(truth, truth.strict),
    "border, provenance": lambda truth, first_map: border(truth, truth.provenance),
}
"""What each calls a cell, over the window of the truth: 0 unchanged, 1 changed-occupied, 2 changed-empty, 255 unscored;
``first_map`` is the map that is voted on, over the same window (docs/decisions/truth.md)."""

SIDE_BY_SIDE = ("strict", "provenance", "could be known")
"""Those that differ in what they ask for, whose sizes are told."""

BANDS = ("below 1.5 m", "1.5 to 4 m", "above 4 m", "no sample")
"""Where the lowest changed surface of a cell lies above the ground; "no sample": the noise-free survey met none."""
_EDGES_M = (1.5, 4.0)


def sizes_by_height(states: U8, truth: Truth, first_map: Reference) -> dict[str, dict[str, int]]:
    """How many changed cells of a truth's ``states`` (rows, cols) lie in each of BANDS, by class."""
    _, added, removed = truth.surfaces()
    return {
        name: _by_band(states == value, lowest_surface(samples, first_map.grid, first_map.ground_z))
        for name, value, samples in (("changed_occupied", _OCCUPIED, added), ("changed_empty", _EMPTY, removed))
    }


def lowest_surface(samples: F64, grid: Grid, ground_z: F32) -> F64:
    """(rows, cols) height of the lowest of ``samples`` (n, 3) above the ground by cell; inf where there is none."""
    lowest = np.full(grid.shape, np.inf)
    rows, cols, inside = grid.indices_of(samples)
    rows, cols = rows[inside], cols[inside]
    height = samples[inside, 2] - ground_z[rows, cols]
    known = height >= 0.0
    np.minimum.at(lowest, (rows[known], cols[known]), height[known])
    return lowest


def _by_band(cells: np.ndarray, lowest: F64) -> dict[str, int]:
    heights = lowest[cells]
    band = np.where(np.isinf(heights), len(_EDGES_M) + 1, np.digitize(heights, _EDGES_M))
    return {name: int(np.count_nonzero(band == k)) for k, name in enumerate(BANDS)}
