"""Requests to one server, repeated while the trouble may pass, at the rate that the server requests."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator, Mapping
from email.utils import parsedate_to_datetime
from typing import Any

import httpx2

from mapvote.core.types import MapvoteError


class Unreachable(MapvoteError):
    """The server did not answer, or not now."""


class Refused(MapvoteError):
    """The server answered that it will not."""

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status

    @property
    def of_key(self) -> bool:
        """Whether the key is missing, unknown or not allowed to do this: a new key mends it."""
        return self.status in (401, 403)


class Connection:
    """Requests to one server with one key."""

    def __init__(
        self,
        url: str,
        *,
        key: str | None = None,
        name: str | None = None,
        attempts: int = 4,
        longest_wait_s: float = 60.0,
        timeout_s: float | None = 30.0,
        sleep: Callable[[float], object] = time.sleep,
        transport: httpx2.BaseTransport | None = None,
    ) -> None:
        """``name``: name of the server in errors (default: its URL). ``attempts``: tries of a request; it is given up
        where the server asks to wait longer than ``longest_wait_s``. ``transport``: other than over the network."""
        headers = {"Accept-Encoding": "identity"} | ({"Authorization": f"Bearer {key}"} if key else {})
        self._http = httpx2.Client(base_url=url.rstrip("/"), headers=headers, timeout=timeout_s, transport=transport)
        self.url = name or url
        self._attempts = attempts
        self._longest_wait_s = longest_wait_s
        self._sleep = sleep

    def close(self) -> None:
        """Close the sockets."""
        self._http.close()

    def ask(
        self,
        method: str,
        path: str,
        *,
        content: bytes | None = None,
        json: object = None,
        headers: Mapping[str, str] | None = None,
    ) -> httpx2.Response:
        """One request, repeated with growing, scattered pauses, or those that the server names, while the trouble may
        pass. Unreachable if it does not, Refused (with the server's reason) for 4xx."""
        trouble = ""
        wait_s = 0.0
        for attempt in range(self._attempts):
            if attempt:
                self._sleep(max(0.25 * 2**attempt * random.uniform(0.5, 1.5), wait_s))
            try:
                answer = self._http.request(method, path, content=content, json=json, headers=dict(headers or {}))
            except httpx2.TransportError as error:
                trouble = str(error) or type(error).__name__
                wait_s = 0.0
                continue
            except (httpx2.InvalidURL, httpx2.UnsupportedProtocol) as error:
                raise MapvoteError(f"{self.url}: not the address of a server ({error})") from error
            if answer.status_code in (429, 500, 502, 503, 504):  # the next answer may be better
                trouble = detail_of(answer)
                wait_s = _asked_to_wait_s(answer)
                if wait_s > self._longest_wait_s:
                    raise Unreachable(f"{self.url}: {trouble}; ask again in {wait_s:.0f} s")
                continue
            if answer.status_code >= 400:
                refusal = f"{self.url}: refused ({answer.status_code}): {detail_of(answer)}{_mend(answer)}"
                raise Refused(refusal, answer.status_code)
            return answer
        raise Unreachable(f"{self.url}: no answer after {self._attempts} attempts ({trouble}); try again later")

    def lines(self, path: str) -> Iterator[str]:
        """The lines of an answer that goes on, as they come; a minute without one ends it. Unreachable if there is no
        connection, Refused for 4xx."""
        try:
            with self._http.stream("GET", path, timeout=self._longest_wait_s) as answer:
                if answer.status_code >= 400:
                    answer.read()
                    refusal = f"{self.url}: refused: {detail_of(answer)}{_mend(answer)}"
                    raise Refused(refusal, answer.status_code)
                yield from answer.iter_lines()
        except httpx2.TransportError as error:
            raise Unreachable(f"{self.url}: {error or type(error).__name__}") from error

    def ask_json(self, method: str, path: str, *, json: object = None) -> Any:
        """A server's answer, decoded. MapvoteError also if it is no JSON."""
        try:
            return self.ask(method, path, json=json).json()
        except ValueError as error:
            raise MapvoteError(f"{self.url}: is no mapvote server ({error})") from error


def detail_of(answer: httpx2.Response) -> str:
    """A server's reason for a refusal."""
    try:
        detail: Any = answer.json()["detail"]
    except (ValueError, KeyError, TypeError):
        return f"status {answer.status_code}"
    return str(detail)


def _mend(answer: httpx2.Response) -> str:
    """How a user of the command line or of MapClient gives the key that a server asks for."""
    if answer.status_code != 401:
        return ""
    return ". On the command line give --key-file FILE, or set MAPVOTE_KEY; in Python MapClient(url, key=...)"


def _asked_to_wait_s(answer: httpx2.Response) -> float:
    """Retry-After (RFC 9110, 10.2.3): seconds or a date; 0 if there is none."""
    said = answer.headers.get("retry-after", "").strip()
    if said.isdigit():
        return float(said)
    try:
        return max(0.0, parsedate_to_datetime(said).timestamp() - time.time())
    except (ValueError, TypeError):
        return 0.0
