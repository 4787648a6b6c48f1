"""A case's budget as a picture: every true and every false cell in the colour of its cause."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from mapvote import plots as style
from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.types import U8, Bool
from mapvote_lab.evaluation.scoring.budget import FOUND

_COLOURS = (
    "#d7263d", "#1673c4", "#f2c230", "#2a8f5b", "#8e44ad", "#e07b00", "#22303c", "#7f5539", "#0b7a75", "#b5179e",
    "#6c757d",
)  # fmt: skip
_FOUND = "#c9d3db"


def budget_figure(case: str, causes: Mapping[str, tuple[Bool, U8, Sequence[str]]], grid: Grid) -> Figure:
    """One panel a budget; ``causes`` as :func:`mapvote_lab.evaluation.scoring.budget.causes` gives them."""
    width = 13.0
    tall = min(width * grid.rows / grid.cols, 7.0) + 1.0
    figure, axes = style.new_figure(width, tall * len(causes), len(causes), 1)
    extent = (grid.x0, grid.x0 + grid.cols * CELL_SIZE, grid.y0, grid.y0 + grid.rows * CELL_SIZE)
    for axis, (name, (cells, cause, named)) in zip(axes.ravel(), causes.items(), strict=True):
        image = np.ones((*grid.shape, 3))
        rows, cols = np.nonzero(cells)
        present = [k for k in range(len(named)) if (cause == k).any()]
        colour = {k: _FOUND if named[k] == FOUND else _COLOURS[k % len(_COLOURS)] for k in present}
        for k in present:
            at = cause == k
            for i in (-1, 0, 1):  # a cell of a long street is finer than a pixel
                image[np.clip(rows[at] + i, 0, grid.rows - 1), cols[at]] = to_rgb(colour[k])
        axis.imshow(image, origin="lower", extent=extent, interpolation="nearest")
        axis.set_title(f"Case {case}: {name.replace('_', ' ')}, {int(cells.sum()):,} cells", loc="left")
        axis.set_ylabel("y (m)")
        handles = [Patch(color=colour[k], label=f"{named[k]} ({int((cause == k).sum()):,})") for k in present]
        if handles:
            axis.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=3, frameon=False)
    return figure
