"""Stores for the command line: the HTTP API of a STORE in this process, its map, and what is wrong with it.

A verb is written once, against the API, and takes a STORE or the URL of a server.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import closing, contextmanager

import structlog

from mapvote.cli.door import is_url
from mapvote.cli.terminal import complain
from mapvote.client.connection import Connection
from mapvote.config import Settings
from mapvote.core.point_map import PointMap
from mapvote.core.types import MapvoteError
from mapvote.doctor import Finding, in_order
from mapvote_server.api.app import URL, in_process
from mapvote_server.gate import gate_by
from mapvote_server.questions.history import overview
from mapvote_server.questions.origins import with_origins
from mapvote_server.store.integrity import check
from mapvote_server.store.keys import listed
from mapvote_server.store.store import Store, url_of

_STORE_MEND = "mapvote check STORE --mend --from BACKUP"
_DAMAGE_LISTED = 5
"""Damaged records of one kind that are listed one by one."""
_SIZES = "tiles", "ballots", "vehicles", "plane_bytes"


@contextmanager
def api_of(name: str, settings: Settings | None = None, executor: Executor | None = None) -> Iterator[Connection]:
    """The HTTP API of a STORE. ``settings`` and ``executor`` are those of its fusion.

    A Ctrl-C ends the process at once: the API works in other threads, and a transaction that is not finished leaves
    nothing behind, as after a kill -9.
    """
    gate = None if settings is None else gate_by(settings.ndt, settings.server.gate_drives)
    with (
        opened_store(name) as store,
        _errors_only(),
        in_process(store, settings, owner=who(), gate=gate, executor=executor) as transport,
    ):
        try:
            yield Connection(URL, name=name, attempts=1, timeout_s=None, transport=transport)
        except KeyboardInterrupt:
            complain("interrupted; what was not finished was not written")
            os._exit(130)


@contextmanager
def map_of_store(name: str, version: int | None = None, *, origins: bool = False) -> Iterator[PointMap]:
    """The newest map of a STORE, or one version of it; its tiles are read while this is open. ``origins``: with the
    fields of :func:`mapvote_server.questions.origins.with_origins`."""
    with opened_store(name) as store:
        point_map = store.point_map(version)
        yield with_origins(store, point_map) if origins else point_map


def findings_of(name: str) -> list[Finding]:
    """Everything that is wrong with a STORE, errors first. Every byte is read."""
    with opened_store(name) as store:
        return check_store(store)


@contextmanager
def _errors_only() -> Iterator[None]:
    """The API logs every request, to stdout; a verb's stdout is its answer."""
    import logging

    before = structlog.get_config()
    structlog.configure(
        wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR),
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
    )
    try:
        yield
    finally:
        structlog.configure(**before)


def store_url(name: str) -> str:
    """The database URL of STORE on the command line. MapvoteError if it shows a password."""
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError

    given = os.environ.get("MAPVOTE_STORE", "") if name == "-" else name
    if not given:
        raise MapvoteError("STORE is -, but MAPVOTE_STORE is not set")
    if is_url(given):
        raise MapvoteError(f"{given}: this is a server. Name the STORE (a file or a database) on the server's machine")
    try:
        password = make_url(url_of(given)).password
    except ArgumentError:
        raise MapvoteError("STORE is no database URL: postgresql+psycopg://USER@HOST/NAME") from None
    if password is not None and name != "-":
        mend = "set MAPVOTE_STORE to the URL and give - as STORE, or keep the password in ~/.pgpass"
        raise MapvoteError(f"everybody on this machine can read a password on the command line: {mend}")
    return url_of(given)


def opened_store(name: str) -> closing[Store]:
    """An existing store, closed at the end."""
    return closing(Store.open(store_url(name)))


def who() -> str:
    """The login name of the user of this machine, for a store's log."""
    import getpass

    try:
        return getpass.getuser()
    except (KeyError, OSError):  # no name for this number
        return "operator"


def check_store(store: Store) -> list[Finding]:
    """Everything that the doctor finds in an open store, errors first. Every byte is read."""
    # Here, for these import the vehicle, which no other use of a store needs.
    from mapvote.doctor.map_points import check_cloud
    from mapvote.doctor.maps import check_map, classified_ground, tile_by_tile

    damaged = check(store)
    findings = []
    for kind, count in Counter(damage.kind for damage in damaged).items():
        of_kind = [damage for damage in damaged if damage.kind == kind][:_DAMAGE_LISTED]
        findings += [Finding("error", f"damaged: {damage}", _STORE_MEND) for damage in of_kind]
        if count > _DAMAGE_LISTED:
            findings.append(Finding("error", f"damaged: {count - _DAMAGE_LISTED} more of the kind {kind}", _STORE_MEND))
    glance = overview(store)
    sizes = ", ".join(f"{getattr(glance, key):,} {key.replace('_', ' ')}" for key in _SIZES)
    findings.append(Finding("note", f"version {glance.version}: {sizes}"))
    if glance.quarantined:
        text = f"{glance.quarantined} damaged things were set aside: their votes and tiles do not count"
        findings.append(Finding("warning", text, f"{_STORE_MEND} brings back what a backup has"))
    valid = Counter(key.role for key in listed(store) if key.valid_at(store.clock()))
    if valid["operator"]:
        roles = ", ".join(f"{count} {role}" for role, count in sorted(valid.items()))
        findings.append(Finding("note", f"keys: {roles}"))
    else:
        text = "no operator has a valid key: the server cannot be operated remotely"
        findings.append(Finding("warning", text, "mapvote keys STORE issue NAME --role operator"))
    try:
        newest = store.point_map()
        return in_order([*findings, *check_cloud(tile_by_tile(newest), classified_ground(newest)), *check_map(newest)])
    except MapvoteError as error:
        return in_order([*findings, Finding("error", f"its newest map cannot be read: {error}", _STORE_MEND)])
