"""A ballot as a recording of Rerun (extra ``rerun``): the map, points that come and go, and the road driven."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mapvote.core.extras import require
from mapvote.core.types import MapvoteError
from mapvote.formats.drives.point_fields import point_cloud_table
from mapvote.formats.drives.ros_types import CLOUD
from mapvote.live.ballot_messages import BallotTopic, Stamped
from mapvote.live.messages import from_cdr


def write_rrd(path: Path, messages: Sequence[Stamped]) -> None:
    """A .rrd file of a ballot's messages, but for its grid of states. MapvoteError without rerun-sdk, or if it cannot
    be written."""
    rerun = require("rerun", "rerun", str(path))
    try:
        path.touch()
    except OSError as error:
        raise MapvoteError(f"{path}: cannot be written ({error.strerror}); choose another place") from error
    recording = rerun.RecordingStream("mapvote")
    recording.save(path)
    for message in messages:
        if message.topic is BallotTopic.STATES:
            continue
        shown = from_cdr(message.topic.kind, message.data)
        if message.topic.kind == CLOUD:
            table = point_cloud_table(message.topic, shown)
            points = np.column_stack([table[axis] for axis in "xyz"])
            colours = np.full(len(table), 0x808080) if "rgb" not in (table.dtype.names or ()) else table["rgb"]
            rgb = np.ascontiguousarray(colours).view(np.uint32) if colours.dtype == np.float32 else colours
            channels = np.column_stack([rgb >> 16 & 0xFF, rgb >> 8 & 0xFF, rgb & 0xFF]).astype(np.uint8)
            recording.log(message.topic, rerun.Points3D(points, colors=channels), static=True)
        else:
            places = [pose.pose.position for pose in shown.poses]
            recording.log(message.topic, rerun.LineStrips3D([[[p.x, p.y, p.z] for p in places]]), static=True)
    recording.flush()
    recording.disconnect()
