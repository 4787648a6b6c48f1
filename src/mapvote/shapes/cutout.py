"""Changes with their surroundings, before and after, as one HTML file without any request."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np

from mapvote.core.grid import TILE_CELLS, Grid, Lattice, TileIndex
from mapvote.core.record import record
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64
from mapvote.core.voxels import found_among
from mapvote.shapes.geojson import ChangeFacts, ChangeFeature
from mapvote.shapes.packed_cloud import SIDE_M, cloud_bytes, pack


@record()
@dataclass(frozen=True, slots=True)
class CutoutSizes:
    """Sizes of a cloud that is cut out around a change."""

    around_m: float = 10.0
    """Distance from the change up to which points are shown, metres."""
    points: int = 60_000
    """Points of one change at most: half a megabyte."""


CUTOUT_SIZES = CutoutSizes()
Tiles = Callable[[TileIndex], Tile]
Box = tuple[float, float, float, float]
"""x0, y0, x1, y1, map metres."""


Cutout = dict[str, Any]
"""The points around a change, for the page: "name", "facts"; "x" and "y" of the lower-left corner and the "box" of the
change itself in map metres, its "height"; and the clouds "kept", "removed" and "added", each as
:func:`mapvote.shapes.packed_cloud.cloud_bytes` in base64."""


def cut_out(name: str, facts: str, box: Box, height_m: float, tiles: tuple[Tiles, Tiles], lattice: Lattice) -> Cutout:
    """The cloud within 10 m of a box (x0, y0, x1, y1), map metres, from the tiles before and after.

    At most 76.8 m of it, and 60,000 points evenly.
    """
    corner = lattice.cell_of(box[0] - CUTOUT_SIZES.around_m, box[1] - CUTOUT_SIZES.around_m)
    window = Grid(lattice, *corner, TILE_CELLS, TILE_CELLS)
    far = np.array([box[2] + CUTOUT_SIZES.around_m, box[3] + CUTOUT_SIZES.around_m]) - [window.x0, window.y0]
    ground = np.full(window.shape, np.nan, dtype=np.float32)
    points_of: dict[str, list[F32]] = {"kept": [], "removed": [], "added": []}
    for index in window.tiles():
        before, after = (look(index) for look in tiles)
        common = before.window.intersection(window)
        ground_z = np.where(np.isnan(after.ground_z), before.ground_z, after.ground_z)
        ground[common.slices_in(window)] = ground_z[common.slices_in(before.window)]
        gone = ~found_among(before.points, after.points)
        come = ~found_among(after.points, before.points)
        for kind, points in (
            ("kept", after.points_map[~come]),
            ("removed", before.points_map[gone]),
            ("added", after.points_map[come]),
        ):
            points_of[kind].append(_inside(points, window, far))
    clouds = {kind: cloud_bytes(*pack(_thinned(np.concatenate(parts)), ground)) for kind, parts in points_of.items()}
    view = {"name": name, "facts": facts, "x": window.x0, "y": window.y0, "box": box, "height": height_m}
    return view | {kind: base64.b64encode(cloud).decode() for kind, cloud in clouds.items()}


def of_feature(feature: ChangeFeature, tiles: tuple[Tiles, Tiles], lattice: Lattice) -> Cutout:
    """The cutout of a change."""
    change = feature.properties
    kind = (
        "Built" if change.kind == "built" else "Trimmed beside what stands" if _only_trimmed(change) else "Demolished"
    )
    votes = f"{change.votes_median:g} votes for it, {change.against_median:g} against"
    if not change.versions:
        votes = "no votes: a rollback or replay took a decision back"
    facts = f"{change.area_m2:.1f} m², {change.height_m:.1f} m high, {change.points} points; {votes}"
    (x0, y0), (x1, y1) = change.box
    name = f"{kind} at {0.5 * (x0 + x1):.0f}, {0.5 * (y0 + y1):.0f}"
    return cut_out(name, facts, (x0, y0, x1, y1), change.height_m, tiles, lattice)


def _only_trimmed(change: ChangeFacts) -> bool:
    return change.trimmed == change.cells


def fragment(cutouts: Sequence[Cutout]) -> str:
    """HTML to insert into a page: a 3D view of the changes, one at a time. It makes no request."""
    if not cutouts:
        return "<p>Nothing is gone and nothing is new: there is no change to show.</p>"
    viewer = resources.files("mapvote.shapes") / "viewer"
    names = ("shaders.js", "orbit.js", "cloud.js", "standalone.js")
    modules = {
        name: (viewer / name).read_text() for name in ("vendor/three.core.min.js", "vendor/three.module.min.js", *names)
    }
    return (
        f"<style>{(viewer / 'standalone.css').read_text()}</style>"
        '<div class="cutouts"><div class="stage">'
        '<canvas tabindex="0" aria-label="The cloud. Drag to turn it, arrow keys move."></canvas></div>'
        '<p class="row" role="group" aria-label="Which change"></p>'
        '<p class="row" role="group" aria-label="Before or after"></p><p class="told"></p></div>'
        f'<script type="application/json" id="cutouts">{_safe(cutouts)}</script>'
        f'<script type="application/json" id="modules">{_safe(modules)}</script>'
        f'<script type="module">{(viewer / "bundle.js").read_text()}</script>'
    )


def whole_page(title: str, cutouts: Sequence[Cutout]) -> str:
    """One self-contained HTML file."""
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(title)}</title></head><body><main><h1>{html.escape(title)}</h1>{fragment(cutouts)}"
        "</main></body></html>\n"
    )


def _safe(value: Any) -> str:
    """JSON that is safe inside a script element."""
    return json.dumps(value, ensure_ascii=True).replace("<", "\\u003c")


def _inside(points: F64, window: Grid, far: F64) -> F32:
    local = points - np.array([window.x0, window.y0, 0.0])
    within = (local[:, :2] >= 0).all(axis=1) & (local[:, :2] < np.minimum(far, SIDE_M)).all(axis=1)
    return local[within].astype(np.float32)


def _thinned(points: F32) -> F32:
    if len(points) <= CUTOUT_SIZES.points:
        return points
    return points[np.sort(np.random.default_rng(0).permutation(len(points))[: CUTOUT_SIZES.points])]
