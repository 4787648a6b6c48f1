"""Frames of a vehicle: fixed ones from /tf_static, and from /tf what nobody sends as fixed."""

from __future__ import annotations

from typing import Any

from mapvote.core.geometry import inverse
from mapvote.core.types import F64
from mapvote.formats.drives.rosbag import Edges, T_from
from mapvote.live.messages import matrix_of


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
