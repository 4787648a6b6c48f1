"""Columns as a voter: evidence per voxel over the drive, weighed at its end (docs/columns-v1.md)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from mapvote.config import VotingSettings
from mapvote.core.columns import dilated, outside
from mapvote.core.grid import TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.reference import bordered
from mapvote.core.types import U64
from mapvote.detection.evidence import free_words, near_hits
from mapvote.detection.voter import TileVotes
from mapvote.perception.frontend import Observation
from mapvote_lab.evaluation.columns_v1.blocks import blocks_and_around
from mapvote_lab.evaluation.columns_v1.counters import ColumnEvidence
from mapvote_lab.evaluation.columns_v1.judged import Judged
from mapvote_lab.evaluation.columns_v1.regions import apply_region_rules, beside_new
from mapvote_lab.evaluation.columns_v1.rules import ALL_RULES, Rules
from mapvote_lab.evaluation.columns_v1.tile_windows import around
from mapvote_lab.evaluation.columns_v1.weighing import weigh

WIDE_SIGMA_M = 0.1
"""A pose less certain than this makes a hit speak for two cells around it, not one."""


class ColumnVoter:
    """Columns: evidence per voxel over the drive, weighed at its end."""

    def __init__(
        self,
        voting: VotingSettings,
        point_map: PointMap,
        rules: Rules = ALL_RULES,
        evidence: ColumnEvidence | None = None,
    ) -> None:
        """``evidence``: counters that another voter fills (who may be the only one to observe), else its own."""
        self.voting, self.point_map, self.rules = voting, point_map, rules
        self.evidence = evidence or ColumnEvidence(point_map.lattice, rules.empty_by_ray, rules.hits_veto)

    def observe(self, seen: Observation) -> U64:
        """Count one scan; returns (rows, cols) words of voxels whose points may be new."""
        reach = 2 if seen.scan.sigma_m > WIDE_SIGMA_M else 1
        self.evidence.count(seen.view, seen.reference, reach, near_hits(seen)[0])
        return outside(seen.view.hit, seen.reference.occupied)

    def votes(self) -> dict[TileIndex, TileVotes]:
        """Every tile with evidence, in ascending order."""
        return dict(sorted(self.each()))

    def each(self) -> Iterator[tuple[TileIndex, TileVotes]]:
        """The same one by one, in an order of its own: a drive of many tiles is judged block by block
        (JOIN_CELLS, twice the halo and a speck are less than a tile)."""
        for wanted, tiles in blocks_and_around(self.evidence.tiles):
            yield from self._of_block(wanted, tiles)

    def _of_block(self, wanted: list[TileIndex], tiles: list[TileIndex]) -> Iterator[tuple[TileIndex, TileVotes]]:
        """The votes of the tiles ``wanted``, judged together with all of ``tiles``."""
        counters = {tile: self.evidence.tiles[tile] for tile in tiles}
        judged: dict[TileIndex, Judged] = {}
        for tile in tiles:
            found = self._judge(tile, counters)
            if found.weighed.tally.any():
                judged[tile] = found
        apply_region_rules(judged, self.point_map.lattice, self.rules)
        for tile in wanted:
            if tile in judged:
                yield tile, _votes_of(judged[tile], counters[tile])

    def _judge(self, tile: TileIndex, counters: Mapping[TileIndex, U64]) -> Judged:
        """What the tile's own evidence says, cell by cell."""
        lattice = self.point_map.lattice
        here, outer, known = bordered(self.point_map, lattice.tile(tile))
        near = dilated(outer.occupied, outer.base, 1)[1:-1, 1:-1]
        counts = around(lattice, counters, outer.grid, 0)
        low = here.top_z - here.ground_z < self.voting.min_height_m
        weighed = weigh(counts, outer.base, here.occupied, near, known, low, self.rules)
        crowded = beside_new(counts, outer.occupied, outer.base)[1:-1, 1:-1]
        return Judged(here, weighed, weighed.states(), crowded, np.zeros_like(weighed.gone))


def _votes_of(found: Judged, counters: U64) -> TileVotes:
    weighed, free = found.weighed, free_words(counters, found.here.occupied)
    if found.here.free is not None:
        free[found.here.free != 0] = 0
    return TileVotes(weighed.tally, found.states, weighed.gone, found.remnants, weighed.new, free)
