"""Which client a request comes from and by which address it reached us, where reverse proxies stand between: Forwarded
(RFC 7239) and X-Forwarded-For, -Proto, -Host, -Prefix.

Anybody can send these headers, so they count from trusted proxies alone, and only as far back as the proxies are
trusted: each proxy appends the address that it saw.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Callable, Iterable, Sequence

from starlette.types import Scope

Headers = Iterable[tuple[bytes, bytes]]
_PAIR = re.compile(r'(?:^|[;,\s])(for|proto|host)=(?:"([^"]*)"|([^;,\s"]*))', re.IGNORECASE)
_PREFIX = re.compile(r"(/[A-Za-z0-9._~-]+)+")
_ADDRESS = re.compile(r"\[([0-9A-Fa-f:.]+)\](?::[0-9]+)?|([0-9.]+)(?::[0-9]+)?|([0-9A-Fa-f:.]+)")


class Proxies:
    """The reverse proxies whose word counts: addresses or networks."""

    def __init__(self, trusted: Sequence[str]) -> None:
        self._networks = [ipaddress.ip_network(name, strict=False) for name in trusted]

    def is_one(self, address: str) -> bool:
        """Whether a trusted proxy has this address."""
        try:
            parsed = ipaddress.ip_address(address)
        except ValueError:
            return False
        return any(parsed in network for network in self._networks)

    def client(self, peer: str, headers: Headers) -> str:
        """The address of the client of a request that came from ``peer``: the last one named by a proxy that is none
        itself. ``peer``, if it is no proxy, if it names nobody, or if its two headers name different clients: a proxy
        sets one of them and lets the other through as the client sent it."""
        if not self.is_one(peer):
            return peer
        headers = list(headers)
        named = [self._last(addresses, peer) for addresses in (_x_forwarded(headers), _forwarded(headers)) if addresses]
        return named[0] if len(set(named)) == 1 else peer

    def _last(self, addresses: Sequence[str], peer: str) -> str:
        """The nearest address on the way that is no proxy's; the last is the nearest."""
        for name in reversed(addresses):
            match = _ADDRESS.fullmatch(name.strip())
            if match is None:
                return peer  # "unknown", or a name that the proxy made up
            address = match[1] or match[2] or match[3]
            if not self.is_one(address):
                return address
        return peer

    def apply(self, scope: Scope) -> None:
        """Set the client of a request, and its scheme where a proxy says https."""
        peer, port = scope["client"] or ("", 0)
        if not self.is_one(peer):
            return
        scope["client"] = self.client(peer, scope["headers"]), port
        if "https" in {_last_word(scope["headers"], b"x-forwarded-proto"), _last_pair(scope["headers"], "proto")}:
            scope["scheme"] = "https"

    def seen_from_outside(self, scope: Scope, peer: str, is_our_name: Callable[[str], bool]) -> Scope:
        """The request as it reached the outermost proxy, for the links of its answer: the host, if that is one of our
        names, and the prefix of the path that the proxy at ``peer`` took away."""
        if not self.is_one(peer):
            return scope
        headers = scope["headers"]
        host = _last_word(headers, b"x-forwarded-host") or _last_pair(headers, "host")
        if host and is_our_name(host):
            kept = [(name, value) for name, value in headers if name != b"host"]
            scope = {**scope, "headers": [*kept, (b"host", host.encode("latin-1"))]}
        prefix = _all(headers, b"x-forwarded-prefix").strip().rstrip("/")
        if _PREFIX.fullmatch(prefix):
            scope = {**scope, "root_path": prefix, "path": prefix + scope["path"]}
        return scope


def _all(headers: Headers, name: bytes) -> str:
    return ",".join(value.decode("latin-1") for key, value in headers if key == name)


def _x_forwarded(headers: Headers) -> list[str]:
    sent = _all(headers, b"x-forwarded-for")
    return sent.split(",") if sent else []


def _forwarded(headers: Headers) -> list[str]:
    pairs = _PAIR.findall(_all(headers, b"forwarded"))
    return [quoted or plain for name, quoted, plain in pairs if name.lower() == "for"]


def _last_pair(headers: Headers, wanted: str) -> str:
    pairs = _PAIR.findall(_all(headers, b"forwarded"))
    values = [quoted or plain for name, quoted, plain in pairs if name.lower() == wanted]
    return values[-1].lower() if values else ""


def _last_word(headers: Headers, name: bytes) -> str:
    return _all(headers, name).rpartition(",")[2].strip().lower()
