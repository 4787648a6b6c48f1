"""The parameters of a ROS 2 node, as rclcpp's services show them: read by others, never set.

rclcpp's AsyncParametersClient waits until five of these services are there; ``ros2 param`` uses them, too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mapvote.live.messages import blank_message

Value = bool | str | list[str]


class NodeParameters:
    """Parameters of the node at ``name``, such as /map/pointcloud_map_loader, by its services."""

    def __init__(self, name: str, values: Callable[[], Mapping[str, Value]]) -> None:
        """``values``: of the moment at which they are asked for."""
        self._name = name
        self._values = values

    def services(self) -> dict[str, str]:
        """The type of each service, and its name."""
        names = ("get_parameters", "get_parameter_types", "describe_parameters", "list_parameters", "set_parameters")
        each = {name: name.title().replace("_", "") for name in (*names, "set_parameters_atomically")}
        return {f"rcl_interfaces/srv/{kind}": f"{self._name}/{name}" for name, kind in each.items()}

    def answer(self, service: str, request: Any) -> dict[str, Any]:
        """The members of the response of a service of this type. One unknown name makes the answer empty, as in
        rclcpp."""
        values = self._values()
        kind = service.rpartition("/")[2]
        if kind == "ListParameters":
            prefixes = list(request.prefixes)
            listed = [name for name in values if not prefixes or any(name.startswith(p) for p in prefixes)]
            return {"result": blank_message("rcl_interfaces/msg/ListParametersResult", names=listed, prefixes=[])}
        if kind.startswith("SetParameters"):
            reason = "parameters of mapvote are the options of its command"
            refused = blank_message("rcl_interfaces/msg/SetParametersResult", successful=False, reason=reason)
            return (
                {"result": refused} if kind.endswith("Atomically") else {"results": [refused] * len(request.parameters)}
            )
        names = [name for name in request.names if all(name in values for name in request.names)]
        if kind == "GetParameters":
            return {"values": [_message(values[name]) for name in names]}
        if kind == "GetParameterTypes":
            return {"types": np.array([_message(values[name]).type for name in names], np.uint8)}
        return {
            "descriptors": [
                blank_message(
                    "rcl_interfaces/msg/ParameterDescriptor",
                    name=name,
                    type=_message(values[name]).type,
                    read_only=True,
                )
                for name in names
            ]
        }


def _message(value: Value) -> Any:
    """A rcl_interfaces/ParameterValue."""
    code, member = {bool: (1, "bool_value"), str: (4, "string_value"), list: (9, "string_array_value")}[type(value)]
    return blank_message("rcl_interfaces/msg/ParameterValue", **{"type": code, member: value})
