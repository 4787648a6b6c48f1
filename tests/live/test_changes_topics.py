"""What a vehicle votes on the road is seen in RViz: changes and states around it, and the map below them."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from live.loopback_dds import until
from live.test_ballot_messages import STREET, ballot
from mapvote.codec.ballot import Ballot
from mapvote.core.types import F64
from mapvote.formats.drives.point_fields import point_cloud_table
from mapvote.formats.drives.ros_types import CLOUD
from mapvote.live.ballot_messages import BallotTopic
from mapvote.live.changes_topics import ChangesTopics
from mapvote.live.dds import Network
from mapvote.live.messages import from_cdr
from mapvote.live.names import RosNames

pytest.importorskip("cyclonedds")
GRID = BallotTopic.STATES.kind
TOPICS = SimpleNamespace(map_frame="map")


def vehicle(place: F64, *tiles: tuple[int, int], drive_id: str = "day-001") -> Any:
    """A live drive of which these tiles went to the journal."""
    kept: deque[Ballot] = deque()
    for tile in tiles:
        (packed,) = ballot().tiles
        kept.append(msgspec.structs.replace(ballot(), tiles=[msgspec.structs.replace(packed, tile=tile)]))
    state = SimpleNamespace(point_map=STREET)
    return SimpleNamespace(kept=kept, vehicle=state, drive_id=drive_id, place=place, prior_in_map=True)


def test_the_tiles_around_the_vehicle_are_published_and_those_behind_it_are_not(domain: int) -> None:
    shown = ChangesTopics(Network(domain), RosNames())
    network = Network(domain)
    cloud = network.subscribe("/mapvote/changes", CLOUD, reliable=True)
    grid = network.subscribe("/mapvote/states", GRID, reliable=True)
    below = network.subscribe("/mapvote/map", CLOUD, reliable=True, transient_local=True)
    until(lambda: all(out.readers for out in shown._out.values()))

    shown(vehicle(np.array([40.0, 40.0, 2.0]), (0, 0)), TOPICS)  # type: ignore[arg-type]
    (_, data), *_ = until(cloud.take)
    table = point_cloud_table("changes", from_cdr(CLOUD, data))
    assert sorted(set(table["change"].tolist())) == [1, 2]
    (_, data), *_ = until(below.take)
    assert from_cdr(CLOUD, data).width == STREET.n_points
    (_, data), *_ = until(grid.take)
    assert from_cdr(GRID, data).info.width == 256

    shown(vehicle(np.array([400.0, 40.0, 2.0]), (0, 5)), TOPICS)  # type: ignore[arg-type]
    (_, data), *_ = until(grid.take)
    message = from_cdr(GRID, data)
    assert (message.info.width, round(message.info.origin.position.x, 1)) == (256, 384.0)


def test_nothing_is_sent_while_nothing_was_voted_or_nobody_listens(domain: int) -> None:
    shown = ChangesTopics(Network(domain), RosNames())
    sent: list[Any] = []
    shown._send = sent.append  # type: ignore[method-assign, assignment]
    shown(vehicle(np.zeros(3)), TOPICS)  # type: ignore[arg-type]
    shown(vehicle(np.zeros(3), (0, 0)), TOPICS)  # type: ignore[arg-type]
    assert sent == []


def test_a_new_ballot_begins_with_nothing(domain: int) -> None:
    shown = ChangesTopics(Network(domain), RosNames())
    shown(vehicle(np.zeros(3), (0, 0)), TOPICS)  # type: ignore[arg-type]
    shown(vehicle(np.zeros(3), (0, 1), drive_id="day-002"), TOPICS)  # type: ignore[arg-type]
    assert set(shown._tiles) == {(0, 1)}
