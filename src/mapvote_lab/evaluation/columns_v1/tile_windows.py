"""What the cells of a drive say together, over all its tiles (docs/method.md).

Roofs fall with their walls. Each rule looks at a tile with some cells of its neighbours around it, so that what lies
across an edge is judged alike from both sides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mapvote.core.grid import Grid, Lattice, TileIndex

HALO = 64
"""Cells around a tile that are looked at: 19 m, a house."""
Plane = Any
"""An array of one tile or window, of any type."""


def beyond_tiles(
    lattice: Lattice, halo: int, rule: Callable[..., Plane], *planes: tuple[Mapping[TileIndex, Plane], int]
) -> dict[TileIndex, Plane]:
    """``rule`` of ``planes``, tile by tile with ``halo`` cells around it, cut back to the tile. Each plane comes with
    what it is where there is no tile. Nothing changes until all tiles are through."""
    out = {}
    for tile in planes[0][0]:
        wide = lattice.tile(tile).padded(halo)
        near = [around(lattice, plane, wide, elsewhere) for plane, elsewhere in planes]
        out[tile] = rule(*near)[halo:-halo, halo:-halo]
    return out


def around(lattice: Lattice, planes: Mapping[TileIndex, Plane], wide: Grid, elsewhere: int) -> Plane:
    """The planes of several tiles as one window ``wide``; ``elsewhere`` where there is no tile."""
    first = next(iter(planes.values()))
    out = np.full((*wide.shape, *first.shape[2:]), elsewhere, dtype=first.dtype)
    for tile in wide.tiles():
        if tile in planes:
            grid = lattice.tile(tile)
            common = grid.intersection(wide)
            out[common.slices_in(wide)] = planes[tile][common.slices_in(grid)]
    return out
