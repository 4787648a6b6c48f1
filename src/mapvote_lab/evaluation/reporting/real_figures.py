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
from mapvote.plots import GONE, INK, NEW, STATE_COLOURS, UNSURE, save
from mapvote_lab.evaluation.experiments.real.bench import Bench
from mapvote_lab.evaluation.experiments.real.changes import Asked
from mapvote_lab.evaluation.experiments.real.street import FalseChange, RealRun, changed, largest_false_changes

_HALF_M = 8.0
_MOST = 20
"""Close-ups."""
Spot = tuple[float, float, str]
"""x, y (map metres) and title of a close-up."""


def draw_worst(bench: Bench, case: str, folder: Path) -> list[Path]:
    """Pictures into ``folder``: false changes of the run with most of them, and what was cast into the scans."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    if bench.runs:
        worst = max(bench.runs, key=lambda name: bench.runs[name].changed_share(case, with_movers=False))
        for name in dict.fromkeys([next(iter(bench.runs)), worst]):
            run = bench.runs[name]
            written.append(folder / f"false_{_file_name(name)}.png")
            draw_false_changes(run, case, largest_false_changes(run, case), written[-1])
    for name, (run, asked) in bench.changed.items():
        written.append(folder / f"{_file_name(name)}.png")
        draw_things(run, case, asked, written[-1])
    return written


def _file_name(run: str) -> str:
    return run.replace(" ", "_").replace(",", "").replace("%", "percent")


def draw_false_changes(run: RealRun, case: str, found: Sequence[FalseChange], path: Path) -> None:
    """The whole street from above, and a close-up of each false change: map height grey, decided changes in colour."""
    picture = _street(run)
    for state in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        picture[run.states[case] == state] = to_rgb(STATE_COLOURS[state])
    spots = [(f.x, f.y, f"{f.m2:.1f} m²{', mover' if f.on_mover else ''}") for f in found[:10]]
    _draw(run, picture, f"{case}: nothing changed; red = decided new, blue = decided gone", spots, path)


def draw_things(run: RealRun, case: str, asked: Sequence[Asked], path: Path) -> None:
    """The whole street, and a close-up of each thing, the least found first: found, missed, falsely decided."""
    picture, states = _street(run), run.states[case]
    picture[changed(states)] = to_rgb(INK)
    share, spots = [], []
    x, y = run.street.grid.centres()
    for a in asked:
        picture[a.cells] = to_rgb(UNSURE)
        picture[a.cells & (states == a.state)] = to_rgb(NEW if a.state == CellState.CHANGED_OCCUPIED else GONE)
        if a.cells.any():
            rows, cols = np.nonzero(a.cells)
            share.append(float((states[a.cells] == a.state).mean()))
            spots.append((float(x[cols].mean()), float(y[rows].mean()), f"{a.kind}: {share[-1]:.0%}"))
    worst = [spots[k] for k in np.argsort(share, kind="stable")[:_MOST]]
    title = f"{case}: red = new and found, blue = gone and found, yellow = missed, black = false"
    _draw(run, picture, title, worst, path)


def _street(run: RealRun) -> F64:
    """(rows, cols, 3): the height of the map's points in grey."""
    reference = reference_window(run.street.point_map, run.street.grid)
    height = np.where(np.isfinite(reference.top_z), reference.top_z - reference.ground_z, 0.0).clip(0.0, 6.0)
    picture: F64 = np.repeat((1.0 - 0.5 * height / 6.0)[..., None], 3, axis=-1)
    picture[(height > 0) & (height < 0.6)] = 0.9
    return picture


def _draw(run: RealRun, picture: F64, title: str, spots: Sequence[Spot], path: Path) -> None:
    """The whole, and under it close-ups of 16 m, five to a row."""
    grid = run.street.grid
    extent = (grid.x0, grid.x0 + 0.3 * grid.cols, grid.y0, grid.y0 + 0.3 * grid.rows)
    rows = [[str(k + i) for i in range(5)] for k in range(0, len(spots), 5)]
    figure = Figure(figsize=(15, 9 + 2.8 * len(rows)), layout="constrained")
    heights = [9.0 / 2.8, *[1.0] * len(rows)]
    axes: Any = figure.subplot_mosaic([["all"] * 5, *rows], height_ratios=heights)
    axes["all"].imshow(picture, origin="lower", extent=extent)
    axes["all"].set_xlabel("east, m")
    axes["all"].set_ylabel("north, m")
    axes["all"].set_title(f"{run.street.recording.path.resolve().name}, {title}")
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
