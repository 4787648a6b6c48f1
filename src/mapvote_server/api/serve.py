"""Run the app on an address: logs, keys where they must be, a graceful stop."""

from __future__ import annotations

import gc
import ipaddress
import logging
import resource
import socket
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import msgspec
import structlog
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from mapvote.config import Settings
from mapvote.core.point_map import PointMap
from mapvote.core.record import record
from mapvote.core.types import MapvoteError
from mapvote.formats import read_map
from mapvote_server.api.app import create_app
from mapvote_server.api.connections import HEAD_LIMITS, Patience, tracked, watched
from mapvote_server.api.security import HEADERS, caller_of
from mapvote_server.store import keys
from mapvote_server.store.policy import Policy
from mapvote_server.store.publish import Gate
from mapvote_server.store.store import Store


@record()
@dataclass(frozen=True, slots=True)
class ServerTimes:
    """Numbers of the process of a server."""

    files: int = 300
    """File descriptors beside those of connections: a database's connections, libraries, logs."""
    switch_s: float = 5e-4
    """Time that a computing thread may keep the interpreter while others wait, seconds (Python's default: 5 ms). An
    answer takes some twenty such turns."""
    patience_s: int = 5
    """Time that a stopping server waits for answers under way, seconds. Ballots take milliseconds."""


SERVER_TIMES = ServerTimes()


def open_or_create(
    url: str,
    map_path: Path | None,
    policy: Policy | None = None,
    *,
    read: Callable[[Path], PointMap] = read_map,
) -> tuple[Store, bool]:
    """The store at a database URL, or a new one from ``map_path`` and with this ``policy`` if there is none yet;
    whether it is new.

    MapvoteError if there is neither.
    """
    try:
        return Store.open(url), False
    except MapvoteError:
        if map_path is None:
            raise
    return Store.create(url, read(map_path), policy), True


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach ``host``."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def serve(
    store: Store,
    settings: Settings,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    opened: bool = False,
    gate: Gate | None = None,
    ready: Callable[[str], object] = lambda url: None,
) -> None:
    """Serve until SIGINT or SIGTERM; requests under way are answered and ballots taken in are written first.

    A publish that is still fusing is answered 503; one that is being written is finished.

    ``ready`` is called with the URL once the server listens. ``opened``: as long as the store holds no key, requests
    need none; on a loopback address only. ``gate`` as in :func:`mapvote_server.api.app.create_app`.

    MapvoteError if the store holds no key and ``opened`` is not given, if the host is not loopback with it, or if the
    address is taken.
    """
    if opened and not is_loopback(host):
        raise MapvoteError(f"--open is for this machine alone, {host} can be reached from elsewhere: use keys instead")
    if not opened and not keys.any_issued(store):
        mend = "issue the first (mapvote keys STORE issue NAME --role operator), or give --open on this machine"
        raise MapvoteError(f"this store has no keys yet: {mend}")
    app = create_app(store, settings, opened=opened, gate=gate)
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(1024)  # from here on connections wait for the app to start
    except OSError as error:
        listener.close()
        raise MapvoteError(f"cannot listen on {host}:{port} ({error.strerror}): choose another --port") from error
    settle()
    most = settings.server
    patience = Patience(most.header_timeout_s, most.body_timeout_s, most.answer_timeout_s, _room_for(most.connections))
    config = uvicorn.Config(
        tracked(app),
        http=watched(H11Protocol, patience, partial(caller_of, right=app.state.services.right_keys)),
        h11_max_incomplete_event_size=HEAD_LIMITS.head_bytes,
        ws="none",
        access_log=False,
        proxy_headers=False,  # mapvote_server.api.proxies reads them
        log_level="warning",
        timeout_graceful_shutdown=SERVER_TIMES.patience_s,
        server_header=False,
        headers=list(HEADERS),
    )
    sys.setswitchinterval(SERVER_TIMES.switch_s)
    server = _Server(config, app.state.services.stop_fusing)
    shown = f"[{host}]" if ":" in host else host
    # asyncio and uvicorn install handlers one after the other: a Ctrl-C between them would end in a traceback.
    with listener, server.capture_signals():
        ready(f"http://{shown}:{listener.getsockname()[1]}")
        server.run(sockets=[listener])


def settle() -> None:
    """Exempt all loaded objects from garbage collection.

    A collection stops every thread while it visits all objects, for a quarter of a second on a busy machine; nearly all
    of them are the libraries'.
    """
    gc.collect()
    gc.freeze()


def _room_for(connections: int) -> int:
    """The wanted number of connections, or what the system allows this process beside its files."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = connections + SERVER_TIMES.files
    if soft < needed:
        soft = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    return min(connections, soft - SERVER_TIMES.files)


class _Server(uvicorn.Server):
    """On shutdown drops what waits to be fused, so that a publish under way ends."""

    def __init__(self, config: uvicorn.Config, stop_fusing: Callable[[], None]) -> None:
        super().__init__(config)
        self._stop_fusing = stop_fusing

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._stop_fusing()
        await super().shutdown(sockets)


def log_as_json() -> None:
    """One JSON object a line on stderr, from us and from the libraries."""
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            structlog.processors.JSONRenderer(lambda event, default: msgspec.json.encode(event, enc_hook=default)),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(logging.INFO),
        logger_factory=structlog.BytesLoggerFactory(sys.stderr.buffer),
        cache_logger_on_first_use=True,
    )
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format='{"event": "%(name)s: %(message)s"}')
