"""Pictures of what was decided on a real street."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from mapvote.core.columns import reference_window
from mapvote.core.types import CellState
from mapvote.evaluation.real import FalseChange, RealRun
from mapvote.evaluation.style import STATE_COLOURS, save

_HALF_M = 8.0


def draw_false_changes(run: RealRun, case: str, found: Sequence[FalseChange], path: Path) -> None:
    """The whole street from above, and a close-up of each false change: map height grey, decided changes in colour."""
    reference = reference_window(run.point_map, run.grid)
    height = np.where(np.isfinite(reference.top_z), reference.top_z - reference.ground_z, 0.0).clip(0.0, 6.0)
    picture = np.repeat((1.0 - 0.5 * height / 6.0)[..., None], 3, axis=-1)
    picture[(height > 0) & (height < 0.6)] = 0.9
    for state in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        picture[run.states[case] == state] = to_rgb(STATE_COLOURS[state])
    grid = run.grid
    extent = (grid.x0, grid.x0 + 0.3 * grid.cols, grid.y0, grid.y0 + 0.3 * grid.rows)
    figure = Figure(figsize=(15, 13), layout="constrained")
    axes: Any = figure.subplot_mosaic([["all"] * 5, list("01234"), list("56789")], height_ratios=[2.2, 1, 1])
    axes["all"].imshow(picture, origin="lower", extent=extent)
    axes["all"].set_xlabel("east, m")
    axes["all"].set_ylabel("north, m")
    axes["all"].set_title(f"KITTI 0001, {case}: nothing changed; red = decided new, blue = decided gone")
    for k in range(10):
        ax = axes[str(k)]
        if k >= len(found):
            ax.axis("off")
            continue
        item = found[k]
        axes["all"].annotate(str(k + 1), (item.x, item.y), fontsize=12, weight="bold")
        ax.imshow(picture, origin="lower", extent=extent, interpolation="nearest")
        ax.set_xlim(item.x - _HALF_M, item.x + _HALF_M)
        ax.set_ylim(item.y - _HALF_M, item.y + _HALF_M)
        ax.set_title(f"{k + 1}: {item.m2:.1f} m²{', mover' if item.on_mover else ''}", fontsize=10)
    save(figure, path)
