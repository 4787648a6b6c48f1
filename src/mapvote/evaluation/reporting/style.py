"""One look for every picture: the same colour always means the same thing."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from mapvote.core.types import NO_VOTE, U8, CellState
from mapvote.formats.atomic import whole_file

Format = Literal["png", "svg", "pdf"]
FORMATS: tuple[Format, ...] = "png", "svg", "pdf"
INK, PAPER_WHITE, FAINT = "#22303c", "#ffffff", "#8795a1"
NEW, GONE, STANDING, EMPTY, UNSURE = "#d7263d", "#1673c4", "#51687c", "#e6ecf1", "#f2c230"
STATE_COLOURS = {
    CellState.UNCHANGED_OCCUPIED: STANDING,
    CellState.UNCHANGED_EMPTY: EMPTY,
    CellState.CHANGED_OCCUPIED: NEW,
    CellState.CHANGED_EMPTY: GONE,
    CellState.UNDETERMINED: UNSURE,
}
STATE_NAMES = {
    CellState.UNCHANGED_OCCUPIED: "unchanged (occupied)",
    CellState.UNCHANGED_EMPTY: "unchanged (empty)",
    CellState.CHANGED_OCCUPIED: "changed (occupied)",
    CellState.CHANGED_EMPTY: "changed (empty)",
    CellState.UNDETERMINED: "undetermined",
}
STATE_MAP = ListedColormap([*STATE_COLOURS.values(), PAPER_WHITE])
VEHICLE_COLOURS = ("#22303c", "#e07b00", "#2a8f5b", "#8e44ad", "#7f5539", "#0b7a75", "#b5179e", "#6c757d")
"""Never red nor blue: those mean change."""
_FONT = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlesize": 10.5,
    "xtick.color": INK,
    "ytick.color": INK,
    "text.color": INK,
    "axes.linewidth": 0.8,
}


def state_image(states: U8) -> U8:
    """States as indices of STATE_MAP."""
    return np.where(states == NO_VOTE, len(CellState), states).astype(np.uint8)


def new_figure(width: float, height: float, rows: int = 1, cols: int = 1, **grid: Any) -> tuple[Figure, Any]:
    """A figure of inches and its axes, without pyplot and its global state."""
    import matplotlib

    with matplotlib.rc_context(_FONT):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        return figure, figure.subplots(rows, cols, squeeze=False, **grid)


def save(figure: Figure, path: Path, format: Format = "png") -> None:
    """Without dates or versions in it, whole or not at all: same picture, same bytes."""
    import matplotlib

    undated = {"png": {"Software": None}, "svg": {"Date": None, "Creator": None}, "pdf": {"CreationDate": None}}
    fixed = {"svg.hashsalt": "mapvote", "svg.fonttype": "none", "pdf.fonttype": 42}
    with matplotlib.rc_context(_FONT | fixed), whole_file(path) as partial:
        figure.savefig(partial, format=format, dpi=140, metadata=undated[format])
