"""A street of four tiles, and a comparison of its votes tile by tile with its votes in blocks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hand_made import make_map, make_tile, wall
from mapvote.core.point_map import PointMap
from mapvote.rules.surfaces import SurfaceVoter
from mapvote.rules.voter import Counted


def long_street() -> PointMap:
    """Walls along it, with gaps."""
    rng = np.random.default_rng(1)
    walls = [(int(r), c) for r in range(60, 200, 20) for c in range(256) if rng.random() < 0.8]
    ground = [(r, c) for r in range(40, 200, 2) for c in range(0, 256, 2)]
    points = np.concatenate([wall(walls, [0.75, 1.05, 1.35]), wall(ground, [0.0])])
    return make_map({(0, c): make_tile(points, index=(0, c)) for c in range(4)})


def _arrays(votes: Counted) -> list[NDArray[Any]]:
    planes = votes.planes
    assert planes.states is not None
    assert planes.gone is not None
    assert planes.free is not None
    assert votes.log_odds is not None
    odds = votes.log_odds(np.zeros((0, 3), dtype=np.float32))
    return [planes.states, *planes.gone, *planes.free, votes.new, odds]


def blocks_say_the_same(voter: SurfaceVoter) -> None:
    """Votes of tiles judged one by one equal those of tiles judged in blocks."""
    whole = dict(voter.each())
    voter.judged = replace(voter.judged, side_tiles=1)
    by_blocks = dict(voter.each())
    assert list(by_blocks) == list(whole)
    changed = []
    for tile, votes in whole.items():
        for own, other in zip(_arrays(by_blocks[tile]), _arrays(votes), strict=True):
            np.testing.assert_array_equal(own, other, err_msg=f"{tile}")
        changed.append(int(np.isin(_arrays(votes)[0], (2, 3)).sum()))
    assert sum(changed) > 50, "there is something to compare"
