"""Two ways to count a drive, one interface: the paper's votes per scan, and surfaces."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from mapvote.config import Settings
from mapvote.core.grid import TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.sensors import Sensor
from mapvote.core.types import U64
from mapvote.detection.paper import PaperVoter
from mapvote.detection.votes import TileVotes
from mapvote.perception.frontend import Observation


class Voter(Protocol):
    """:class:`PaperVoter` or a ``SurfaceVoter``: scan after scan goes in, votes come out tile by tile."""

    def observe(self, seen: Observation) -> U64:
        """Take in one scan; returns (rows, cols) words of the voxels of its view whose points may be new."""

    def votes(self) -> dict[TileIndex, TileVotes]:
        """What the scans so far amount to, of every tile that they say anything of, in ascending order. Asking changes
        nothing."""

    def each(self) -> Iterator[tuple[TileIndex, TileVotes]]:
        """The same tile by tile, in any order: so that no drive is too long for memory."""


def make_voter(settings: Settings, sensor: Sensor, point_map: PointMap) -> Voter:
    """The voter that ``voting.method`` names."""
    if settings.voting.method == "surfaces":
        from mapvote.detection.surfaces import (
            SurfaceVoter,  # brings half of scipy, which the paper's rule needs nothing of
        )

        return SurfaceVoter(settings.voting, point_map)
    return PaperVoter(settings.voting, settings.paper, sensor, point_map)
