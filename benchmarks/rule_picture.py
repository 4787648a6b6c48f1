"""The picture of docs/method.md: a panel for each line of the rule of surfaces, decided by the rule itself.

    python benchmarks/rule_picture.py docs/pictures/rules.png

Lines 1 and 2 are one mapped and one free voxel over their counts. The others are streets one cell wide, seen from the
side: a square is a voxel of 0.3 m, with what the scans say of it; the bar below a column is what the rule makes of its
cell.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from mapvote.core.grid import TILE_CELLS
from mapvote.core.types import I32, U8, U64, CellState
from mapvote.detection.evidence import CROSSED, HIT, WORDS, Facts, judge_window, weigh_voxels
from mapvote.detection.packed_tiles import PLANES, Overlap
from mapvote.plots import EMPTY, FAINT, GONE, INK, NEW, STANDING, UNSURE

CELLS, LAYERS = 18, 11
COLOURS = {"gone": GONE, "stands": STANDING, "new": NEW, "beyond": "#f0a0ab", "passed": EMPTY}
"""What the scans say of a voxel. A mapped voxel of which they say nothing, or that rays passed too seldom, is an
outline."""
BARS = {
    CellState.CHANGED_EMPTY: GONE,
    CellState.CHANGED_OCCUPIED: NEW,
    CellState.UNCHANGED_OCCUPIED: STANDING,
    CellState.UNCHANGED_EMPTY: EMPTY,
    CellState.UNDETERMINED: UNSURE,
}


def column(first: int, last: int) -> np.uint64:
    """The word of the voxels ``first`` to ``last``; 1 is the lowest above the ground."""
    return np.uint64((1 << (last + 1)) - (1 << first))


Side = Mapping[str, list[tuple[range, int, int]]]
"""Of what is said of voxels, or "mapped" without a word: cells, lowest and highest voxel."""
SIDES: dict[str, Side] = {
    "3  empty: one voxel gone, none stands": {
        "gone": [(range(4, 5), 1, 8), (range(12, 13), 1, 6)],
        "stands": [(range(12, 13), 7, 8)],
    },
    "4  enough: six gone voxels": {"gone": [(range(4, 5), 1, 6), (range(12, 14), 7, 8)]},
    "5  deleted with it: half of it passed": {
        "gone": [(range(4, 5), 1, 8)],
        "mapped": [(range(5, 9), 1, 8), (range(9, 11), 9, 9), (range(14, 16), 1, 8)],
        "passed": [(range(5, 9), 3, 6), (range(9, 11), 3, 6), (range(14, 16), 3, 6)],
    },
    "6  what was hidden behind it": {
        "gone": [(range(3, 4), 1, 8)],
        "beyond": [(range(5, 6), 1, 8), (range(13, 14), 1, 8)],
    },
    "7  hit as often as passed": {"new": [(range(3, 6), 1, 4), (range(12, 15), 1, 4)]},
    "8  enough: 6, and 2 for each further cell": {"new": [(range(2, 6), 6, 8), (range(11, 15), 6, 7)]},
    "9  a separate small object: a bollard": {
        "new": [(range(4, 5), 1, 2), (range(12, 13), 1, 2)],
        "stands": [(range(13, 14), 1, 8)],
    },
}
DRIVEN_BY = {"7  hit as often as passed": range(12, 15)}
"""Cells whose new voxels were passed more often than hit."""


def decided(name: str) -> tuple[U64, Facts, U8]:
    """The occupied voxels of a side, what is said of its voxels, and what the rule says of its cells: (1, CELLS)."""
    facts, occupied = Facts.none((1, CELLS)), np.zeros((1, CELLS), np.uint64)
    for said, where in SIDES[name].items():
        for cells, first, last in where:
            plane: U64 = occupied if said == "mapped" else getattr(facts, said)
            plane[0, list(cells)] |= column(first, last)
    occupied |= facts.gone | facts.stands
    facts.passed[:] |= facts.gone
    facts.balance[0, list(DRIVEN_BY.get(name, ()))] = -1
    rise_m = np.where(occupied != 0, np.float32(3.0), np.float32(np.nan))
    return occupied, facts, judge_window(facts, occupied, rise_m, 0.3)[0]


def draw_side(axes: Any, name: str) -> None:
    """One panel of lines 3 to 9."""
    occupied, facts, states = decided(name)
    planes = {"mapped": occupied, **{said: getattr(facts, said) for said in reversed(COLOURS)}}
    for said, plane in planes.items():
        for x in range(CELLS):
            for z in range(1, LAYERS):
                if plane[0, x] >> np.uint64(z) & np.uint64(1):
                    fill = COLOURS.get(said, "none")
                    axes.add_patch(_square(x, z, fill, FAINT if said == "passed" else INK))
    for x in range(CELLS):
        if states[0, x] in BARS:
            axes.add_patch(_square(x, -0.6, BARS[CellState(states[0, x])], "none"))
    axes.axhline(0.7, color=INK, linewidth=0.8)
    axes.set(xlim=(0, CELLS), ylim=(-0.8, LAYERS), aspect="equal", xticks=[], yticks=[])


def _square(x: float, z: float, fill: str, edge: str) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((x, z), 1, 1, facecolor=fill, edgecolor=edge, linewidth=0.5)


def weighed(*, mapped: bool, hits: int, crossings: int) -> I32:
    """(hits, crossings) what the first lines say of one voxel that was hit and crossed so often: 0 nothing, 1 gone or
    new, 2 stands."""
    planes = np.zeros((TILE_CELLS, TILE_CELLS, WORDS), np.uint64)
    met, rays = np.arange(hits, dtype=np.uint64)[:, None], np.arange(crossings, dtype=np.uint64)[None, :]
    for counter, first in ((met, HIT), (rays, CROSSED)):
        for k in range(PLANES):
            planes[:hits, :crossings, first + k] = (counter >> np.uint64(k) & np.uint64(1)) << np.uint64(5)
    one = np.full((hits, crossings), np.uint64(1) << np.uint64(5))
    facts = Facts.none(one.shape)
    weigh_voxels(planes, Overlap(0, hits, 0, crossings, 0, 0), one if mapped else one * np.uint64(0), one, facts)
    said = (facts.gone | facts.new != 0) + 2 * (facts.stands != 0)
    return np.asarray(said, np.int32)


def draw_counts(axes: Any, *, mapped: bool) -> None:
    """One panel of lines 1 and 2."""
    hits, crossings = (6, 46) if mapped else (8, 14)
    changed = GONE if mapped else NEW
    fills = (EMPTY, changed, STANDING)
    for (h, c), said in np.ndenumerate(weighed(mapped=mapped, hits=hits, crossings=crossings)):
        axes.add_patch(_square(c, h, fills[said], "#ffffff"))
    axes.set(xlim=(0, crossings), ylim=(0, hits), xlabel="scans that crossed it", ylabel="that hit it")
    axes.tick_params(labelsize=7)


def main() -> None:
    out = sys.argv[1]
    figure = Figure((9.6, 9.2), dpi=80, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(4, 3).ravel()
    draw_counts(panels[0], mapped=True)
    draw_counts(panels[1], mapped=False)
    panels[0].set_title("1  a mapped voxel", fontsize=8.5, loc="left")
    panels[1].set_title("2  a free voxel", fontsize=8.5, loc="left")
    for axes, name in zip(panels[2:], SIDES, strict=False):
        draw_side(axes, name)
        axes.set_title(name, fontsize=8.5, loc="left")
    scans = [Patch(facecolor=fill, edgecolor=INK, label=said) for said, fill in COLOURS.items()]
    scans.append(Patch(facecolor="none", edgecolor=INK, label="mapped, nothing said"))
    cells = [Patch(facecolor=fill, label=state.name.lower().replace("_", " ")) for state, fill in BARS.items()]
    for axes, title, handles in ((panels[9], "scans say of a voxel", scans), (panels[10], "the rule: a cell", cells)):
        axes.axis("off")
        axes.legend(handles=handles, title=title, fontsize=8, title_fontsize=8.5, loc="upper left", frameon=False)
    panels[11].axis("off")
    figure.savefig(out)


if __name__ == "__main__":
    main()
