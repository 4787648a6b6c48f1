"""Refusals of the server, by reason. One table of the app maps each class to a status code."""

from __future__ import annotations

from mapvote.core.types import MapvoteError


class Unauthorised(MapvoteError):
    """No key, or one that is unknown or revoked."""


class Forbidden(MapvoteError):
    """A good key, but not for this."""


class BadRequest(MapvoteError):
    """A parameter that a standard answers by 400."""


class NotFound(MapvoteError):
    """There is no such version, tile, ballot or key."""


class Conflict(MapvoteError):
    """The request does not fit the state of the store: stale base, other method, somebody else published first."""


class Held(Conflict):
    """A version that the policy does not let through."""

    def __init__(self, reasons: list[str]) -> None:
        super().__init__("the version is held: " + "; ".join(reasons))
        self.reasons = reasons


class TooLarge(MapvoteError):
    """Beyond a limit on size."""


class NotInFile(MapvoteError):
    """A range of bytes that begins behind the end of a file."""


class TooMany(MapvoteError):
    """Beyond what a key or a vehicle may send; try again in ``after_s``."""

    def __init__(self, message: str, after_s: float = 1.0) -> None:
        super().__init__(message)
        self.after_s = after_s


class TooSlow(MapvoteError):
    """A question that takes longer than one may; the same question again would too."""


class Unavailable(MapvoteError):
    """The database cannot be written or reached now; nothing was changed, try again."""
