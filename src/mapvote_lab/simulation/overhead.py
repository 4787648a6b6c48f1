"""Objects over a street: wires, foot-bridges, boards, viaducts and crowns, of which no drive sees the support."""

from __future__ import annotations

import numpy as np

from mapvote.core.types import F64
from mapvote_lab.simulation.scenario import Overhead
from mapvote_lab.simulation.shapes import box, foliage, join, place

FACADES_M = 16.5
"""Wires and brackets reach so far from the road's axis, metres: into every facade of the front row."""


def wires() -> F64:
    """Three wires across the street, y from facade to facade."""
    return join([box(x - 0.03, x + 0.03, -FACADES_M, FACADES_M, z, z + 0.06) for x, z in ((0, 5.6), (1, 6.2), (2, 7))])


def bridge() -> F64:
    """The deck of a foot-bridge with its parapets, y from sidewalk to sidewalk; its piers are out of sight."""
    parapets = [box(x - 0.05, x + 0.05, -11.5, 11.5, 5.3, 6.4) for x in (-1.25, 1.25)]
    return join([box(-1.25, 1.25, -11.5, 11.5, 5.0, 5.3), *parapets])


def board() -> F64:
    """A board along the sidewalk, 3 m long, on a bracket in its middle that reaches into the facade at y > 0."""
    return join([box(-1.5, 1.5, 11.8, 11.95, 4.2, 5.4), box(-0.05, 0.05, 11.95, FACADES_M, 4.7, 4.9)])


def over_house(house: F64, rng: np.random.Generator) -> dict[str, F64]:
    """By kind what hangs over a house (n, 3, 3), map metres, a metre and more above its top: a crown over the front, a
    wire and the deck of a viaduct along the street, both 8 m longer than the house on either side."""
    low = house.reshape(-1, 3).min(axis=0)
    high = house.reshape(-1, 3).max(axis=0)
    middle = 0.5 * (low + high)
    top = high[2]
    long = low[0] - 8.0, high[0] + 8.0
    crown = foliage(rng, (2.2, 2.2, 1.4), 0.0, 400, 0.28)
    return {
        "crown": place(crown, middle[0], middle[1], top + 2.8),
        "wire": box(*long, low[1] - 0.03, low[1] + 0.03, top + 1.2, top + 1.26),
        "bridge": box(*long, middle[1] + 1.0, middle[1] + 4.0, top + 1.5, top + 2.1),
    }


def across(overhead: Overhead) -> list[tuple[str, F64, float, int]]:
    """(kind, triangles about the road's axis, metres along the street, side: 1 or -1 for y) of all but what hangs over
    houses."""
    made = [("wire", wires(), s, 1) for s in overhead.wire_m]
    made += [("bridge", bridge(), s, 1) for s in overhead.bridge_m]
    return made + [("board", board(), s, side) for s in overhead.board_m for side in (1, -1)]
