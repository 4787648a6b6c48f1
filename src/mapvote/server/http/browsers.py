"""What keeps other people's web pages out: whom a request may be addressed to, where it may come from, and what a
browser may do with an answer.

A page on the Internet can give its own name the address 127.0.0.1 (DNS rebinding) and so speak to a server on the
visitor's machine as if it were its own. The browser still says in ``Host`` and ``Origin`` whose page it was.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable, Sequence
from functools import lru_cache

from mapvote.server.errors import Forbidden

HEADERS = (
    ("X-Content-Type-Options", "nosniff"),
    ("Referrer-Policy", "no-referrer"),
    (
        "Content-Security-Policy",
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
    ("Cross-Origin-Resource-Policy", "same-origin"),
)
"""On every answer, errors too: no guessing of types, no address told to others, nothing loaded from elsewhere."""


class Hosts:
    """What this server goes by: localhost, any address in digits (no page can rebind one), and ``allowed`` names."""

    def __init__(self, allowed: Sequence[str]) -> None:
        self._allowed = frozenset(name.lower() for name in allowed) | {"localhost"}
        self._ours = lru_cache(maxsize=256)(self._is_ours)

    def check(self, headers: Iterable[tuple[bytes, bytes]]) -> None:
        """Forbidden for a request addressed to another name, or sent by another server's page."""
        host = origin = None
        for name, value in headers:
            if name == b"host":
                host = value.decode("latin-1") if host is None else ""
            elif name == b"origin":
                origin = value.decode("latin-1")
        if not host or not self._ours(host):
            raise Forbidden(f"this server does not go by the name {(host or '')[:80]!r}: {_MEND}")
        if origin is not None and not self._comes_from_us(origin, host):
            raise Forbidden(f"pages of {origin[:80]!r} may not use this server: {_MEND}")

    def _is_ours(self, host: str) -> bool:
        name = _name_in(host)
        return name in self._allowed or _is_address(name)

    def _comes_from_us(self, origin: str, host: str) -> bool:
        """Of an address in digits only the very one asked: another machine's page has an address too."""
        theirs = origin.partition("://")[2].lower()
        return theirs == host.lower() or _name_in(theirs) in self._allowed - {"localhost"}


_HOST = re.compile(r"(?:\[([0-9a-f:.]+)\]|([a-z0-9._-]+))(?::[0-9]{1,5})?")
_MEND = "name it in the server's configuration, [server] hosts, if it should"


def _name_in(host: str) -> str:
    """The name or address in ``name:port``, without brackets; "" if it is neither."""
    found = _HOST.fullmatch(host.lower())
    return (found[1] or found[2]) if found else ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
