"""The status of a live drive: for the log, /diagnostics, a topic of poses, Prometheus, systemd and a terminal."""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from enum import IntEnum
from typing import Any

import numpy as np

from mapvote.core.extras import require
from mapvote.core.geometry import inverse
from mapvote.core.kernel import call_while_compiling
from mapvote.core.record import record
from mapvote.core.types import MapvoteError
from mapvote.formats.drives.ros_types import POSE_WITH_COVARIANCE
from mapvote.live.dds import Network, Publication
from mapvote.live.drive import Counts, LiveDrive
from mapvote.live.messages import POSE_TOPIC, blank_message, header_of, pose_of, to_cdr
from mapvote.live.outbox import Outbox, OutboxReport
from mapvote.live.road_map import Maps, RoadMap
from mapvote.live.subscriptions import Subscriptions

log = logging.getLogger("mapvote.live")
DIAGNOSTICS, POSE = "diagnostic_msgs/msg/DiagnosticArray", POSE_WITH_COVARIANCE


class DiagnosticLevel(IntEnum):
    """Levels of a diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


def _level(error: object, warning: object) -> DiagnosticLevel:
    return DiagnosticLevel.ERROR if error else DiagnosticLevel.WARN if warning else DiagnosticLevel.OK


@record()
@dataclass(frozen=True, slots=True)
class StatusTimes:
    """Times of the status of a live vehicle."""

    minute_s: float = 60.0
    """Time over which the status looks back, seconds."""
    silent_s: float = 2.0
    """Time without a cloud after which a topic is silent, seconds."""
    recent: int = 600
    """Scans of that time."""
    beat_s: float = 1.0
    """Time between two beats, seconds."""
    extended_s: float = 30.0
    """Time that systemd grants a start from each beat on, seconds."""
    start_s: float = 900.0
    """Longest start, seconds."""


STATUS_TIMES = StatusTimes()


@dataclass(frozen=True, slots=True)
class Status:
    """A live drive at one moment; rates and shares of the last minute."""

    counts: Counts
    """Since the start."""
    outbox: OutboxReport
    """Since the start."""
    scans_hz: float
    """Scans that arrived."""
    localised_share: float
    """Share of the decided scans that have a sure place; NaN without any."""
    sigma_m: float
    """Median standard deviation of their positions; NaN without any."""
    latency_s: float
    """Median from stamp to vote; NaN without any."""
    waiting_scans: int
    silent_s: float
    """Since the last cloud."""
    map_version: int
    tiles: int
    """Tiles of the map that are here."""
    server_away: str
    """Why, or ""."""
    odometry_frame: str = ""
    """Where odometry's own frame lies in the map; "" if its poses are in the map's."""

    def values(self) -> dict[str, Any]:
        """All of it by name: those of the counts and of the outbox, then its own."""
        own = {field.name: getattr(self, field.name) for field in fields(self)[2:]}
        return asdict(self.counts) | asdict(self.outbox) | own

    def line(self) -> str:
        """One line for a log."""
        return (
            f"{self.scans_hz:.1f} scans/s, {_percent(self.localised_share)} localised, sigma {_metres(self.sigma_m)}, "
            f"latency {self.latency_s:.2f} s, {self.waiting_scans} wait, {self.counts.left_out} left out, "
            f"{self.counts.missing} never came; map version {self.map_version}, {self.tiles} tiles; "
            f"{self.counts.ballots} ballots, {self.outbox.spooled} in the spool"
            + (f"; odometry's origin in the map {self.odometry_frame}" if self.odometry_frame else "")
            + (f"; server away: {self.server_away}" if self.server_away else "")
        )

    def troubles(self) -> list[tuple[DiagnosticLevel, str, str]]:
        """(level, subject, message) of each part of the drive."""
        counts = self.counts
        silent = self.silent_s > STATUS_TIMES.silent_s
        arriving = f"{self.scans_hz:.1f} Hz, {counts.missing} never came"
        localised = f"{_percent(self.localised_share)} localised, sigma {_metres(self.sigma_m)}"
        spooled = f"{self.outbox.spooled} ballots in the spool"
        too_little = self.localised_share < 0.5 or bool(counts.without_map)
        silence = f"none for {self.silent_s:.0f} s"
        waiting = f"{self.waiting_scans} scans wait, {counts.left_out} left out"
        failed = self.outbox.failed_writes
        return [
            (_level(silent, counts.missing), "clouds", silence if silent else arriving),
            (_level(False, too_little), "localisation", localised),
            (_level(False, counts.left_out), "load", waiting),
            (_level(failed, False), "disk", f"{failed} failed writes"),
            (_level(False, self.server_away), "server", self.server_away or spooled),
        ]

    def table(self, name: str) -> Any:
        """The status as a table for a terminal."""
        from rich.table import Table

        table = Table(title=f"{name}: map version {self.map_version}", show_header=False)
        colour = {DiagnosticLevel.OK: "green", DiagnosticLevel.WARN: "yellow", DiagnosticLevel.ERROR: "red"}
        for level, about, message in self.troubles():
            table.add_row(f"[{colour[level]}]{about}", message)
        counts = self.counts
        sent = self.outbox.sent
        table.add_row("latency", f"{self.latency_s:.2f} s from stamp to vote")
        table.add_row("votes", f"{counts.localised} of {counts.scans} scans, {counts.unusable} unusable")
        table.add_row("map", f"{self.tiles} tiles here")
        table.add_row("ballots", f"{counts.ballots} closed, {sent} sent, {self.outbox.spooled} in the spool")
        return table


def _percent(share: float) -> str:
    return "none" if np.isnan(share) else f"{share:.0%}"


def _metres(value: float) -> str:
    return "unknown" if np.isnan(value) else f"{value:.3f} m"


Listener = Callable[[Status, LiveDrive, Subscriptions], None]


class StatusBoard:
    """Computes the status of a live drive, and calls each listener at its own interval."""

    def __init__(self, maps: Maps, outbox: Outbox) -> None:
        self._maps = maps
        self._outbox = outbox
        self._past: deque[tuple[float, int, int, int]] = deque()
        """(seconds, scans, localised, lost) of the last minute."""
        self._last_cloud_s = time.monotonic()
        self._clouds = 0
        self._listeners: list[tuple[float, Listener]] = []
        self._due: list[float] = []
        self.status: Status | None = None

    def tell(self, every_s: float, listener: Listener) -> None:
        """Call ``listener`` with the status every so many seconds."""
        self._listeners.append((every_s, listener))
        self._due.append(time.monotonic() + every_s)

    def __call__(self, live: LiveDrive, topics: Subscriptions) -> None:
        """Called by the scan loop, as often as it likes."""
        now_s = time.monotonic()
        if topics.clouds != self._clouds:
            self._clouds = topics.clouds
            self._last_cloud_s = now_s
        due = [k for k, due_s in enumerate(self._due) if now_s >= due_s]
        if not due:
            return
        self.status = self.look(live, now_s)
        for k in due:
            every_s, listener = self._listeners[k]
            self._due[k] = now_s + every_s
            listener(self.status, live, topics)

    def look(self, live: LiveDrive, now_s: float) -> Status:
        """The status now, seconds of any steady clock."""
        counts = live.counts
        self._past.append((now_s, counts.scans, counts.localised, counts.lost))
        while now_s - self._past[0][0] > STATUS_TIMES.minute_s:
            self._past.popleft()
        then, scans, localised, lost = self._past[0]
        localised = counts.localised - localised
        lost = counts.lost - lost
        sigmas = () if live.vehicle is None else live.vehicle.report.sigmas_m(STATUS_TIMES.recent)
        recent = list(live.latencies_s)[-STATUS_TIMES.recent :]
        if isinstance(self._maps, RoadMap):
            version = self._maps.version
            tiles = self._maps.tiles
            away = self._maps.away
        else:
            own = self._maps.current()
            version = own.version or 1
            tiles = len(own.tiles)
            away = ""
        return Status(
            replace(counts),
            replace(self._outbox.report),
            scans_hz=(counts.scans - scans) / (now_s - then) if now_s > then else 0.0,
            localised_share=localised / (localised + lost) if localised + lost else float("nan"),
            sigma_m=float(np.median(sigmas)) if len(sigmas) else float("nan"),
            latency_s=float(np.median(recent)) if recent else float("nan"),
            waiting_scans=live.waiting,
            silent_s=now_s - self._last_cloud_s,
            map_version=version,
            tiles=tiles,
            server_away=away,
            odometry_frame=_odometry_frame(live),
        )


def _odometry_frame(live: LiveDrive) -> str:
    """Where odometry's own frame lies in the map, in figures; "" if it has none."""
    frame = None if live.vehicle is None else live.vehicle.prior_frame
    return frame.told() if frame is not None and frame.is_own else ""


class RosStatus:
    """/diagnostics once a second, and a pose for each scan that voted."""

    def __init__(self, network: Network, vehicle: str, pose_topic: str = f"/{POSE_TOPIC}") -> None:
        self._vehicle = vehicle
        self._diagnostics: Publication = network.publish("/diagnostics", DIAGNOSTICS, patience_s=0.0)
        self._poses: Publication = network.publish(pose_topic, POSE, patience_s=0.0)
        self._refused = False

    def diagnose(self, status: Status, live: LiveDrive, topics: Subscriptions) -> None:
        """Publish the status."""
        values = [
            blank_message("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
            for key, value in status.values().items()
        ]
        parts = [
            blank_message(
                "diagnostic_msgs/msg/DiagnosticStatus",
                level=level,
                name=f"mapvote: {about}",
                message=message,
                hardware_id=self._vehicle,
                values=values if about == "clouds" else [],
            )
            for level, about, message in status.troubles()
        ]
        header = header_of(topics.now_ns(), "")
        self._send(self._diagnostics, to_cdr(DIAGNOSTICS, blank_message(DIAGNOSTICS, header=header, status=parts)))

    def poses(self, live: LiveDrive, topics: Subscriptions) -> None:
        """Publish the poses of the scans that have voted since the last time: of what odometry tracks, in the map's
        frame. The covariance is that of the sensor's position and of the rotation, in map axes. Nothing is made while
        nobody listens."""
        if live.fixes and not self._poses.readers:
            live.fixes.clear()
        while live.fixes:
            fixed = live.fixes.popleft()
            message = blank_message(POSE, header=header_of(fixed.stamp_ns, topics.map_frame or "map"))
            message.pose.pose = pose_of(fixed.T_map_lidar @ inverse(live.T_base_upright))
            message.pose.covariance = fixed.covariance.astype(np.float64).ravel()
            self._send(self._poses, to_cdr(POSE, message))

    def _send(self, publication: Publication, data: bytes) -> None:
        """A message that a slow reader does not take is dropped: no reader delays the drive."""
        try:
            publication.send(data)
        except MapvoteError as error:
            if not self._refused:
                log.warning("%s", error)
            self._refused = True


def serve_metrics(board: StatusBoard, port: int) -> int:
    """Prometheus' metrics on this machine's loopback; returns the port, which 0 lets the system choose. MapvoteError
    without prometheus-client (extra ``server``)."""
    core, exposition = (require(f"prometheus_client{name}", "server", "--metrics") for name in (".core", ""))
    counters = {field.name for field in (*fields(Counts), *fields(OutboxReport))} - {"spooled"}

    class Collector:
        def collect(self) -> Iterable[Any]:
            for name, value in {} if board.status is None else board.status.values().items():
                family = core.CounterMetricFamily if name in counters else core.GaugeMetricFamily
                yield family(f"mapvote_drive_{name}", name, float(bool(value)) if isinstance(value, str) else value)

    registry = exposition.CollectorRegistry()
    registry.register(Collector())
    server, _ = exposition.start_http_server(port, "127.0.0.1", registry)
    return int(server.server_port)


class Heartbeat:
    """Reports to systemd (sd_notify(3)) that the service is ready, and that its loop is alive. Without systemd it does
    nothing.

    Before the service is ready, systemd is asked for more time to start, for a quarter of an hour at most. Later a beat
    goes out each second, from the loop, and from the compiler if a kernel is compiled on the road: so a first start is
    not taken for one that hangs, and one that hangs is.
    """

    def __init__(self) -> None:
        self._next_s = 0.0
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        self._ready = threading.Event()
        if self._address:
            call_while_compiling(self)
            threading.Thread(target=self._start, name="heartbeat", daemon=True).start()

    def ready(self) -> None:
        """The service can do its work from now on."""
        self._ready.set()
        self._notify("READY=1")

    def stopping(self) -> None:
        """The service was told to stop, and writes what it has."""
        self._notify("STOPPING=1")

    def __call__(self) -> None:
        """Called once a round."""
        if self._ready.is_set() and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + STATUS_TIMES.beat_s
            self._notify("WATCHDOG=1")

    def _start(self) -> None:
        end = time.monotonic() + STATUS_TIMES.start_s
        while not self._ready.wait(STATUS_TIMES.beat_s) and time.monotonic() < end:
            self._notify(f"EXTEND_TIMEOUT_USEC={int(1e6 * STATUS_TIMES.extended_s)}")

    def _notify(self, text: str) -> None:
        if not self._address:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:  # no drive ends by it
            out.connect("\0" + self._address[1:] if self._address.startswith("@") else self._address)
            out.sendall(text.encode())
