"""A depot: ballots in files are sent to a server one by one, with a line for each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mapvote.client import MapClient, Refused
from mapvote.core.types import MapvoteError


@dataclass(slots=True)
class Delivery:
    """Outcome of some ballots."""

    taken: int = 0
    """Ballots that the server took now."""
    repeated: int = 0
    """Ballots that the server had already."""
    refused: int = 0
    """Ballots that are damaged, or that the server does not take."""
    left: int = 0
    """Ballots that were not sent because the server went away."""

    @property
    def unsent(self) -> int:
        """Ballots that are not at the server."""
        return self.refused + self.left

    def told(self) -> str:
        """The outcome in one line."""
        away = f", {self.left} not sent: the server is away, run the same command again" if self.left else ""
        return f"{self.taken} ballots sent, {self.repeated} were there already, {self.refused} refused{away}"


def send_all(client: MapClient, files: Sequence[Path], say: Callable[[str], object]) -> Delivery:
    """Send the ballots in ``files`` in their order. A damaged or refused one does not stop the others; a server that
    is away does."""
    delivery = Delivery()
    for number, file in enumerate(files):
        try:
            outcome = client.send(_read(file))
        except MapvoteError as error:
            if isinstance(error, Refused) and error.of_key:
                raise  # no other ballot would be taken either
            delivery.refused += 1
            say(f"{file}: {error}")
            continue
        if outcome == "spooled":
            delivery.left = len(files) - number
            return delivery
        delivery.taken += outcome != "repeated"
        delivery.repeated += outcome == "repeated"
        say(f"{file}: {outcome}")
    return delivery


def _read(file: Path) -> bytes:
    """The bytes of a ballot. MapvoteError if there are none."""
    try:
        return file.read_bytes()
    except OSError as error:
        raise MapvoteError(f"cannot be read ({error.strerror or error})") from error
