"""Topics of the votes of a vehicle on the road, for RViz: changed points, states of cells, and the map below them."""

from __future__ import annotations

import logging

import msgspec
import numpy as np

from mapvote.codec.ballot import Ballot, BallotTile
from mapvote.core.grid import TileIndex
from mapvote.core.point_map import PointMap
from mapvote.core.types import F64, MapvoteError
from mapvote.live.ballot_messages import BALLOT_VIEW, BallotTopic, BallotView, Stamped, map_cloud, messages_of_ballot
from mapvote.live.dds import Network, Publication
from mapvote.live.drive import LiveDrive
from mapvote.live.log_lines import Repeated
from mapvote.live.messages import MAP_FRAME
from mapvote.live.names import RosNames
from mapvote.live.subscriptions import Subscriptions

log = logging.getLogger("mapvote.live")


class ChangesTopics:
    """Publishes what the open ballot says of the tiles around the vehicle, as each goes to the journal. Nothing is
    computed without a subscriber."""

    def __init__(self, network: Network, names: RosNames, view: BallotView = BALLOT_VIEW) -> None:
        self._view = view
        self._tiles: dict[TileIndex, BallotTile] = {}
        self._drive_id = ""
        self._newest: Ballot | None = None
        self._mapped: frozenset[TileIndex] = frozenset()
        self._repeated = Repeated(log.warning)
        self._out: dict[str, Publication] = {
            topic: network.publish(
                names.resolve(topic), topic.kind, transient_local=topic is BallotTopic.MAP, patience_s=0.0
            )
            for topic in (BallotTopic.CHANGES, BallotTopic.STATES, BallotTopic.MAP)
        }

    def __call__(self, live: LiveDrive, topics: Subscriptions) -> None:
        """Called some times a second."""
        if not live.kept or live.vehicle is None:
            return
        if live.drive_id != self._drive_id:
            self._drive_id = live.drive_id
            self._tiles.clear()
        while live.kept:
            self._newest = live.kept.popleft()
            self._tiles |= {tile.tile: tile for tile in self._newest.tiles}
        point_map = live.vehicle.point_map
        self._forget_far(live.place, point_map)
        if not any(out.readers for out in self._out.values()) or self._newest is None or not self._tiles:
            return
        shown = msgspec.structs.replace(self._newest, tiles=list(self._tiles.values()), path=None)
        frame = topics.map_frame if live.prior_in_map and topics.map_frame else MAP_FRAME
        for message in messages_of_ballot(shown, point_map, frame):
            self._send(message)
        if frozenset(self._tiles) != self._mapped:
            self._mapped = frozenset(self._tiles)
            self._send(map_cloud(shown, point_map, frame))

    def _forget_far(self, place: F64 | None, point_map: PointMap) -> None:
        """Leave out the tiles that the vehicle has left behind."""
        if place is None:
            return
        for tile in list(self._tiles):
            x, y = point_map.lattice.tile(tile).centres()
            if np.hypot(x.mean() - place[0], y.mean() - place[1]) > self._view.near_m:
                del self._tiles[tile]

    def _send(self, message: Stamped) -> None:
        """A message that a slow reader does not take is dropped: no reader delays the drive."""
        try:
            self._out[message.topic].send(message.data)
        except MapvoteError as error:
            self._repeated("changes", str(error))
