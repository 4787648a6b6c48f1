"""The truths that decided cells are held against, side by side, and how much of each lies at which height."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy import ndimage

from mapvote.config import PaperSettings
from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.types import F32, F64, U8, Reference
from mapvote_lab.evaluation.scoring.border import border
from mapvote_lab.evaluation.scoring.cells import UNSCORED
from mapvote_lab.evaluation.scoring.scene_truth import Truth

_UNCHANGED, _OCCUPIED, _EMPTY = 0, 1, 2
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
