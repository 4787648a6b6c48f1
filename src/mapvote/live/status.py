"""The status of a live drive: for the log, /diagnostics, a topic of poses, Prometheus, systemd and a terminal."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mapvote.core.geometry import inverse
from mapvote.core.types import F64, MapvoteError
from mapvote.formats.extras import require
from mapvote.live.cdr import blank_message, header_of, to_cdr
from mapvote.live.dds import Network, Publication
from mapvote.live.drive import Fixed, LiveDrive, Maps
from mapvote.live.hearing import Hearing
from mapvote.live.outbox import Outbox
from mapvote.live.play import pose_of
from mapvote.live.road_map import RoadMap

log = logging.getLogger("mapvote.live")
DIAGNOSTICS, POSE = "diagnostic_msgs/msg/DiagnosticArray", "geometry_msgs/msg/PoseWithCovarianceStamped"
POSE_TOPIC = "/mapvote/pose"
_OK, _WARN, _ERROR = 0, 1, 2
_MINUTE_S, _SILENT_S = 60.0, 2.0


@dataclass(frozen=True, slots=True)
class Status:
    """A live drive at one moment; rates and shares of the last minute."""

    scans_hz: float
    """Scans that arrived."""
    localised: float
    """Share of the decided scans that have a sure place; NaN without any."""
    sigma_m: float
    """Median standard deviation of their positions; NaN without any."""
    latency_s: float
    """Median from stamp to vote; NaN without any."""
    waiting_scans: int
    left_out: int
    """Since the start, as are those that follow."""
    unusable: int
    missing: int
    without_map: int
    scans: int
    voted: int
    ballots: int
    sent: int
    spooled: int
    failed_writes: int
    clock_jumps: int
    silent_s: float
    """Since the last cloud."""
    map_version: int
    tiles: int
    """Tiles of the map that are here."""
    server_away: str
    """Why, or ""."""

    def line(self) -> str:
        """One line for a log."""
        return (
            f"{self.scans_hz:.1f} scans/s, {_percent(self.localised)} localised, sigma {_metres(self.sigma_m)}, "
            f"latency {self.latency_s:.2f} s, {self.waiting_scans} wait, {self.left_out} left out, {self.missing} never"
            " came; "
            f"map version {self.map_version}, {self.tiles} tiles; {self.ballots} ballots, {self.spooled} in the spool"
            + (f"; server away: {self.server_away}" if self.server_away else "")
        )

    def troubles(self) -> list[tuple[int, str, str]]:
        """(level of diagnostic_msgs, subject, message) of each part of the drive."""
        return [
            (_ERROR, "clouds", f"none for {self.silent_s:.0f} s")
            if self.silent_s > _SILENT_S
            else (_WARN if self.missing else _OK, "clouds", f"{self.scans_hz:.1f} Hz, {self.missing} never came"),
            (
                _WARN if self.localised < 0.5 or self.without_map else _OK,
                "localisation",
                f"{_percent(self.localised)} localised, sigma {_metres(self.sigma_m)}",
            ),
            (_WARN if self.left_out else _OK, "load", f"{self.waiting_scans} scans wait, {self.left_out} left out"),
            (_ERROR if self.failed_writes else _OK, "disk", f"{self.failed_writes} failed writes"),
            (_WARN if self.server_away else _OK, "server", self.server_away or f"{self.spooled} ballots in the spool"),
        ]


def _percent(share: float) -> str:
    return "none" if np.isnan(share) else f"{share:.0%}"


def _metres(value: float) -> str:
    return "unknown" if np.isnan(value) else f"{value:.3f} m"


class StatusBoard:
    """Computes the status of a live drive, and calls each listener at its own interval."""

    def __init__(self, maps: Maps, outbox: Outbox) -> None:
        self._maps, self._outbox = maps, outbox
        self._past: deque[tuple[float, int, int, int]] = deque()
        """(seconds, scans, localised, lost) of the last minute."""
        self._last_cloud_s, self._clouds = time.monotonic(), 0
        self._told: list[tuple[float, Callable[[Status, LiveDrive, Hearing], None]]] = []
        self._due: list[float] = []
        self.status: Status | None = None

    def tell(self, every_s: float, listener: Callable[[Status, LiveDrive, Hearing], None]) -> None:
        """Call ``listener`` with the status every so many seconds."""
        self._told.append((every_s, listener))
        self._due.append(time.monotonic() + every_s)

    def __call__(self, live: LiveDrive, hearing: Hearing) -> None:
        """Called by the scan loop, as often as it likes."""
        now = time.monotonic()
        if hearing.clouds != self._clouds:
            self._clouds, self._last_cloud_s = hearing.clouds, now
        due = [k for k, due_s in enumerate(self._due) if now >= due_s]
        if not due:
            return
        self.status = self.look(live, now)
        for k in due:
            every_s, listener = self._told[k]
            self._due[k] = now + every_s
            listener(self.status, live, hearing)

    def look(self, live: LiveDrive, now: float) -> Status:
        """The status now, seconds of any steady clock."""
        c, report = live.counts, self._outbox.report
        self._past.append((now, c.scans, c.localised, c.lost))
        while now - self._past[0][0] > _MINUTE_S:
            self._past.popleft()
        then, scans, localised, lost = self._past[0]
        localised, decided = c.localised - localised, c.localised - localised + c.lost - lost
        sigmas = [] if live.vehicle is None else live.vehicle.report.sigmas_m[-600:]
        recent = list(c.latencies_s)[-600:]
        on_way = self._maps if isinstance(self._maps, RoadMap) else None
        own = 0 if live.vehicle is None else live.vehicle.point_map.version or 1
        return Status(
            scans_hz=(c.scans - scans) / (now - then) if now > then else 0.0,
            localised=localised / decided if decided else float("nan"),
            sigma_m=float(np.median(sigmas)) if sigmas else float("nan"),
            latency_s=float(np.median(recent)) if recent else float("nan"),
            waiting_scans=live.waiting,
            left_out=c.left_out,
            unusable=c.unusable,
            missing=c.missing,
            without_map=c.without_map,
            scans=c.scans,
            voted=c.localised,
            ballots=c.ballots,
            sent=report.sent,
            spooled=report.waiting,
            failed_writes=report.failed_writes,
            clock_jumps=c.clock_jumps,
            silent_s=now - self._last_cloud_s,
            map_version=on_way.version if on_way is not None else own,
            tiles=on_way.tiles
            if on_way is not None
            else 0
            if live.vehicle is None
            else len(live.vehicle.point_map.tiles),
            server_away="" if on_way is None else on_way.away,
        )


class RosStatus:
    """/diagnostics once a second, and a pose for each scan that voted."""

    def __init__(self, network: Network, vehicle: str) -> None:
        self._vehicle = vehicle
        self._diagnostics: Publication = network.publish("/diagnostics", DIAGNOSTICS, patience_s=0.0)
        self._poses: Publication = network.publish(POSE_TOPIC, POSE, patience_s=0.0)
        self._refused = 0

    def diagnose(self, status: Status, live: LiveDrive, hearing: Hearing) -> None:
        """Publish the status."""
        values = [
            blank_message("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
            for key, value in asdict(status).items()
        ]
        said = [
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
        header = header_of(time.time_ns(), "")
        self._send(self._diagnostics, to_cdr(DIAGNOSTICS, blank_message(DIAGNOSTICS, header=header, status=said)))

    def poses(self, live: LiveDrive, hearing: Hearing) -> None:
        """Publish the poses of the scans that have voted since the last time: of what odometry tracks, in the map's
        frame. The covariance is that of the sensor's position and of the rotation, in map axes."""
        while live.fixes:
            T_lidar_base = inverse(live.T_base_lidar)
            self._send(self._poses, pose_message(live.fixes.popleft(), T_lidar_base, hearing.map_frame or "map"))

    def _send(self, publication: Publication, data: bytes) -> None:
        """A message that a slow reader does not take is dropped: no reader delays the drive."""
        try:
            publication.send(data)
        except MapvoteError as error:
            self._refused += 1
            if self._refused == 1:
                log.warning("%s", error)


def pose_message(fixed: Fixed, T_lidar_base: F64, frame: str) -> bytes:
    """A PoseWithCovarianceStamped."""
    message = blank_message(POSE, header=header_of(fixed.stamp_ns, frame))
    message.pose.pose = pose_of(fixed.T_map_lidar @ T_lidar_base)
    message.pose.covariance = fixed.covariance.astype(np.float64).ravel()
    return to_cdr(POSE, message)


_COUNTERS = (
    "scans",
    "voted",
    "left_out",
    "unusable",
    "missing",
    "without_map",
    "ballots",
    "sent",
    "failed_writes",
    "clock_jumps",
)


def serve_metrics(board: StatusBoard, port: int) -> int:
    """Prometheus' metrics on this machine's loopback; returns the port, which 0 lets the system choose. MapvoteError
    without prometheus-client (extra ``server``)."""
    core, exposition = (require(f"prometheus_client{name}", "server", "--metrics") for name in (".core", ""))

    class Collector:
        def collect(self) -> Iterable[Any]:
            if board.status is None:
                return
            values: Mapping[str, Any] = asdict(board.status)
            for name, value in values.items():
                if isinstance(value, str):
                    yield core.GaugeMetricFamily(f"mapvote_drive_{name}", name, float(bool(value)))
                elif name in _COUNTERS:
                    yield core.CounterMetricFamily(f"mapvote_drive_{name}", name, value)
                else:
                    yield core.GaugeMetricFamily(f"mapvote_drive_{name}", name, value)

    registry = exposition.CollectorRegistry()
    registry.register(Collector())
    server, _ = exposition.start_http_server(port, "127.0.0.1", registry)
    return int(server.server_port)


def notify_systemd(text: str) -> bool:
    """Send systemd a message such as READY=1 (sd_notify(3)). False if systemd did not start this process."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return False
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
        out.connect("\0" + address[1:] if address.startswith("@") else address)
        out.sendall(text.encode())
    return True


class Heartbeat:
    """Reports to systemd that the service is ready, and once a second that its loop is alive."""

    def __init__(self) -> None:
        self._next_s = 0.0
        self._here = notify_systemd("READY=1")

    def __call__(self) -> None:
        """Called once a round."""
        if self._here and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + 1.0
            notify_systemd("WATCHDOG=1")


def watched(status: Status, name: str) -> Any:
    """The status as a table for a terminal."""
    from rich.table import Table

    table = Table(title=f"{name}: map version {status.map_version}", show_header=False)
    colour = {_OK: "green", _WARN: "yellow", _ERROR: "red"}
    for level, about, message in status.troubles():
        table.add_row(f"[{colour[level]}]{about}", message)
    table.add_row("latency", f"{status.latency_s:.2f} s from stamp to vote")
    table.add_row("votes", f"{status.voted} of {status.scans} scans, {status.unusable} unusable")
    table.add_row("map", f"{status.tiles} tiles here")
    table.add_row("ballots", f"{status.ballots} closed, {status.sent} sent, {status.spooled} in the spool")
    return table
