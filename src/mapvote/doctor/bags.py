"""A ROS bag by itself: which topics there are, how often they come, whose clock they keep, what joins their frames."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mapvote.core.types import F64, I64, MapvoteError
from mapvote.doctor.finding import Finding
from mapvote.formats.drives.bag_poses import GNSS, POSES, T_from, frame_id, static_frames
from mapvote.formats.drives.options import DriveOptions
from mapvote.formats.drives.rosbag import CLOUD, Bag

_LATE_S = 0.5
"""Between the stamp in a header and the receipt: more is another clock."""

_Times = Mapping[str, I64]
"""Of each topic (messages, 2): when it was received and when it was stamped, nanoseconds."""


def check_bag(path: Path, options: DriveOptions) -> list[Finding]:
    """Topics, rates, clocks and frames of the bag at ``path``; nothing of what its scans show."""
    try:
        bag = Bag(path)
        times = {topic: _times(bag, topic) for topic in bag.topics(CLOUD, *POSES, *GNSS)}
        return _topics(bag, times) + _clocks(bag, times) + _poses(bag, times, options)
    except MapvoteError as error:
        return [Finding("error", str(error))]


def _times(bag: Bag, topic: str) -> I64:
    rows = [(received_ns, bag.stamp_ns(data)) for _, received_ns, data in bag.raw(topic)]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def _topics(bag: Bag, times: _Times) -> list[Finding]:
    others, found = [], []
    for name, topic in sorted(bag.reader.topics.items()):
        if topic.msgtype not in (CLOUD, *POSES, *GNSS):
            others.append(f"{name} ({topic.msgcount})")
            continue
        seconds = float(np.ptp(times[name][:, 0])) * 1e-9 if len(times[name]) else 0.0
        rate = f"{(len(times[name]) - 1) / seconds:.1f} Hz" if seconds > 0 else "no rate"
        found.append(Finding("note", f"{name}: {topic.msgcount} messages of {topic.msgtype}, {rate}"))
        if topic.msgtype == CLOUD and topic.msgcount == 0:
            found.append(Finding("warning", f"{name} holds no message", "did the driver run? Record it again"))
    return [*found, Finding("note", f"other topics: {', '.join(others)}")] if others else found


def _clocks(bag: Bag, times: _Times) -> list[Finding]:
    """Stamps of the headers against the times of receipt."""
    found = []
    for topic in bag.topics(CLOUD):
        received, stamps = times[topic].T
        if len(stamps) < 3:
            continue
        late_s = float(np.median(received - stamps)) * 1e-9
        back = int((np.diff(stamps) <= 0).sum())
        if (stamps == 0).all():
            what = f"{topic}: headers carry no stamps, the times of receipt are used"
            found.append(Finding("warning", what, "let the driver stamp its messages: receipt comes late and unevenly"))
        elif back:
            what = f"{topic}: stamps do not go forward, {back} times"
            found.append(Finding("error", what, "two recordings joined, or a clock set back: cut the bag there"))
        elif abs(late_s) > _LATE_S:
            what = f"{topic}: messages were received {late_s:.2f} s after their stamps (median)"
            found.append(Finding("note", what, "the sensor keeps another clock: do the poses keep the same one?"))
    return found


def _poses(bag: Bag, times: _Times, options: DriveOptions) -> list[Finding]:
    """Which topics may serve as prior, whether they span the scans, and how far the LiDAR sits from what they track."""
    clouds, poses = list(bag.topics(CLOUD)), list(bag.topics(*POSES, *GNSS))
    if not clouds:
        return []
    if not poses:
        return [Finding("note", "no topic of poses or GNSS fixes: a prior must come from a file (--prior)")]
    found = []
    if options.prior is None:
        what = f"no prior is chosen, but there are poses: {', '.join(poses)}"
        found.append(Finding("warning", what, f"--prior {poses[0]}"))
    lidar = frame_id(bag, clouds[0])
    edges = static_frames(bag)
    for topic in poses:
        found += _spanned(times[clouds[0]][:, 1], times[topic][:, 1], topic)
        tracked = frame_id(bag, topic, child=True)
        if tracked and tracked != lidar:
            T = T_from(edges, tracked).get(lidar)
            found.append(_mounted(topic, tracked, lidar, T, options))
    return found


def _spanned(scans: I64, poses: I64, topic: str) -> list[Finding]:
    if not len(poses) or not len(scans):
        return []
    outside = float(((scans < poses.min()) | (scans > poses.max())).mean())
    if outside <= 0.05:
        return []
    what = f"{topic} has no pose at the time of {outside:.0%} of the scans"
    if outside > 0.9:
        return [Finding("error", what, "do both keep one clock? Use times of one computer, or PTP")]
    return [Finding("warning", what, "leave these scans out with --scans")]


def _mounted(topic: str, tracked: str, lidar: str, T: F64 | None, options: DriveOptions) -> Finding:
    what = f"{topic} tracks {tracked}, the scans are of {lidar}"
    if T is None:
        mend = "give it: --mount X,Y,Z,ROLL,PITCH,YAW (metres, degrees)"
        return Finding("warning", f"{what}; nothing in /tf_static says where that sits on it", mend)
    if options.mount is not None or np.allclose(T, np.eye(4), atol=1e-3):
        return Finding("note", f"{what}: /tf_static says where that sits on it")
    rpy_deg = Rotation.from_matrix(T[:3, :3]).as_euler("xyz", degrees=True)
    mend = "--mount " + ",".join(f"{v:.3f}" for v in (*T[:3, 3], *rpy_deg))
    return Finding("warning", f"{what}: /tf_static says where that sits on it, the prior does not know", mend)
