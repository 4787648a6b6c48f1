"""A vehicle that votes while it drives, as a lifecycle node: what ``mapvote drive`` does, over rclpy.

configure reads the parameters and compiles; activate begins a drive; deactivate ends it, and its last ballot leaves.
The service is mapvote.live.service: this file only gives it topics through rclpy, and so any RMW.
"""

from __future__ import annotations

import math
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, State, TransitionCallbackReturn

from mapvote.cli.live import maps_around, outbox_to
from mapvote.config import load_settings
from mapvote.core.types import MapvoteError
from mapvote.formats.drives.options import read_mount, read_sensor
from mapvote.formats.geo.frame import frame_of
from mapvote.live.changes_topics import ChangesTopics
from mapvote.live.choice import Voice, Wish, choose_topics
from mapvote.live.doubt import DoubtKeeper
from mapvote.live.messages import POSE_TOPIC
from mapvote.live.names import ros_names
from mapvote.live.service import Plan, run
from mapvote.live.status import RosStatus, StatusBoard
from mapvote.live.subscriptions import Subscriptions
from mapvote.vehicle import Cuts
from mapvote.warmup import warm_vehicle
from mapvote_vehicle.ros_network import RosNetwork


class MapvoteVehicle(LifecycleNode):
    """The node. A drive has a thread of its own; the executor's thread takes messages."""

    def __init__(self) -> None:
        super().__init__("mapvote_vehicle")
        self.values: dict[str, Any] = {}
        self.stopped = threading.Event()
        self.thread: threading.Thread | None = None
        for name, default in (
            ("map", "http://127.0.0.1:8080"),
            ("vehicle", "car_1"),
            ("send", ""),
            ("out", ""),
            ("key_file", ""),
            ("points", ""),
            ("odometry", ""),
            ("sensor", ""),
            ("mount", ""),
            ("every_m", 2000.0),
            ("unchecked", False),
            ("keep_doubt", ""),
            ("keep_doubt_mb", 2000),
        ):
            self.values[name] = self.declare_parameter(name, default).value

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        """Read the parameters, and compile: a minute or two the first time."""
        for name in self.values:
            self.values[name] = self.get_parameter(name).value
        try:
            if not self.values["send"] and not self.values["out"]:
                raise MapvoteError("give send, out, or both")
            self.settings = load_settings(None)
            self.mount = read_mount(self.values["mount"], "mount") if self.values["mount"] else None
            self.sensor = read_sensor(self.values["sensor"], "sensor") if self.values["sensor"] else None
            warm_vehicle(self.settings)
        except MapvoteError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        """Begin a drive."""
        self.stopped.clear()
        self.thread = threading.Thread(target=self._guarded, name="drive", daemon=True)
        self.thread.start()
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        """End the drive: the scans that wait vote, and the last ballot leaves, or waits in the outbox."""
        self.stopped.set()
        if self.thread is not None:
            self.thread.join()
            self.thread = None
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: State) -> TransitionCallbackReturn:
        """As deactivate."""
        return self.on_deactivate(state)

    def _guarded(self) -> None:
        try:
            self._drive()
        except MapvoteError as error:
            self.get_logger().error(f"{error}; mend it, then deactivate and activate again")

    def _drive(self) -> None:
        """What ``mapvote drive`` does, until the node is deactivated."""
        given = self.values
        key_file = Path(given["key_file"]) if given["key_file"] else None
        key = None if key_file is None else key_file.read_text().strip()
        out = Path(given["out"]) if given["out"] else None
        say = self.get_logger().info
        names = ros_names(self.get_namespace().rstrip("/"), [])
        with ExitStack() as stack:
            network = RosNetwork(self)
            stack.callback(network.close)
            maps = stack.enter_context(maps_around(given["map"], key_file))
            outbox = stack.enter_context(outbox_to(given["vehicle"], given["send"] or None, out, key))
            keeper = None
            if given["keep_doubt"]:
                keeper = DoubtKeeper(Path(given["keep_doubt"]), 10**6 * given["keep_doubt_mb"])
                stack.callback(keeper.close)
            on_earth = frame_of(maps.current().georeference)
            odometry = next(iter(names.named("odometry", given["odometry"] or None)), None)
            wish = Wish(names.named("points", given["points"] or None), odometry, names, not on_earth.is_local)
            voice = Voice(self.get_logger().warning)
            chosen = choose_topics(network, wish, voice, self.stopped.is_set, math.inf)
            if chosen is None:
                return
            plan = Plan(
                given["vehicle"],
                time.strftime("%Y%m%dT%H%M%SZ", time.gmtime()),
                self.settings,
                Cuts(length_m=given["every_m"]),
                self.mount,
                0.0,
                not given["unchecked"],
                keeper,
            )
            topics = Subscriptions(network, chosen, self.sensor, names, on_earth=on_earth)
            ros = RosStatus(network, given["vehicle"], names.resolve(POSE_TOPIC))
            board = StatusBoard(maps, outbox)
            board.tell(1.0, ros.diagnose)
            board.tell(60.0, lambda status, *_: say(status.line()))
            watchers = [board, ros.poses, ChangesTopics(network, names)]
            live = run(plan, topics, maps, outbox, self.stopped.is_set, watchers, voice)
        if live is not None:
            say(f"{live.counts.ballots} ballots, {live.counts.localised} of {live.counts.scans} scans voted")


def main() -> None:
    rclpy.init()
    node = MapvoteVehicle()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except KeyboardInterrupt:
        pass
    finally:
        node.on_deactivate(None)


if __name__ == "__main__":
    main()
