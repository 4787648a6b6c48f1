"""The outermost layer of every request: host and origin, key, security headers, metrics, one log line.

A page on the Internet can give its own name the address 127.0.0.1 (DNS rebinding) and so speak to a server on the
visitor's machine as if it were its own. The browser still says in ``Host`` and ``Origin`` whose page it was.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import ipaddress
import re
import time
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import structlog
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mapvote.core.record import record
from mapvote.core.types import MapvoteError
from mapvote_server.api import key_form
from mapvote_server.api.connections import Caller, identify, step_aside
from mapvote_server.api.lanes import asker
from mapvote_server.api.problems import refuse
from mapvote_server.api.proxies import Proxies
from mapvote_server.api.services import RateLimit, Services
from mapvote_server.errors import Forbidden, TooMany, Unauthorised, Unavailable
from mapvote_server.store import keys


@record()
@dataclass(frozen=True, slots=True)
class Floods:
    """Numbers of the defence against guessed keys and floods of requests."""

    remembered: int = 10_000
    """Keys that are remembered as right."""
    pause_s: float = 1.0
    """Pause before the refusal of who sends too many requests or wrong keys, seconds."""
    per_minute: float = 60.0
    """Wrong keys of one address per minute that are answered without a pause."""
    at_once: int = 120
    """Wrong keys of one address at once that are answered without a pause."""
    request_s: float = 0.001
    """CPU time in the event loop that a request is charged to the budget of its key, beside its work, seconds."""


FLOODS = Floods()


class Guard:
    """Keys come as ``Authorization: Bearer KEY``, as Basic with the key as password, or in the cookie of a browser
    (:mod:`mapvote_server.api.key_form`).

    The key of every request is looked up in the store, many in one query, so a revoked key works no longer at once. The
    key of a ballot is looked up in the transaction that writes the ballot
    (:meth:`mapvote_server.store.admission.Intake.write`). Before that its name suffices, which never changes.

    ``opened``: no key is needed as long as the store holds none. The first key that is issued ends that for good.
    ``owner``: every request is that of an operator of this name.
    """

    def __init__(self, parts: Services, *, opened: bool, owner: str | None = None) -> None:
        self._parts = parts
        self._opened = opened
        self._owner = None if owner is None else keys.Key(owner, "operator", 0, None)
        self._known = parts.right_keys
        self._wrong = RateLimit(FLOODS.per_minute, FLOODS.at_once, "wrong keys")

    async def who(
        self, authorization: str | None, peer: str, *, ballot: bool = False
    ) -> tuple[keys.Key, str | None] | None:
        """The key of a request and its hash (None of the owner); None if the server is open.

        Unauthorised if the key is missing, unknown or revoked; of a ``ballot`` a known key passes, and the store
        decides. TooMany in its place if ``peer`` has sent many wrong keys. A right key never waits for wrong ones:
        every key is looked up, and only the refusal is delayed (:class:`Watch`).
        """
        if self._owner is not None:
            return self._owner, None
        if self._opened:
            self._opened = not await self._parts.look_up(keys.any_issued, self._parts.store)
        if self._opened:
            return None
        secret = _secret_of(authorization)
        if secret is None:
            raise Unauthorised("this server needs a key: send it as `Authorization: Bearer KEY`")
        digest = keys.hash_of(secret)
        key = self._known.get(digest) if ballot else None
        if key is None:
            key = await self._look_up(digest, peer)
            if len(self._known) > FLOODS.remembered:
                self._known.clear()
            self._known[digest] = key
        return key, digest

    async def _look_up(self, digest: str, peer: str) -> keys.Key:
        try:
            return await self._parts.known_keys.put(digest)
        except Unauthorised:
            self._known.pop(digest, None)
            self._wrong.take(peer)
            raise


def _secret_of(authorization: str | None) -> str | None:
    scheme, _, value = (authorization or "").partition(" ")
    if scheme.lower() == "bearer" and value.strip():
        return value.strip()
    if scheme.lower() == "basic":
        try:
            return base64.b64decode(value, validate=True).decode().partition(":")[2] or None
        except (binascii.Error, UnicodeDecodeError):
            return None
    return None


HEADERS = (
    ("X-Content-Type-Options", "nosniff"),
    ("Referrer-Policy", "same-origin"),
    (
        "Content-Security-Policy",
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
    ),
    ("Cross-Origin-Resource-Policy", "same-origin"),
)
"""On every answer, errors too: no guessed types, no referrer, nothing loaded from other servers."""


class Hosts:
    """The names of this server: localhost, any IP address (no page can rebind one), and ``allowed`` names."""

    def __init__(self, allowed: Sequence[str]) -> None:
        self._allowed = frozenset(name.lower() for name in allowed) | {"localhost"}
        self.knows = lru_cache(maxsize=256)(self._is_ours)
        """Whether a Host is a name of this server."""

    def check(self, scope: Scope) -> None:
        """Forbidden for a request to another name, or by a page of another server."""
        headers = scope["headers"]
        self._check_names(headers)
        # An <img> or a link sends no Origin, but the browser's Basic credentials. Links may lead to the pages alone.
        site = next((value for name, value in headers if name == b"sec-fetch-site"), b"")
        if site in (b"cross-site", b"same-site") and not key_form.is_page(scope):
            raise Forbidden("pages of other servers may not use this server: open it in a window of its own")

    def _check_names(self, headers: Iterable[tuple[bytes, bytes]]) -> None:
        host = origin = None
        for name, value in headers:
            if name == b"host":
                host = value.decode("latin-1") if host is None else ""
            elif name == b"origin":
                origin = value.decode("latin-1")
        if not host or not self.knows(host):
            raise Forbidden(f"{(host or '')[:80]!r} is not a name of this server: {_MEND}")
        theirs = "" if origin is None else origin.partition("://")[2].lower()
        # An Origin that is an IP address must equal the Host: another machine's page has an address too.
        foreign = theirs != host.lower() and _name_in(theirs) not in self._allowed - {"localhost"}
        if origin is not None and foreign:
            raise Forbidden(f"pages of {origin[:80]!r} may not use this server: {_MEND}")

    def _is_ours(self, host: str) -> bool:
        name = _name_in(host)
        if name in self._allowed:
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True


_HOST = re.compile(r"(?:\[([0-9a-f:.]+)\]|([a-z0-9._-]+))(?::[0-9]{1,5})?")
_MEND = "if it should be, add it to [server] hosts in the server's configuration"


def _name_in(host: str) -> str:
    """The name or address in ``name:port``, without brackets; "" if it is neither."""
    match = _HOST.fullmatch(host.lower())
    return (match[1] or match[2]) if match else ""


def _authorization(headers: Iterable[tuple[bytes, bytes]]) -> str | None:
    """The header, or what the cookie of a browser stands for."""
    sent = next((value for name, value in headers if name == b"authorization"), None)
    if sent is not None:
        return sent.decode("latin-1")
    kept = key_form.key_in_cookie(headers)
    return None if kept is None else f"Bearer {kept}"


PROBES = ("/livez", "/readyz")
"""Who asks without a key, by any name of the server, gets a status without content."""


def caller_of(head: bytes, right: Container[str]) -> Caller:
    """Who sends a request, by its head: the hash of a key that is one of the ``right`` ones, or a kind of request.

    It decides the order of requests alone; :class:`Guard` looks every key up.
    """
    first, *lines = head.lstrip(b"\r\n").split(b"\r\n")
    pairs = (line.partition(b":") for line in lines)
    secret = _secret_of(_authorization([(name.lower(), value.strip()) for name, _, value in pairs]))
    if secret is None:
        path = b" ".join(first.split(b" ")[1:2]).decode("latin-1")
        return Caller("probe" if path in PROBES else "no key")
    digest = keys.hash_of(secret)
    return Caller(digest, has_key=True) if digest in right else Caller("new key")


log = structlog.get_logger("mapvote")


class Watch:
    """The outermost layer. No key, header or query is ever logged."""

    def __init__(self, app: ASGIApp, hosts: Hosts, guard: Guard, proxies: Proxies, parts: Services) -> None:
        self._app = app
        self._hosts = hosts
        self._guard = guard
        self._proxies = proxies
        self._metrics = parts.metrics
        self._ready = parts.check_ready
        self._budget = parts.budget

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start = time.perf_counter()
        status = 500
        key = None

        async def watched(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        sender = (scope["client"] or ("",))[0]
        try:
            self._proxies.apply(scope)
            self._hosts.check(scope)
            peer = (scope["client"] or ("",))[0]
            if scope["method"] == "POST" and scope["path"] == key_form.PATH:
                answer = await self._let_in(scope, receive, peer)
                await answer(scope, receive, watched)
                return
            authorization = _authorization(scope["headers"])
            ballot = scope["method"] == "PUT" and scope["path"].startswith("/v1/ballots/")
            whose = await self._guard.who(authorization, peer, ballot=ballot)
            key, key_hash = whose or (None, None)
            scope.setdefault("state", {}).update(key=key, key_hash=key_hash)
            privileged = key is None or key.role in ("reviewer", "operator")
            identify(key.name if key else "", privileged=privileged)
            if key_hash is not None and key is not None:
                asker.set(key.name)
                self._charge(key.name, privileged=privileged)
            outside = self._proxies.seen_from_outside(scope, sender, self._hosts.knows)
            await self._app(outside, receive, watched)
        except MapvoteError as error:
            if isinstance(error, TooMany):  # a flood waits for its refusals instead of sending more
                step_aside(with_key=False)
                await asyncio.sleep(FLOODS.pause_s)
            asks = scope["method"] in ("GET", "HEAD") and not any(n == b"authorization" for n, _ in scope["headers"])
            probed = asks and scope["path"] in PROBES
            if isinstance(error, Unauthorised) and asks and scope["path"] == key_form.STYLE:
                refused = key_form.style()
            elif isinstance(error, Unauthorised) and key_form.asks_for_page(scope):
                refused = key_form.form(str(error) if key_form.key_in_cookie(scope["headers"]) else "")
            else:
                path = scope["path"]
                refused = Response(status_code=await self._status(path)) if probed else refuse(error, path)
            await refused(scope, receive, watched)
        except asyncio.CancelledError:  # the server stops and waits no longer
            stops = refuse(Unavailable("the server is stopping: ask again once it is back"), scope["path"])
            await stops(scope, receive, watched)
        finally:
            seconds = time.perf_counter() - start
            method = scope["method"]
            self._metrics.requests.labels(method, status).inc()
            self._metrics.seconds.labels(method).observe(seconds)
            tell = log.warning if status >= 500 else log.info
            name = key.name if key else "-"
            tell("request", method=method, path=scope["path"], status=status, key=name, ms=round(seconds * 1e3, 1))

    def _charge(self, name: str, *, privileged: bool) -> None:
        """Charge a request to its key; TooMany if the key of a vehicle or reader has used up its budget. Reviewers and
        operators can still send commands then."""
        if not privileged:
            self._budget.check(name)
        self._budget.spend(name, FLOODS.request_s, 0)

    async def _let_in(self, scope: Scope, receive: Receive, peer: str) -> Response:
        """The answer to the form that asks for a key."""
        try:
            sent = await key_form.key_sent(scope, receive)
            await self._guard.who(f"Bearer {sent}", peer)
        except Unauthorised as error:
            return key_form.form(str(error))
        return key_form.welcome(scope, sent)

    async def _status(self, path: str) -> int:
        """The answer to a probe."""
        if path == "/livez":
            return 200
        try:
            await self._ready()
        except Unavailable:
            return 503
        return 200
