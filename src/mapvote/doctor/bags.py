"""Faults of a bag: its files, topics, rates, clocks, and the transforms between the frames of poses and LiDARs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import scipy

from mapvote.core.types import F64, I64, Drive, MapvoteError
from mapvote.doctor import Finding, Severity
from mapvote.doctor.lidars import check_lidars
from mapvote.formats.drives.bag import Bag, frame_id, stamps_of, static_frames
from mapvote.formats.drives.frames import T_from
from mapvote.formats.drives.options import DriveOptions, SaidOfDrive, drive_options
from mapvote.formats.drives.ros_types import CLOUDS, GNSS, POSES
from mapvote.formats.drives.rosbag import T_base_lidars
from mapvote.formats.drives.stamp_order import StampOrder, in_order_of_stamps

_Orders = Mapping[str, StampOrder]
_Times = Mapping[str, I64]
"""(messages, 3) of each topic: the stamp in its header and the time of its receipt, nanoseconds, and its bytes."""


def check_bag(path: Path, **said: Unpack[SaidOfDrive]) -> list[Finding]:
    """Topics, rates, clocks and frames of the bag at ``path``; nothing of what its scans show."""
    try:
        bag = Bag(path)
        times = stamps_of(bag, bag.topics(*CLOUDS, *POSES, *GNSS))
        orders = {topic: in_order_of_stamps(rows[:, 0], rows[:, 1]) for topic, rows in times.items()}
        files = [Finding("warning", line) for line in bag.mended]
        poses = _poses(bag, orders, drive_options(path, **said))
        return [*files, *_topics(bag, times), *_clocks(bag, times, orders), *poses]
    except MapvoteError as error:
        return [Finding("error", str(error))]


def check_lidars_of_bag(path: Path, drive: Drive, said: Mapping[str, Any]) -> list[Finding]:
    """Whether the LiDARs of an opened drive sit where the bag at ``path`` says."""
    options = drive_options(path, **said)
    topics = [name.strip() for name in (options.topic or "").split(",")]
    if len(topics) < 2:
        return []
    places = T_base_lidars(Bag(path), topics, options.mounts)
    return list(check_lidars(drive, topics, places))


def _topics(bag: Bag, times: _Times) -> Iterator[Finding]:
    others = []
    for name, topic in sorted(bag.reader.topics.items()):
        if topic.msgtype not in (*CLOUDS, *POSES, *GNSS):
            others.append(f"{name} ({topic.msgcount})")
            continue
        seconds = float(np.ptp(times[name][:, 1])) * 1e-9 if len(times[name]) else 0.0
        rate = f"{(len(times[name]) - 1) / seconds:.1f} Hz" if seconds > 0 else "no rate"
        yield Finding("note", f"{name}: {topic.msgcount} messages of {topic.msgtype}, {rate}")
        if topic.msgtype in CLOUDS and topic.msgcount == 0:
            yield Finding("warning", f"{name} holds no message", "did the driver run? Record it again")
    if others:
        yield Finding("note", f"other topics: {', '.join(others)}")


def _clocks(bag: Bag, times: _Times, orders: _Orders) -> Iterator[Finding]:
    """Findings on stamps of the headers: out of order, doubled, or of another clock than the times of receipt."""
    for topic, order in orders.items():
        mend = "the drive is read so; record again with `use_sim_time` alike for all nodes, and one pass a bag"
        yield from (Finding("warning", f"{topic} {problem}", mend) for problem in order.told)
    for topic in bag.topics(*CLOUDS):
        stamps, received, _ = times[topic][orders[topic].chosen].T
        if len(stamps) < 3 or not stamps.any():
            continue
        late_s = float(np.median(received - stamps)) * 1e-9
        if abs(late_s) > 0.5:  # more than any transport takes
            problem = f"{topic}: messages were received {late_s:.2f} s after their stamps (median)"
            mend = "the sensor or a simulator (use_sim_time) has another clock: check that the poses use the same one"
            yield Finding("note", problem, mend)


def _poses(bag: Bag, orders: _Orders, options: DriveOptions) -> Iterator[Finding]:
    """Which topics may serve as prior, whether they span the scans, and how far the LiDAR sits from what they track."""
    clouds = list(bag.topics(*CLOUDS))
    poses = list(bag.topics(*POSES, *GNSS))
    if not clouds:
        return
    if not poses:
        yield Finding("note", "no topic of poses or GNSS fixes: a prior must come from a file (--prior)")
        return
    if options.prior is None:
        problem = f"no prior is chosen, but there are poses: {', '.join(poses)}"
        yield Finding("warning", problem, f"--prior {poses[0]}")
    lidar = frame_id(bag, clouds[0])
    scans = orders[clouds[0]].stamps_ns
    edges = static_frames(bag)
    for topic in poses:
        stamps = orders[topic].stamps_ns
        outside = float(((scans < stamps.min()) | (scans > stamps.max())).mean()) if len(stamps) and len(scans) else 0.0
        if outside > 0.05:
            grave: Severity = "error" if outside > 0.9 else "warning"
            mend = "take the times of both from one computer, or use PTP"
            problem = f"{topic} has no pose at the time of {outside:.0%} of the scans"
            yield Finding(grave, problem, mend if outside > 0.9 else "leave these scans out with --scans")
        tracked = frame_id(bag, topic, child=True)
        if tracked and tracked != lidar:
            problem = f"{topic} tracks {tracked}, the scans are of {lidar}"
            yield _mounted(problem, T_from(edges, tracked).get(lidar), options)


def _mounted(difference: str, T: F64 | None, options: DriveOptions) -> Finding:
    if T is None:
        mend = "give it: --mount X,Y,Z,ROLL,PITCH,YAW (metres, degrees)"
        return Finding("warning", f"{difference}; /tf_static holds no transform between the two", mend)
    if options.mount or options.T_base_lidar or np.allclose(T, np.eye(4), atol=1e-3):
        return Finding("note", f"{difference}: /tf_static holds the transform between the two")
    rpy_deg = scipy.spatial.transform.Rotation.from_matrix(T[:3, :3]).as_euler("xyz", degrees=True)
    mend = "--mount " + ",".join(f"{v:.3f}" for v in (*T[:3, 3], *rpy_deg))
    return Finding("warning", f"{difference}: /tf_static holds the transform, but the prior does not use it", mend)
