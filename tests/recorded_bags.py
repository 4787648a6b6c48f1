"""A drive in memory as a bag: clouds with the times of their points, odometry, and several LiDARs where wanted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bag_recorder import CLOUD, START, Recorder
from faults import Recording
from mapvote.core.geometry import inverse, transform
from mapvote.core.types import F64, I64

COLUMNS = ("x", "y", "z", "intensity", "time")


def stamps_of(r: Recording) -> I64:
    """(n,) nanoseconds."""
    return np.asarray(START + np.round(r.times_s * 1e9).astype(np.int64))


def write_bag(
    r: Recording,
    folder: Path,
    *,
    headers_ns: I64 | None = None,
    numbers: Sequence[int] | None = None,
    mounts: Mapping[str, F64] | None = None,
    stated: Mapping[str, F64] | None = None,
) -> Path:
    """The bag of a recording whose scans, rows of COLUMNS, are in the axes of the vehicle, which ``/odom`` tracks.

    ``headers_ns`` (n,): the stamps of its clouds. ``numbers``: the scans in the order of their receipt. ``mounts``:
    T_base_lidar (4, 4) of several LiDARs, which share the points; ``stated``: what /tf_static says of them.
    """
    recorder = Recorder(folder)
    stamps_ns = stamps_of(r)
    headers_ns = stamps_ns if headers_ns is None else headers_ns
    mounts = mounts or {"lidar": np.eye(4)}
    recorder.static(dict(stated or mounts))
    for k, i in enumerate(range(len(r.scans)) if numbers is None else numbers):
        received_ns = int(stamps_ns[0]) + k * 10**8 + 5_000_000
        recorder.pose("/odom", int(stamps_ns[i]), r.T[i], received_ns)
        for part, (name, T) in enumerate(mounts.items()):
            rows = r.scans[i][part :: len(mounts)]
            table = np.zeros(len(rows), dtype=[(column, "<f4") for column in COLUMNS])
            table["x"], table["y"], table["z"] = transform(inverse(T), rows[:, :3]).T
            for c, column in enumerate(COLUMNS[3:], start=3):
                table[column] = rows[:, c] if c < rows.shape[1] else 0.0
            topic = "/points" if name == "lidar" else f"/{name}"
            recorder.write(topic, CLOUD, received_ns, recorder.cloud_of(table, int(headers_ns[i]), name))
    recorder.bag.close()
    return folder
