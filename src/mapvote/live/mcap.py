"""MCAP files of ROS 2 messages, which Foxglove, RViz and ``mapvote vote`` open."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from mapvote.core.extras import require
from mapvote.core.types import MapvoteError
from mapvote.live.messages import typestore

HIDDEN = ".mcap-"
"""Beginning of the folders in which files are written: one that a crash left behind may be deleted."""


class FileMessage(NamedTuple):
    """One message, serialised."""

    topic: str
    """Full name."""
    kind: str
    stamp_ns: int
    data: bytes


def write_mcap(path: Path, messages: Iterable[FileMessage]) -> None:
    """An MCAP file of messages; it appears whole. MapvoteError without rosbags (extra ``ros``), or if it cannot be
    written."""
    rosbag2 = require("rosbags.rosbag2", "ros", str(path))
    try:
        with tempfile.TemporaryDirectory(prefix=HIDDEN, dir=path.resolve().parent) as home:
            bag = Path(home) / "bag"
            with rosbag2.Writer(bag, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as out:
                topics: dict[str, Any] = {}
                for message in messages:
                    if message.topic not in topics:
                        topics[message.topic] = out.add_connection(message.topic, message.kind, typestore=typestore())
                    out.write(topics[message.topic], message.stamp_ns, message.data)
            (written,) = bag.glob("*.mcap")
            os.replace(written, path)
    except OSError as error:
        raise MapvoteError(f"{path}: cannot be written ({error.strerror or error})") from error
