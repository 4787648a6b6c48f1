"""The key of a request, and what it permits."""

from __future__ import annotations

import asyncio
import base64
import binascii
from concurrent.futures import Executor
from functools import partial

from fastapi import Request

from mapvote.server.errors import Forbidden, TooMany, Unauthorised
from mapvote.server.http.limits import Batcher, RateLimit
from mapvote.server.http.services import services
from mapvote.server.store import keys
from mapvote.server.store.store import Store

_AT_ONCE = 256
"""Keys looked up in one query at most."""
_REMEMBERED = 10_000
_PAUSE_S = 1.0
_WRONG_PER_MINUTE, _WRONG_AT_ONCE = 60.0, 120
"""Wrong keys from one address that are looked up."""


class Guard:
    """Keys come as ``Authorization: Bearer KEY``, or Basic with the key as password (browsers).

    The key of every request is looked up in the store, many in one query, so a revoked key works no longer at once. The
    key of a ballot is looked up in the transaction that writes the ballot
    (:meth:`mapvote.server.store.admission.Intake.write`). Before that its name suffices, which never changes.

    ``opened``: no key is needed as long as the store holds none. The first key that is issued ends that for good.
    ``owner``: every request is that of an operator of this name.
    """

    def __init__(self, store: Store, threads: Executor, *, opened: bool, owner: str | None = None) -> None:
        self._opened = opened
        self._owner = None if owner is None else keys.Key(owner, "operator", 0, None)
        self._any_issued = partial(keys.any_issued, store)
        self._threads = threads
        self._looked_up: Batcher[str, keys.Key] = Batcher(partial(keys.check, store), _AT_ONCE, threads)
        self._known: dict[str, keys.Key] = {}
        self._wrong = RateLimit(_WRONG_PER_MINUTE, _WRONG_AT_ONCE, "wrong keys")

    async def who(
        self, authorization: str | None, peer: str, *, ballot: bool = False
    ) -> tuple[keys.Key, str | None] | None:
        """The key of a request and its hash (None of the owner); None if the server is open.

        Unauthorised if the key is missing, unknown or revoked; of a ``ballot`` a known key passes, and the store
        decides. TooMany if ``peer`` has sent too many wrong keys: no new key from there is looked up for a while.
        """
        if self._owner is not None:
            return self._owner, None
        if self._opened:
            self._opened = not await asyncio.get_running_loop().run_in_executor(self._threads, self._any_issued)
        if self._opened:
            return None
        secret = _secret_of(authorization)
        if secret is None:
            raise Unauthorised("this server needs a key: send it as `Authorization: Bearer KEY`")
        digest = keys.hash_of(secret)
        key = self._known.get(digest) if ballot else None
        if key is None:
            key = await self._look_up(digest, peer)
            if len(self._known) > _REMEMBERED:
                self._known.clear()
            self._known[digest] = key
        return key, digest

    async def _look_up(self, digest: str, peer: str) -> keys.Key:
        if digest not in self._known:
            try:
                self._wrong.check(peer)
            except TooMany:
                await asyncio.sleep(_PAUSE_S)  # a flood waits for its answers instead of sending more
                raise
        try:
            return await self._looked_up.put(digest)
        except Unauthorised:
            self._wrong.take(peer)
            raise


def own(request: Request, vehicle: str) -> str:
    """The name on a key that may change this vehicle's ballots: the vehicle within its rate, or an operator. Else
    Forbidden."""
    key: keys.Key | None = request.state.key
    if key is None:
        return vehicle
    if key.role != "operator":
        if key.role != "vehicle" or key.name != vehicle:
            raise Forbidden(f"the key of {key.name!r} cannot touch ballots of {vehicle[:64]!r}")
        services(request).limit.take(key.name)
    return key.name


def operator(request: Request) -> str:
    """The operator's name; Forbidden for other roles."""
    return _one_of(request, "operator")


def reviewer(request: Request) -> str:
    """The name of a reviewer or an operator; Forbidden for other roles."""
    return _one_of(request, "reviewer", "operator")


def sees_names(request: Request) -> bool:
    """Whether the key permits the names of vehicles and exact times; others get pseudonyms and days."""
    key: keys.Key | None = request.state.key
    return key is None or key.role in ("reviewer", "operator")


def _one_of(request: Request, *roles: keys.Role) -> str:
    key: keys.Key | None = request.state.key
    if key is None:
        return "operator"
    if key.role not in roles:
        raise Forbidden(f"only an {roles[-1]} can do this" if len(roles) == 1 else f"only a {' or '.join(roles)} can")
    return key.name


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
