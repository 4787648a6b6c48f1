"""Two ways to count a drive, one interface: the paper's votes per scan, and columns of evidence (METHOD 4).

A voter takes in scan after scan and gives, tile by tile, the same thing: a tally, and what would go and come.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapvote.config import VotingSettings
from mapvote.core.point_map import PointMap
from mapvote.core.sensors import Sensor
from mapvote.core.types import U64
from mapvote.detection.columns import ColumnVoter
from mapvote.detection.counters import Evidence
from mapvote.detection.paper import PaperVoter
from mapvote.detection.votes import Observation

Voter = PaperVoter | ColumnVoter


class Detectors:
    """The voters of one vehicle, by their settings. Voters that count alike share their counters."""

    def __init__(self, votings: Sequence[VotingSettings], sensor: Sensor, point_map: PointMap) -> None:
        self._evidence: dict[tuple[bool, bool, float], Evidence] = {}
        self.voters: dict[VotingSettings, Voter] = {}
        for voting in votings:
            if voting.method == "columns":
                by_ray, veto = "A" in voting.rules, "B" in voting.rules
                fresh = Evidence(point_map.lattice, by_ray, veto)
                evidence = self._evidence.setdefault((by_ray, veto, voting.wide_sigma_m), fresh)
                self.voters[voting] = ColumnVoter(voting, point_map, evidence)
            else:
                self.voters[voting] = PaperVoter(voting, sensor, point_map)

    def add(self, seen: Observation) -> U64:
        """One scan for every voter; returns (rows, cols) words of voxels whose points may be new for any of them."""
        for (_, _, wide_sigma_m), evidence in self._evidence.items():
            evidence.add(seen.view, seen.reference, reach=2 if seen.sigma_m > wide_sigma_m else 1)
        new = np.zeros(seen.view.grid.shape, dtype=np.uint64)
        for voter in self.voters.values():
            new |= voter.add(seen)
        return new
