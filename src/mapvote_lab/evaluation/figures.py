"""Pictures from above and charts in the manner of the paper's Figures 2-8, and Table IV as bars.

Points are drawn from far to near into an image with a depth buffer; edges of depth are darkened (eye-dome lighting,
Boucheny 2009), which makes a cloud without normals readable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from scipy import ndimage

from mapvote import plots as style
from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.types import F32, F64, U8, Bool, CellState
from mapvote.core.voting import vote_weight
from mapvote_lab.evaluation.scores import NEIGHBOURS, PAPER_F1, CaseResult, Reliability, cells_with


@dataclass(frozen=True, slots=True)
class Camera:
    """Looks at ``target`` (x, y, z), map metres, from ``distance_m`` away, from bearing ``azimuth_deg`` (0 = from +x,
    90 = from +y), ``elevation_deg`` above the horizon."""

    target: tuple[float, float, float]
    distance_m: float
    azimuth_deg: float
    elevation_deg: float = 32.0
    fov_deg: float = 42.0
    """From the left to the right edge."""
    width: int = 1400
    """Columns of the image."""
    height: int = 800
    """Rows of the image."""

    @property
    def focal(self) -> float:
        """Pixels from the centre of the image per metre beside the axis, 1 m away."""
        return float(0.5 * self.width / np.tan(np.radians(0.5 * self.fov_deg)))

    def project(self, points: F64) -> tuple[F64, F64]:
        """(pixels (n, 2) as x right and y down, depth (n,) metres in front of the camera)."""
        a = np.radians(self.azimuth_deg)
        e = np.radians(self.elevation_deg)
        back = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        up = np.cross(back, right)
        from_camera = points - (np.asarray(self.target) + self.distance_m * back)
        depth = -(from_camera @ back)
        scale = self.focal / np.maximum(depth, 0.1)
        pixels = np.column_stack(
            [0.5 * self.width + (from_camera @ right) * scale, 0.5 * self.height - (from_camera @ up) * scale]
        )
        return pixels, depth


def shades(height: F64) -> F32:
    """(n, 3) grey-blue by height above ground (n,), metres: pale ground, darker walls."""
    share = np.clip((height[:, None] - 0.2) / 9.0, 0.0, 1.0)
    low = np.array(to_rgb("#a9b8c4"))
    high = np.array(to_rgb("#33506a"))
    colours = low + (high - low) * share
    colours[height < 0.3] = to_rgb("#d3dade")
    return colours.astype(np.float32)


def render(points: F64, colours: F32, camera: Camera, size_m: float = 0.2) -> U8:
    """(height, width, 4) opaque image of points (n, 3) in their ``colours`` (n, 3), each a square of ``size_m``.

    Bytes with a fourth channel: matplotlib resamples them as float32, an image without one as float64."""
    most = 9  # pixels of the side of a square
    # The nearest point of each pixel, in an image with a margin: the squares of the others lie behind its square.
    pixels, depth = camera.project(points)
    rows, cols = camera.height + 2 * most, camera.width + 2 * most
    x, y = np.floor(pixels.T).astype(np.int64) + most
    order = np.argsort(-depth, kind="stable")
    order = order[((depth > 1.0) & (x >= 0) & (x < cols) & (y >= 0) & (y < rows))[order]]
    nearest = np.full(rows * cols, -1)
    nearest[(y * cols + x)[order]] = order
    nearest = nearest[nearest >= 0]
    depth = depth[nearest].astype(np.float32)
    # Sizes fall into few groups; far ones first, so that nearer points overwrite.
    sizes = np.clip(np.ceil(size_m * camera.focal / depth), 2, most).astype(np.int64)
    corner = (y * cols + x)[nearest] - (sizes // 2) * (cols + 1)
    drawn = np.full((rows + most) * cols, -1)
    depths = np.full(len(drawn), np.inf, dtype=np.float32)
    for size in np.unique(sizes):
        chosen = np.flatnonzero(sizes == size)
        for offset in (np.arange(size)[:, None] * cols + np.arange(size)).ravel():
            at = corner[chosen] + offset
            nearer = depth[chosen] <= depths[at]
            drawn[at[nearer]] = chosen[nearer]
            depths[at[nearer]] = depth[chosen][nearer]
    # Without the margin, in colour.
    inside = np.s_[most : most + camera.height, most : most + camera.width]
    drawn = drawn.reshape(-1, cols)[inside]
    image = np.where((drawn >= 0)[..., None], colours[nearest[drawn]], np.float32(1.0))
    image *= _eye_dome(depths.reshape(-1, cols)[inside])[..., None]
    opaque = np.full((camera.height, camera.width, 4), 255, dtype=np.uint8)
    opaque[..., :3] = np.rint(255.0 * image)
    return opaque


def _eye_dome(depth: F32, radius: int = 2, strength: float = 2.2) -> F32:
    """(rows, cols) factor in (0, 1]: darker where neighbours are nearer."""
    log_depth = np.log(np.where(np.isfinite(depth), depth, 1e4))
    occlusion = np.zeros(depth.shape, dtype=np.float32)
    for dr, dc in ((-radius, 0), (radius, 0), (0, -radius), (0, radius)):
        neighbour = np.roll(log_depth, (dr, dc), axis=(0, 1))
        occlusion += np.clip(log_depth - neighbour, 0.0, 0.12)
    out: F32 = np.exp(-strength * occlusion).astype(np.float32)
    out[~np.isfinite(depth)] = 1.0
    return out


def draw(
    panels: Sequence[tuple[str, F64, F32]],
    camera: Camera,
    *,
    paths: Sequence[tuple[str, F64]] = (),
    legend: Sequence[tuple[str, str]] = (),
    size_m: float = 0.2,
) -> Figure:
    """Panels (title, points (n, 3), colours (n, 3)) from one camera; ``paths`` of vehicles (name, points (m, 3))."""
    width = 13.0
    figure, axes = style.new_figure(width, 0.62 * width / len(panels) + 0.6, 1, len(panels))
    for axis, (title, points, colours) in zip(axes[0], panels, strict=True):
        axis.imshow(render(points, colours, camera, size_m), interpolation="antialiased")
        for i, (_, path) in enumerate(paths):
            pixels, depth = camera.project(path)
            seen = depth > 2.0
            axis.plot(*pixels[seen].T, color=style.VEHICLE_COLOURS[i % 8], lw=2.0, solid_capstyle="round")
        axis.set_xlim(0, camera.width)
        axis.set_ylim(camera.height, 0)
        axis.set_title(title, loc="left")
        axis.set_xticks([])
        axis.set_yticks([])
    handles = [Line2D([], [], marker="s", ls="", color=colour, label=name, markersize=7) for name, colour in legend]
    handles += [
        Line2D([], [], color=style.VEHICLE_COLOURS[i % 8], lw=2, label=name) for i, (name, _) in enumerate(paths)
    ]
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False)
    return figure


Outline = tuple[str, F64]
"""Kind ("built" or "demolished") and footprint corners (m, 2), map metres."""


def _extent(grid: Grid) -> tuple[float, float, float, float]:
    return grid.x0, grid.x0 + grid.cols * CELL_SIZE, grid.y0, grid.y0 + grid.rows * CELL_SIZE


def _from_above(points: F64, height: F64, grid: Grid) -> np.ndarray:
    """(rows, cols, 3): highest point of each cell as a shade; white where there is none."""
    rows, cols, inside = grid.indices_of(points)
    top = np.full(grid.shape, -np.inf)
    np.maximum.at(top, (rows[inside], cols[inside]), height[inside])
    seen = np.isfinite(top)
    share = np.clip(top / 10.0, 0.0, 1.0)[..., None]
    share[~seen] = 0.0
    low = np.array([0.83, 0.86, 0.89])
    high = np.array([0.16, 0.25, 0.34])
    image = low + (high - low) * np.sqrt(share)
    image[~seen] = 1.0
    return image


def _thicken(cells: Bool) -> Bool:
    """A cell of a long street is finer than a pixel: a change is drawn one cell wider there, so that it is not lost."""
    return ndimage.binary_dilation(cells, NEIGHBOURS) if cells.shape[1] > 900 else cells


def _panel(axis: Any, image: np.ndarray, grid: Grid, title: str, **how: Any) -> None:
    axis.imshow(image, origin="lower", extent=_extent(grid), interpolation="nearest", **how)
    axis.autoscale(False)
    axis.set_title(title, loc="left")
    axis.set_ylabel("y (m)")


def _outline(axis: Any, outlines: Sequence[Outline]) -> None:
    for kind, corners in outlines:
        colour = style.Colour.NEW if kind == "built" else style.Colour.GONE
        away = corners - corners.mean(axis=0)
        corners = corners + 1.5 * np.sign(away)  # beside the walls, not over them
        axis.add_patch(Polygon(corners, closed=True, fill=False, edgecolor=colour, lw=1.2, ls=(0, (4, 2))))


def _stack(grid: Grid, panels: int, width: float = 13.0) -> tuple[Figure, Any]:
    shape = grid.rows / grid.cols
    side_by_side = shape > 0.5
    if side_by_side:
        return style.new_figure(width, width / panels * shape + 1.1, 1, panels)
    return style.new_figure(width, (width * 0.93 * shape + 0.55) * panels + 0.7, panels, 1, sharex=True)


def street(
    old: tuple[F64, F64],
    updated: tuple[F64, F64],
    added: F64,
    deleted: F64,
    grid: Grid,
    *,
    outlines: Sequence[Outline] = (),
    areas: Sequence[tuple[str, F64]] = (),
    paths: Sequence[tuple[str, F64]] = (),
) -> Figure:
    """The street from above (Figure 6): the old map with the deleted points, the new one with the added points.

    ``old`` and ``updated``: points (n, 3), map metres, and their heights above ground (n,); ``areas`` (name,
    corner-to-corner (2, 2) box); ``paths`` of vehicles (name, (m, 3)).
    """
    figure, axes = _stack(grid, 2)
    axes = axes.ravel()
    for axis, (points, height), marked, colour, title in (
        (axes[0], old, deleted, style.Colour.GONE, "(a) First map, deleted points in blue"),
        (axes[1], updated, added, style.Colour.NEW, "(b) Updated map, added points in red"),
    ):
        image = _from_above(points, height, grid)
        image[_thicken(cells_with(marked, grid))] = to_rgb(colour)
        _panel(axis, image, grid, title)
        _outline(axis, outlines)
        for name, box in areas:
            axis.text(*box[1], f" {name}", va="top", ha="right", fontsize=8.5, color=style.Colour.INK)
            corners = [box[0], (box[1][0], box[0][1]), box[1], (box[0][0], box[1][1])]
            axis.add_patch(Polygon(corners, closed=True, fill=False, edgecolor=style.Colour.FAINT, lw=0.9))
    for i, (_, path) in enumerate(paths):
        axes[1].plot(path[:, 0], path[:, 1], color=style.VEHICLE_COLOURS[i % 8], lw=1.0)
    axes[-1].set_xlabel("x (m)")
    handles: list[Any] = [
        Patch(facecolor=style.Colour.GONE, label="deleted"),
        Patch(facecolor=style.Colour.NEW, label="added"),
        Line2D([], [], color=style.Colour.GONE, ls="--", label="truth: demolished"),
        Line2D([], [], color=style.Colour.NEW, ls="--", label="truth: built"),
    ]
    handles += [Line2D([], [], color=style.VEHICLE_COLOURS[i % 8], label=name) for i, (name, _) in enumerate(paths)]
    figure.legend(handles=handles, loc="outside lower center", ncols=7, frameon=False)
    return figure


def cell_states(panels: Sequence[tuple[str, U8]], grid: Grid, *, outlines: Sequence[Outline] = ()) -> Figure:
    """Grids of states (Figures 2 and 3), each over ``grid``."""
    figure, axes = _stack(grid, len(panels))
    for axis, (title, states) in zip(axes.ravel(), panels, strict=True):
        image = style.state_image(states)
        for change in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
            image[_thicken(states == change)] = change
        _panel(axis, image, grid, title, cmap=style.state_map(), vmin=-0.5, vmax=len(CellState) + 0.5)
        _outline(axis, outlines)
    for axis in axes[-1]:
        axis.set_xlabel("x (m)")
    handles = [
        Patch(facecolor=style.STATE_COLOURS[s], edgecolor=style.Colour.FAINT, label=style.STATE_NAMES[s])
        for s in CellState
    ]
    handles.append(Patch(facecolor=style.Colour.WHITE, edgecolor=style.Colour.FAINT, label="never seen"))
    figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False)
    return figure


def vote_curve(a: float, b: float, k: float, n_min: int) -> Figure:
    """Votes per scan of an occupied cell against its points, Eq. (1) (Figure 4)."""
    figure, axes = style.new_figure(6.2, 3.4)
    axis = axes[0, 0]
    n = np.arange(n_min, 31)
    axis.plot(n, vote_weight(n, a, b, k, n_min), color=style.Colour.STANDING, lw=1.8, marker="o", ms=3.5)
    axis.hlines(0, 0, n_min - 1, color=style.Colour.UNSURE, lw=3)
    axis.annotate(f"fewer than {n_min} points:\nnot occupied", (n_min - 1, 0), (8, 0.45), fontsize=9,
                  arrowprops={"arrowstyle": "-", "color": style.Colour.FAINT})  # fmt: skip
    axis.axhline(b, color=style.Colour.FAINT, lw=0.8, ls=":")
    axis.set_xlim(0, 30)
    axis.set_ylim(-0.1, 1.1 * b)
    axis.set_xlabel("measurement points n in the cell")
    axis.set_ylabel("votes w(n)")
    axis.set_title(loc="left", label=f"w(n) = a + (b − a)(1 − exp(−k (n − {n_min}))),  a = {a:g}, b = {b:g}, k = {k:g}")
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def score_bars(cases: Mapping[str, CaseResult], names: Mapping[str, str]) -> Figure:
    """Table IV as bars: macro F1 of ``cases`` in both truths, the paper's beside it."""
    shown = list(cases)
    figure, axes = style.new_figure(max(7.5, 0.95 * len(shown) + 1.5), 4.0)
    axis = axes[0, 0]
    series: list[tuple[str, str, list[float | None]]] = [
        ("paper, Table IV", style.Colour.EMPTY, [PAPER_F1.get(case) for case in shown]),
        ("ours, strict truth", style.Colour.STANDING, [cases[case].strict.macro_f1 for case in shown]),
        ("ours, provenance truth", "#a3b6c6", [cases[case].provenance.macro_f1 for case in shown]),
    ]
    for k, (label, colour, values) in enumerate(series):
        x = np.array([i + 0.27 * (k - 1) for i, v in enumerate(values) if v is not None])
        y = np.array([v for v in values if v is not None])
        axis.bar(x, y, width=0.25, color=colour, edgecolor=style.Colour.FAINT if k == 0 else "none", label=label)
        for xi, yi in zip(x, y, strict=True):
            axis.text(xi, yi + 0.01, f"{yi:.2f}".lstrip("0") if yi < 1 else "1.00", ha="center", fontsize=7.5)
    axis.set_xticks(range(len(shown)), [names.get(case, case).replace(", ", ",\n") for case in shown])
    axis.set_ylim(0, 1.08)
    axis.set_ylabel("F1, mean of the three classes")
    axis.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    return figure


def reliability_diagram(by_state: Mapping[CellState, Reliability]) -> Figure:
    """Predicted probability against the share that did change, a panel for each kind; below, how many cells."""
    figure, axes = style.new_figure(8.2, 4.9, 2, len(by_state), height_ratios=(3, 1), sharex=True, sharey="row")
    for column, (state, one) in zip(axes.T, by_state.items(), strict=True):
        colour, marker = (style.Colour.NEW, "D") if state == CellState.CHANGED_OCCUPIED else (style.Colour.GONE, "X")
        there = one.cells > 0
        column[0].plot([0, 1], [0, 1], color=style.Colour.FAINT, lw=0.9, ls="--")
        column[0].vlines(one.predicted[there], one.predicted[there], one.true[there], color=colour, lw=0.9)
        column[0].plot(one.predicted[there], one.true[there], marker, color=colour, ms=7)
        title = f"{style.STATE_NAMES[state]}, {int(one.cells.sum()):,} cells\n"
        column[0].set_title(f"{title}calibration error {one.calibration_error:.3f}, Brier {one.brier:.3f}", loc="left")
        width = 1.0 / len(one.cells)
        column[1].bar((np.arange(len(one.cells)) + 0.5) * width, one.cells, 0.9 * width, color=colour)
        column[1].set_xlabel("stated probability")
        column[1].set_xlim(0, 1)
        for axis in column:
            axis.grid(alpha=0.25, lw=0.6)
            axis.set_axisbelow(True)
            axis.spines[["top", "right"]].set_visible(False)
    axes[0, 0].set_ylim(-0.03, 1.03)
    axes[0, 0].set_ylabel("share that did change")
    axes[1, 0].set_ylabel("cells")
    return figure
