"""Pictures of what was decided on a real street."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from mapvote.core.reference import reference_window
from mapvote.core.types import F64, CellState
from mapvote.evaluation.experiments.inject import Injection
from mapvote.evaluation.experiments.real_drive import FalseChange, RealRun, changed
from mapvote.evaluation.reporting.style import FAINT, GONE, INK, NEW, STATE_COLOURS, UNSURE, save

_HALF_M = 8.0
Spot = tuple[float, float, str]
"""x, y (map metres) and title of a close-up."""


def draw_false_changes(run: RealRun, case: str, found: Sequence[FalseChange], path: Path) -> None:
    """The whole street from above, and a close-up of each false change: map height grey, decided changes in colour."""
    picture = _street(run)
    for state in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        picture[run.states[case] == state] = to_rgb(STATE_COLOURS[state])
    spots = [(f.x, f.y, f"{f.m2:.1f} m²{', mover' if f.on_mover else ''}") for f in found[:10]]
    _draw(run, picture, f"{case}: nothing changed; red = decided new, blue = decided gone", spots, path)


def draw_injections(run: RealRun, case: str, injection: Injection, path: Path) -> None:
    """The whole street, and a close-up of each injected object: what was found of it, missed, and falsely decided."""
    picture, states = _street(run), run.states[case]
    built, demolished = injection.truth == 1, injection.truth == 2
    picture[changed(states)] = to_rgb(INK)
    picture[built & ~run.reached] = to_rgb(FAINT)
    picture[(built & run.reached) | demolished] = to_rgb(UNSURE)
    picture[built & (states == CellState.CHANGED_OCCUPIED)] = to_rgb(NEW)
    picture[demolished & (states == CellState.CHANGED_EMPTY)] = to_rgb(GONE)
    x, y = run.grid.centres()
    spots = []
    for kind, cells in injection.cells:
        rows, cols = np.nonzero(cells)
        spots.append((float(x[cols].mean()), float(y[rows].mean()), kind))
    title = f"{case}: red = built and found, blue = demolished and found, yellow = missed, grey = met by no ray"
    _draw(run, picture, f"{title}, black = false", spots, path)


def _street(run: RealRun) -> F64:
    """(rows, cols, 3): the height of the map's points in grey."""
    reference = reference_window(run.point_map, run.grid)
    height = np.where(np.isfinite(reference.top_z), reference.top_z - reference.ground_z, 0.0).clip(0.0, 6.0)
    picture: F64 = np.repeat((1.0 - 0.5 * height / 6.0)[..., None], 3, axis=-1)
    picture[(height > 0) & (height < 0.6)] = 0.9
    return picture


def _draw(run: RealRun, picture: F64, title: str, spots: Sequence[Spot], path: Path) -> None:
    """The whole, and under it close-ups of 16 m, five to a row."""
    grid = run.grid
    extent = (grid.x0, grid.x0 + 0.3 * grid.cols, grid.y0, grid.y0 + 0.3 * grid.rows)
    rows = [[str(k + i) for i in range(5)] for k in range(0, len(spots), 5)]
    figure = Figure(figsize=(15, 9 + 2.8 * len(rows)), layout="constrained")
    heights = [9.0 / 2.8, *[1.0] * len(rows)]
    axes: Any = figure.subplot_mosaic([["all"] * 5, *rows], height_ratios=heights)
    axes["all"].imshow(picture, origin="lower", extent=extent)
    axes["all"].set_xlabel("east, m")
    axes["all"].set_ylabel("north, m")
    axes["all"].set_title(f"KITTI 0001, {title}")
    for k in range(5 * len(rows)):
        ax = axes[str(k)]
        if k >= len(spots):
            ax.axis("off")
            continue
        x, y, name = spots[k]
        axes["all"].annotate(str(k + 1), (x, y), fontsize=12, weight="bold")
        ax.imshow(picture, origin="lower", extent=extent, interpolation="nearest")
        ax.set_xlim(x - _HALF_M, x + _HALF_M)
        ax.set_ylim(y - _HALF_M, y + _HALF_M)
        ax.set_title(f"{k + 1}: {name}", fontsize=10)
    save(figure, path)
