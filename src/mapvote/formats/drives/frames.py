"""Frames of a vehicle: fixed ones from /tf_static, moving ones from /tf; live and recorded."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mapvote.core.geometry import inverse, poses_at, rotations_of
from mapvote.core.types import F64, MapvoteError

Edges = dict[str, list[tuple[str, F64]]]
"""From each frame to its neighbours, with T_frame_neighbour (4, 4), both ways."""


def is_map_frame(name: str) -> bool:
    """Whether poses in the frame of this name may be taken for poses in the map (REP 105: map and earth are fixed, odom
    is not, and a LiDAR odometry names its first pose)."""
    last = name.strip("/").split("/")[-1].lower()
    return last in ("", "map", "world", "earth", "global", "utm", "enu")


def two_frames(topic: str, first: str, other: str) -> str:
    """Why clouds of one topic in two frames are not read."""
    return (
        f"{topic} sends clouds in frame {first} and in frame {other}: two LiDARs on one topic. Give each a topic of "
        "its own (remap its driver)"
    )


def T_from(edges: Edges, source: str) -> dict[str, F64]:
    """T_source_frame (4, 4) of every frame that can be reached."""
    reached = {source: np.eye(4)}
    waiting = [source]
    while waiting:
        here = waiting.pop()
        for there, T in edges.get(here, []):
            if there not in reached:
                reached[there] = reached[here] @ T
                waiting.append(there)
    return reached


def pose_of_message(position: Any, orientation: Any) -> F64:
    """T (4, 4) of a message's position, metres, and quaternion, which must not be zero."""
    p = position
    q = orientation
    return poses_at([[p.x, p.y, p.z]], rotations_of([[q.x, q.y, q.z, q.w]]))[0]


def matrix_of(position: Any, orientation: Any) -> F64:
    """T (4, 4) of a message's position and quaternion. MapvoteError if they are no pose."""
    q = orientation
    length = float(np.linalg.norm([q.x, q.y, q.z, q.w]))
    if not np.isfinite([length, position.x, position.y, position.z]).all() or length < 0.5:
        raise MapvoteError("numbers that are not finite, or a quaternion of zeros")
    return pose_of_message(position, orientation)


BASE_FRAME = "base_link"
"""The body that poses without a name of what they track are of (REP 105)."""


class BodyPose(NamedTuple):
    """The pose of a body in the frame at the top of its tree."""

    stamp_ns: int
    T_root_body: F64
    body: str
    root: str


class Frames:
    """The newest transform between each pair of neighbouring frames."""

    def __init__(self) -> None:
        self._fixed: Edges = {}
        self._moving: Edges = {}
        self._parents: dict[str, str] = {}

    def add(self, transform: Any, *, fixed: bool) -> None:
        """A geometry_msgs/TransformStamped. MapvoteError if it is no rigid motion."""
        parent = transform.header.frame_id.strip("/")
        child = transform.child_frame_id.strip("/")
        T = matrix_of(transform.transform.translation, transform.transform.rotation)
        self._parents[child] = parent
        edges = self._fixed if fixed else self._moving
        for here, there, T_here_there in ((parent, child, T), (child, parent, inverse(T))):
            others = [edge for edge in edges.get(here, []) if edge[0] != there]
            edges[here] = [*others, (there, T_here_there)]

    def add_all(self, message: Any, *, fixed: bool) -> bool:
        """Every transform of a TFMessage; returns whether there was one. MapvoteError if one is no rigid motion."""
        for transform in message.transforms:
            self.add(transform, fixed=fixed)
        return bool(message.transforms)

    @property
    def names(self) -> list[str]:
        """Every frame, in alphabetical order."""
        return sorted({*self._fixed, *self._moving})

    def fixed(self, source: str, target: str) -> F64 | None:
        """T_source_target (4, 4) by fixed frames alone; None if they do not join the two."""
        return T_from(self._fixed, source).get(target)

    def between(self, source: str, target: str) -> F64 | None:
        """T_source_target (4, 4) by fixed frames, else by all as they stand now; None if nothing joins the two."""
        T = self.fixed(source, target)
        if T is not None:
            return T
        joined = {name: [*self._fixed.get(name, []), *self._moving.get(name, [])] for name in self.names}
        return T_from(joined, source).get(target)

    def root(self, frame: str) -> str:
        """The frame at the top of the tree that holds ``frame``."""
        seen = {frame}
        while self._parents.get(frame, frame) not in seen:
            frame = self._parents[frame]
            seen.add(frame)
        return frame

    def poses_of_body(self, message: Any, lidar: str) -> list[BodyPose]:
        """The poses that a TFMessage states: of the body that carries ``lidar`` by fixed frames, in the frame at the
        top of the tree. MapvoteError if a transform is no rigid motion."""
        out = []
        for transform in message.transforms:
            self.add(transform, fixed=False)
            body = transform.child_frame_id.strip("/")
            if not lidar or (body != lidar and self.fixed(body, lidar) is None):
                continue
            root = self.root(body)
            T = self.between(root, body)
            if T is not None:
                time = transform.header.stamp
                out.append(BodyPose(int(time.sec) * 10**9 + int(time.nanosec), T, body, root))
        return out

    def T_map_of(self, frame: str) -> F64 | None:
        """T_map_frame (4, 4) where somebody publishes the way from a frame that is fixed to the Earth to ``frame``;
        None where nobody does."""
        root = self.root(frame)
        if root == frame or not is_map_frame(root):
            return None
        return self.between(root, frame)
