"""Names of topics as ROS 2 resolves them: a namespace, and remappings ``from:=to``.

https://design.ros2.org/articles/topic_and_service_names.html: a name that begins with a slash stands for itself, any
other one begins with the namespace. A remapping applies to the resolved name.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

from mapvote.core.types import MapvoteError


@dataclass(frozen=True, slots=True)
class RosNames:
    """How a vehicle's node names its topics."""

    namespace: str = "/"
    remapped: dict[str, str] = field(default_factory=dict)
    """From a resolved name to another one."""

    def resolve(self, name: str) -> str:
        """The full name of a topic. MapvoteError if it is no name."""
        full = _absolute(name, self.namespace)
        return self.remapped.get(full, full)

    def named(self, name: str, option: str | None) -> tuple[str, ...]:
        """The topics that an option names, separated by commas, else what ``name`` is remapped to; () if neither."""
        if option:
            return tuple(self.resolve(part.strip()) for part in option.split(","))
        full = self.resolve(name)
        return (full,) if full != _absolute(name, self.namespace) else ()

    def holds(self, topic: str) -> bool:
        """Whether a published topic lies in the namespace."""
        return self.namespace == "/" or topic.startswith(f"{self.namespace}/")


def ros_names(namespace: str = "", remaps: Sequence[str] = ()) -> RosNames:
    """The names of a node. ``remaps``: ``from:=to`` each; ``__ns:=/car1`` is a namespace. MapvoteError names what is
    none."""
    pairs = []
    for remap in remaps:
        source, sign, target = remap.partition(":=")
        if not sign or not source or not target:
            raise MapvoteError(f"-r {remap}: give FROM:=TO, for example /tf_static:=/car1/tf_static")
        if source == "__ns":
            namespace = target
        elif source.startswith("__"):
            raise MapvoteError(f"-r {remap}: the only special name that is supported is __ns")
        else:
            pairs.append((source, target))
    base = _absolute(namespace.rstrip("/"), "/") if namespace.strip("/") else "/"
    return RosNames(base, {_absolute(source, base): _absolute(target, base) for source, target in pairs})


def _absolute(name: str, namespace: str) -> str:
    """``name`` with the namespace before it, unless it begins with a slash."""
    if not re.fullmatch(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*", name):
        raise MapvoteError(
            f"{name!r}: no name of a topic; between slashes it has letters, digits and underscores, and begins with "
            "no digit"
        )
    return name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"


def sim_time_of(parameters: Sequence[str]) -> bool:
    """Whether ``use_sim_time:=true`` is among the parameters. MapvoteError for any other parameter."""
    use_sim_time = False
    for parameter in parameters:
        name, _, value = parameter.partition(":=")
        if name != "use_sim_time" or value not in ("true", "false"):
            raise MapvoteError(f"-p {parameter}: give use_sim_time:=true or use_sim_time:=false, the only parameter")
        use_sim_time = value == "true"
    return use_sim_time
