"""Clients that keep a server waiting, on real sockets: each is cut off, and none keeps an honest one out."""

from __future__ import annotations

import base64
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import cast

import httpx2
import numpy as np
import pytest

from hand_made import make_map, make_tile
from live_server import serving_here
from mapvote_server.api.connections import CROWDING, Caller, Connection, Line, _Ending
from mapvote_server.api.security import caller_of
from mapvote_server.store import keys
from mapvote_server.store.store import Store

CONFIG = """
[server]
header_timeout_s = 1.0
body_timeout_s = 8.0
answer_timeout_s = 2.0
connections = 12
"""
POINTS = 1_000_000
PATIENT_S = 30.0
"""Longer than any of the server's clocks, so that a busy machine fails nothing."""


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    home = tmp_path_factory.mktemp("connections")
    points = np.random.default_rng(1).uniform(0.0, 76.0, (POINTS, 3)).astype(np.float32)
    Store.create(f"sqlite:///{home / 's.db'}", make_map({(0, 0): make_tile(points)})).close()
    with serving_here(home / "s.db", settings=CONFIG, log=home / "log") as address:
        yield address


@pytest.fixture
def line(url: str) -> Iterator[socket.socket]:
    with connected(url) as connection:
        yield connection


def connected(url: str) -> socket.socket:
    host, _, port = url.removeprefix("http://").partition(":")
    line = socket.socket()
    line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)  # so that what is not read waits at the server
    line.settimeout(PATIENT_S)
    line.connect((host, int(port)))
    return line


def until_cut(connection: socket.socket, every_s: float = PATIENT_S, piece: bytes = b"") -> bytes:
    """Send ``piece`` again and again, whatever comes, until the server hangs up; what it said last."""
    connection.settimeout(every_s)
    said, deadline = b"", time.monotonic() + PATIENT_S
    while time.monotonic() < deadline:
        try:
            data = connection.recv(1 << 16)
            if not data:
                return said
            said += data
        except TimeoutError:
            pass
        except ConnectionError:
            return said
        try:
            connection.sendall(piece)
        except ConnectionError:
            return said
    raise AssertionError("the server waits for ever")


@pytest.mark.parametrize("length", [4, None])
def test_an_answer_ends_with_the_last_byte_of_its_length(length: int | None) -> None:
    """A client that had it sent its next request before the empty last message, and was cut off for pipelining."""
    ending = _Ending()
    headers = [] if length is None else [(b"Content-Length", b"%d" % length)]
    ending.told({"type": "http.response.start", "status": 200, "headers": headers})
    sent = [ending.told({"type": "http.response.body", "body": piece, "more_body": True}) for piece in (b"ab", b"cd")]
    assert [message["more_body"] for message in sent] == [True, length is None]
    assert ending.is_over == (length is not None)
    ending.told({"type": "http.response.body", "body": b"", "more_body": False})
    assert ending.is_over


def test_a_connection_that_says_nothing_is_cut(line: socket.socket) -> None:
    assert until_cut(line).startswith(b"HTTP/1.1 408 ")


def test_headers_byte_by_byte_are_cut(line: socket.socket) -> None:
    line.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX-Slow: ")
    assert until_cut(line, 0.2, b"a").startswith(b"HTTP/1.1 408 ")


def test_a_lone_line_end_after_an_answer_does_not_hold_the_connection(line: socket.socket) -> None:
    line.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert line.recv(1 << 16).startswith(b"HTTP/1.1 200 ")
    line.sendall(b"\r\n")
    start = time.monotonic()
    until_cut(line)
    assert time.monotonic() - start < PATIENT_S


@pytest.mark.slow
@pytest.mark.parametrize("target", ["PUT /v1/ballots/a/d1", "POST /v1/publish"])
def test_a_stalled_body_is_cut(line: socket.socket, target: str) -> None:
    head = f"{target} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 100000\r\n\r\n{{"
    line.sendall(head.encode())
    assert until_cut(line, 0.2, b" ") == b""


@pytest.mark.slow
def test_a_client_that_never_reads_is_cut(url: str, line: socket.socket) -> None:
    plane = httpx2.get(f"{url}/v1/map", timeout=300.0).json()["tiles"]["0,0"]["points"]
    line.sendall(f"GET /v1/tiles/{plane} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode() * 3)
    time.sleep(6.0)
    received = 0
    with suppress(ConnectionError):
        while data := line.recv(1 << 20):
            received += len(data)
    assert received < 2 * 12 * POINTS


ONE = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"


def with_body(*more: bytes) -> bytes:
    return b"PUT /v1/ballots/a/d1 HTTP/1.1\r\nHost: localhost\r\nContent-Length: 4\r\n\r\njunk" + b"".join(more)


@pytest.mark.parametrize("sent", [[ONE * 200], [ONE, ONE * 3], [with_body(ONE)], [with_body(with_body(ONE))]])
def test_requests_before_the_answer_to_the_first_end_the_connection(line: socket.socket, sent: list[bytes]) -> None:
    """The first one is answered, and nothing of the others is done; a later piece may come after the first answer."""
    for piece in sent:
        line.sendall(piece)
    said = until_cut(line)
    assert 1 <= said.count(b"HTTP/1.1 ") <= len(sent)
    assert said.startswith((b"HTTP/1.1 200 ", b"HTTP/1.1 422 "))


def test_one_after_another_on_one_connection_all_are_answered(line: socket.socket) -> None:
    for _ in range(50):
        line.sendall(ONE)
        assert answered(line) == 200


def answered(line: socket.socket) -> int:
    """Status of a whole answer in JSON."""
    said = line.recv(1 << 16)
    while not said.endswith(b"}"):
        said += line.recv(1 << 16)
    return int(said.split()[1])


@pytest.mark.parametrize(
    ("head", "status"),
    [
        (b"GET /healthz HTTP/1.1\nHost: localhost\n\n", 400),
        (b"GET /healthz HTTP/1.1\r\nHost: localhost\nX: y\r\n\r\n", 400),
        (b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX: y\r\n folded\r\n\r\n", 400),
        (b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX: y\r\n\tfolded\r\n\r\n", 400),
        (b"POST /v1/publish HTTP/1.1\r\nHost: localhost\r\nContent-Length: 4\r\n"
         b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n", 400),
        (b"POST /v1/publish HTTP/1.1\r\nHost: localhost\r\nTRANSFER-ENCODING: chunked\r\n"
         b"content-length: 4\r\n\r\n0\r\n\r\n", 400),
        (b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n" + b"a:1\r\n" * 99 + b"\r\n", 200),
        (b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n" + b"a:1\r\n" * 100 + b"\r\n", 431),
        (b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n" + b"a:1\r\n" * 5000, 431),
    ],
)  # fmt: skip
@pytest.mark.parametrize("pieces", [1, 7])
def test_a_head_that_programs_read_differently_or_of_many_headers_is_refused(
    line: socket.socket, head: bytes, status: int, pieces: int
) -> None:
    size = len(head) // pieces + 1
    with suppress(ConnectionError):
        for i in range(pieces):
            line.sendall(head[i * size : (i + 1) * size])
            time.sleep(0.02)
    assert line.recv(1 << 16).startswith(f"HTTP/1.1 {status} ".encode())


@pytest.mark.parametrize("before", [b"", b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"])
def test_a_head_of_more_than_32_kb_is_431_and_the_end_of_the_connection(line: socket.socket, before: bytes) -> None:
    line.sendall(before)
    assert not before or line.recv(1 << 16).startswith(b"HTTP/1.1 200 ")
    line.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX-Long: ")
    start = time.monotonic()
    assert flooded(line) < 20_000_000
    assert b"HTTP/1.1 431 " in until_cut(line)
    assert time.monotonic() - start < PATIENT_S


def flooded(connection: socket.socket, most: int = 40_000_000) -> int:
    """Bytes that the other side takes until it hangs up; buffers of both systems hold some megabytes of them."""
    sent = 0
    with suppress(ConnectionError, TimeoutError):
        while sent < most:
            sent += connection.send(bytes(100_000))
    return sent


def unread(body: bytes, declared: int) -> bytes:
    """A request that is refused by its head."""
    head = f"PUT /v1/ballots/a/d1 HTTP/1.1\r\nHost: evil.example\r\nContent-Length: {declared}\r\n\r\n"
    return head.encode() + body


def test_a_body_that_nobody_reads_is_read_no_longer_and_ends_its_connection(line: socket.socket) -> None:
    line.sendall(unread(b"", 1 << 30))
    assert answered(line) == 403
    assert flooded(line) < 20_000_000


def test_after_a_body_that_nobody_reads_no_other_request_is_taken(line: socket.socket) -> None:
    line.sendall(unread(b"ju", 4))
    assert answered(line) == 403
    line.sendall(b"nk" + ONE)
    assert until_cut(line) == b""


def test_after_a_whole_body_that_nobody_reads_the_next_head_is_looked_at(line: socket.socket) -> None:
    for _ in range(2):
        line.sendall(unread(b"junk", 4))
        assert answered(line) == 403
    line.sendall(ONE)
    assert answered(line) == 200
    line.sendall(ONE.replace(b"\r\n", b"\n"))
    assert line.recv(1 << 16).startswith(b"HTTP/1.1 400 ")


def test_bytes_that_follow_a_request_are_read_no_longer(line: socket.socket) -> None:
    line.sendall(ONE)
    assert flooded(line) < 20_000_000


def test_a_head_just_below_32_kb_is_read(url: str) -> None:
    assert httpx2.get(f"{url}/healthz", headers={"X-Long": "a" * 30_000}, timeout=300.0).status_code == 200


@pytest.mark.parametrize("start", [b"a" * 20, b"1;" + b"a" * 20, b"0\r\nX-Trailer: "])
def test_a_chunk_line_or_a_trailer_without_end_is_cut(line: socket.socket, start: bytes) -> None:
    head = b"POST /v1/publish HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"
    line.sendall(head + start)
    sent = 0
    with suppress(ConnectionError):
        for _ in range(10_000):
            line.sendall(b"a" * 4000)
            sent += 4000
    assert sent < 20_000_000


def test_more_connections_than_allowed_cost_the_longest_silent_one(url: str) -> None:
    with ExitStack() as stack:
        silent = [stack.enter_context(connected(url)) for _ in range(40)]
        assert httpx2.get(f"{url}/healthz", timeout=PATIENT_S).status_code == 200
        for connection in silent[:20]:
            assert until_cut(connection) == b""


def test_a_request_under_way_is_never_what_makes_room(url: str, line: socket.socket) -> None:
    line.sendall(b"PUT /v1/ballots/a/d1 HTTP/1.1\r\nHost: localhost\r\nContent-Length: 4\r\n\r\nju")
    with ExitStack() as stack:
        for _ in range(40):
            stack.enter_context(connected(url))
        assert httpx2.get(f"{url}/healthz", timeout=PATIENT_S).status_code == 200
        line.sendall(b"nk")
        assert line.recv(1 << 16).startswith(b"HTTP/1.1 422 ")


def test_who_holds_all_connections_gives_one_up_for_everybody_else(tmp_path: Path) -> None:
    """Eight bodies that never end, of one vehicle and of eight: an operator and a probe are answered beside both."""
    store = Store.create(f"sqlite:///{tmp_path / 's.db'}", make_map({}))
    vehicles = [keys.issue(store, f"v{i}", "vehicle") for i in range(8)]
    operator = keys.issue(store, "boss", "operator")
    settings = CONFIG.replace("connections = 12", "connections = 8")
    with serving_here(tmp_path / "s.db", settings=settings, log=tmp_path / "log") as url:
        for names in (["v0"] * 8, [f"v{i}" for i in range(8)]):
            with ExitStack() as stack:
                for i, name in enumerate(names):
                    upload = stack.enter_context(connected(url))
                    head = f"PUT /v1/ballots/{name}/d{i} HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n"
                    key = vehicles[int(name[1:])]
                    upload.sendall(f"{head}Authorization: Bearer {key}\r\n\r\nju".encode())
                time.sleep(0.3)
                assert httpx2.get(f"{url}/livez", timeout=PATIENT_S).status_code == 200
                headers = {"Authorization": f"Bearer {operator}"}
                for path in ("/v1/map", "/v1/keys", "/healthz"):
                    assert httpx2.get(url + path, headers=headers, timeout=PATIENT_S).status_code == 200
    store.close()


def test_the_server_is_well_again_afterwards(url: str, tmp_path: Path) -> None:
    for _ in range(20):
        assert httpx2.get(f"{url}/v1/map", timeout=300.0).status_code == 200


class Waiting:
    """A request at the line."""

    def __init__(self, name: str, has_key: bool = False) -> None:
        self.caller = Caller(name, has_key=has_key)
        self.begun = False

    def enter(self, line: Line) -> bool:
        self.begun = line.enter(cast("Connection", self))
        return self.begun

    def go_on(self) -> None:
        self.begun = True


def test_a_flood_lets_nobody_wait_but_those_who_come_alike() -> None:
    """A right key is not held up by a flood without keys, a probe by neither, and those who wait go on in order."""
    line = Line()
    flood = [Waiting("10.0.0.1 no key") for _ in range(100)]
    begun = [one.enter(line) for one in flood]
    assert begun == [True] * CROWDING.strangers + [False] * (100 - CROWDING.strangers)
    greedy = [Waiting("a", has_key=True) for _ in range(CROWDING.of_key + 1)]
    assert [one.enter(line) for one in greedy] == [True] * CROWDING.of_key + [False]
    for other in (Waiting("b", has_key=True), Waiting("10.0.0.1 probe"), Waiting("10.0.0.1 new key")):
        assert other.enter(line)
        line.leave(other.caller)
    line.give_up(cast("Connection", flood[8]))
    line.leave(flood[0].caller)
    assert [one.begun for one in flood[8:11]] == [False, True, False]
    for _ in range(98):
        line.leave(flood[0].caller)
    assert Waiting("10.0.0.1 no key").enter(line)


@pytest.mark.parametrize(
    ("request_line", "header", "caller"),
    [
        ("GET /v1/map", "Authorization: Bearer RIGHT", "key"),
        ("GET /v1/map", "AUTHORIZATION:bearer RIGHT", "key"),
        ("GET /", "Cookie: a=b; mapvote_key=RIGHT", "key"),
        ("GET /livez", "Authorization: Basic " + base64.b64encode(b"me:RIGHT").decode(), "key"),
        ("GET /livez", "Authorization: Bearer WRONG", "new key"),
        ("GET /livez", "Accept: */*", "probe"),
        ("GET /v1/map", "Accept: */*", "no key"),
        ("GET", "", "no key"),
        ("", "Authorization", "no key"),
    ],
)
def test_the_head_tells_the_caller(request_line: str, header: str, caller: str) -> None:
    right = keys.hash_of("RIGHT")
    head = f"\r\n{request_line} HTTP/1.1\r\nHost: localhost\r\n{header}\r\n\r\n".encode()
    told = caller_of(head, {right: None})
    assert told == (Caller(right, has_key=True) if caller == "key" else Caller(caller))
